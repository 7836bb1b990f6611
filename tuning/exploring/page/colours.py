"""Colours of the page's pictures on a light and on a dark ground, told apart by all kinds of colour vision."""

from __future__ import annotations

from typing import NamedTuple

from bokeh.models import BoxAnnotation
from bokeh.plotting import figure

HELD = ("#d55e00", "#009e73", "#cc79a7", "#e69f00")  # Okabe, Ito (2008), "Color universal design"


class Colours(NamedTuple):
    """Of one ground."""

    ink: str
    axis: str
    grid: str
    estimate: str
    band: str


LIGHT = Colours(ink="#1b1f24", axis="#4d5661", grid="#e3e6ea", estimate="#0b6bb8", band="#0b6bb8")
DARK = Colours(ink="#f2f4f6", axis="#aab3bd", grid="#333a43", estimate="#62b5f0", band="#62b5f0")


def ground(dark: bool) -> Colours:
    """Those of the ground that the page has."""
    return DARK if dark else LIGHT


def paint(picture: figure, colours: Colours) -> None:
    """Give axes, grid and lines their colours; a glyph says by its renderer's name what it shows."""
    for axis in picture.axis:
        axis.axis_label_text_color = axis.major_label_text_color = colours.axis
        axis.axis_line_color = axis.major_tick_line_color = colours.grid
    picture.grid.grid_line_color = colours.grid
    for renderer in picture.renderers:
        colour = {"truth": colours.ink, "estimate": colours.estimate}.get(renderer.name or "")
        if colour:
            renderer.glyph.line_color = colour
        elif renderer.name == "band":
            renderer.glyph.fill_color = colours.band
        elif renderer.name == "trials":
            renderer.glyph.line_color = colours.ink
    for box in picture.select(BoxAnnotation):
        box.fill_color = colours.band
