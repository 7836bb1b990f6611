"""The common form of pictures, each saved as one PNG, SVG or PDF file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from thruster_env.core.files import write_whole

DARK, BLUE, RUST = "#222222", "#0b6fa4", "#b5541c"
SKY, MUSTARD, GREEN, PLUM, WINE = "#56b4e9", "#c99700", "#009e73", "#b065a0", "#882255"
GREY, PALE, TRUE = "#9aa5ad", "#c5ccd1", "#7d848a"
MOST_POINTS = 600  # of a line, some four in a millimetre


def new_figure(size: tuple[float, float]):
    """An empty figure of a size [inch] that is laid out by itself and belongs to no window."""
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained", dpi=120)


def tidy(axes: Iterable) -> None:
    """Give axes their common form: a faint grid, no frame above and to the right."""
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25, linewidth=0.6)


def grid_of(count: int, columns: int) -> tuple[int, int]:
    """Rows and columns for `count` panels, at most `columns` side by side, and none of the rows empty."""
    columns = max(1, min(columns, count))
    return -(-count // columns), columns


def panels(count: int, columns: int, size: tuple[float, float], extra: float = 0.0, **options):
    """A figure and exactly `count` axes in a grid, in their common form.

    Args:
        count: of panels.
        columns: largest number side by side.
        size: of a panel [inch].
        extra: height for a title or a legend [inch].
        **options: of matplotlib's `subplots`.
    """
    rows, columns = grid_of(count, columns)
    figure = new_figure((size[0] * columns, size[1] * rows + extra))
    axes = list(figure.subplots(rows, columns, squeeze=False, **options).flat)
    for axis in axes[count:]:
        axis.remove()
    tidy(axes[:count])
    return figure, axes[:count]


def thinned(x: np.ndarray, y: np.ndarray, keep: np.ufunc | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Points of a line, (N,) each: of long ones the smallest and the largest value of each stretch.

    Args:
        x: ascending.
        y: values, NaN where there are none.
        keep: `np.fmin` or `np.fmax` for the smallest or the largest alone, as an edge of a band needs it.
    """
    if len(x) <= MOST_POINTS:
        return x, y
    points = 3 if keep is None and np.isnan(y).any() else 2  # of a stretch: a gap is one more
    parts = np.array_split(np.arange(len(x)), MOST_POINTS // points)
    if keep is not None:
        return np.array([x[part].mean() for part in parts]), np.array([keep.reduce(y[part]) for part in parts])
    low, high = np.where(np.isfinite(y), y, np.inf), np.where(np.isfinite(y), y, -np.inf)
    ends = [part[index] for part in parts for index in (low[part].argmin(), high[part].argmax())]
    gaps = [part[np.isnan(y[part])][:1] for part in parts]
    indices = np.unique(np.concatenate([ends, *gaps])).astype(np.int64)
    return x[indices], y[indices]


def save_figure(figure, path: str | Path) -> Path:
    """Write a figure as SVG or PDF where the name ends so, else as PNG, whole or not at all; return the path."""
    form = {".svg": "svg", ".pdf": "pdf"}.get(Path(path).suffix, "png")
    write_whole(path, lambda stream: figure.savefig(stream, format=form))
    return Path(path)
