"""The common form of pictures, each saved as one PNG file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from numerics.files import write_whole

DARK, BLUE, RUST = "#222222", "#0b6fa4", "#b5541c"


def new_figure(size: tuple[float, float]):
    """An empty figure of a size [inch] that is laid out by itself and belongs to no window."""
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained", dpi=120)


def tidy(axes: Iterable) -> None:
    """Give axes their common form: a faint grid, no frame above and to the right."""
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25, linewidth=0.6)


def save_figure(figure, path: str | Path) -> Path:
    """Write a figure as PNG, whole or not at all; return the path."""
    write_whole(path, lambda stream: figure.savefig(stream, format="png"))
    return Path(path)
