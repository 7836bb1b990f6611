"""Pictures of a page, each with its own ids."""

from __future__ import annotations

from itertools import count
from typing import TYPE_CHECKING

from tuning.reporting.page import Picture
from tuning.reporting.svg import figure_svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Sketchbook:
    """Numbers pictures, each with a caption and a text alternative."""

    def __init__(self, prefix: str = "p"):
        """Pictures are called by a prefix and a number."""
        self._names = (f"{prefix}{number}" for number in count(1))

    def picture(self, figure: Figure, caption: str, alt: str) -> Picture:
        """A figure as a part of a page."""
        svg, readings = figure_svg(figure, next(self._names))
        return Picture(svg, caption, alt, readings)
