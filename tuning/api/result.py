"""`Result`: what all results of verbs have in common, made from their tables and figures."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thruster_env.core.checks import short_repr
from thruster_env.core.files import check_target, write_whole
from thruster_env.core.modules import to_install
from thruster_env.core.text_tables import Table, plain_text

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from filters.consistency.nees import Interval

INTERRUPTED = 130  # exit code
PAGE = ".html"  # the end of a page's name


class Result:
    """A result that shows itself: in a terminal, a notebook, a page, Markdown and JSON.

    A verb's result says what there is to show in `tables` and `figures`; the rest follows.
    """

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended it."""
        return False

    @property
    def exit_code(self) -> int:
        """Of the command: 130 if it was interrupted."""
        return INTERRUPTED if self.interrupted else 0

    @property
    def title(self) -> str:
        """Heading of the page."""
        return repr(self)

    def tables(self) -> Sequence[Any]:
        """Tables and sentences, as the command prints them."""
        raise NotImplementedError

    def figures(self) -> Mapping[str, Figure]:
        """Figures of the page, by caption."""
        return {}

    def as_dict(self) -> dict[str, Any]:
        """All results as `plain_data`, which `json.dumps` takes."""
        raise NotImplementedError

    def document(self) -> dict[str, Any]:
        """The same with the texts of the tables, as the command writes it with --json."""
        tables = [part.as_dict() for part in self.tables() if isinstance(part, Table)]
        return {**self.as_dict(), "text_tables": tables} if tables else self.as_dict()

    def to_markdown(self) -> str:
        """Tables and sentences in Markdown."""
        from tuning.reporting.page import markdown_page

        return markdown_page(self.title, self.tables())

    def report(self, page: str | Path) -> Any:
        """Write a page for any browser, an .html file, with all tables, sentences and figures; and their Markdown.

        Returns:
            The path of the page; the Markdown stands beside it.

        Raises:
            ValueError: for another ending, or if the files cannot be written.
        """
        from tuning.reporting.page import Section, Sketchbook, as_parts, html_page

        path, beside = check_page(page), Path(page).with_suffix(".md")
        book = Sketchbook()
        pictures = [book.picture(figure, caption, caption) for caption, figure in self.figures().items()]
        sections = [
            Section("Results", as_parts(self.tables())),
            *([Section("Figures", pictures)] if pictures else []),
        ]
        write_whole(path, html_page(self.title, (), sections))
        write_whole(beside, self.to_markdown())
        return path

    def __str__(self) -> str:
        return plain_text(self.tables())

    def _repr_html_(self) -> str:
        return "\n".join(
            part.html() if isinstance(part, Table) else f"<p>{escape(str(part))}</p>" for part in self.tables()
        )


@dataclass(frozen=True)
class Printed(Result):
    """What a command prints and writes, if it is of no use in Python.

    Attributes:
        parts: tables and sentences.
        data: for JSON.
        exit_code: of the command.
    """

    parts: Sequence[Any]
    data: dict[str, Any]
    exit_code: int = 0

    def tables(self) -> Sequence[Any]:
        """Tables and sentences."""
        return self.parts

    def as_dict(self) -> dict[str, Any]:
        """The data."""
        return self.data


def plain_data(value: Any) -> Any:
    """The same as `json` takes it: arrays as lists, numbers that are not finite as None, keys as texts.

    Args:
        value: mappings, sequences, NamedTuples, arrays and numbers, nested.
    """
    if isinstance(value, dict):
        return {str(key): plain_data(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_data(part) for part in value]
    if hasattr(value, "tolist"):  # an array, or a number of NumPy's
        return plain_data(value.tolist())
    return None if isinstance(value, float) and not isfinite(value) else value


def check_page(page: str | Path) -> Path:
    """The path of a page; ValueError if it does not end in .html, or cannot be written."""
    path = Path(page)
    if path.suffix != PAGE:
        raise ValueError(f"a page (--report) must end in {PAGE}, but got {short_repr(str(page))}")
    check_target(path)
    return path


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
    from filters.consistency.nees import span

    return span(value, digits) if isfinite(value.value) else "-"


def number(value: float | None, form: str = ".4g") -> str:
    """A number in a form; a dash where there is none."""
    return "-" if value is None or not isfinite(value) else format(value, form)
