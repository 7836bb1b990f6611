"""Display of results: pandas and HTML tables, matplotlib figures, and numbers with their intervals."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from functools import partial
from html import escape
from math import isfinite
from typing import TYPE_CHECKING, Any

from filters.consistency.intervals import Interval, span
from thruster_env.core.modules import to_install

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


def frame(columns: Mapping[str, Any], index: str | None = None) -> pandas.DataFrame:
    """Columns as a pandas table.

    Args:
        columns: of equal length, by name.
        index: name of the column that is the index; none if None.

    Raises:
        ValueError: if pandas is not installed.
    """
    try:
        import pandas
    except ImportError:
        raise ValueError(f"to_frame must have pandas, which is not installed: {to_install('frames')}") from None
    data_frame = pandas.DataFrame(dict(columns))
    return data_frame if index is None else data_frame.set_index(index)


def html(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], note: str = "") -> str:
    """A small table as notebooks show it."""
    head = "".join(f"<th>{escape(str(name))}</th>" for name in columns)
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    below = f"<p>{escape(note)}</p>" if note else ""
    caption = f"<caption style='text-align: left'>{escape(title)}</caption>"
    return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{below}"


def drawn(figure: Any) -> Figure:
    """The same figure, which a notebook shows even without an import of matplotlib.pyplot."""
    figure._repr_png_ = partial(_png, figure)
    return figure


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def about(value: Interval, digits: int = 3) -> str:
    """A value with its 95 % interval in brackets; a dash where there is none."""
    return span(value, digits) if isfinite(value.value) else "-"


def number(value: float | None, form: str = ".4g") -> str:
    """A number in a form; a dash where there is none."""
    return "-" if value is None or not isfinite(value) else format(value, form)
