"""The picture of one quantity over time, or over lags: a line in its band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure

from tuning.exploring.page.colours import HELD

HEIGHT = 132  # [px]
ROOM = 0.06  # of a range, left free at its ends
KEPT = 0.45  # of an axis that what is drawn has to fill, or the axis is drawn anew
OF_BAND = 98.0  # [%] of a band's points that are always in the picture: at the start it is often much wider


def new_figure(name: str, height: int = HEIGHT, **options: Any) -> figure:
    """An empty picture as wide as its place, on the page's own ground, which a finger scrolls past.

    Its axes stand where they are until the server moves them: pictures are to be compared while one drags, and a
    browser then need not lay them out.
    """
    made = figure(
        name=name,
        height=height,
        sizing_mode="stretch_width",
        tools=options.pop("tools", ""),
        toolbar_location=None,
        x_range=Range1d(0.0, 1.0),
        y_range=Range1d(0.0, 1.0),
        min_border_left=46,
        min_border_right=8,
        background_fill_color=None,
        border_fill_color=None,
        outline_line_color=None,
        **options,
    )
    made.axis.axis_label_text_font_style = "normal"
    made.axis.axis_label_text_font_size = made.axis.major_label_text_font_size = "12px"
    made.axis.minor_tick_line_color = None
    made.xgrid.visible = False
    made.yaxis.ticker.desired_num_ticks = 4
    return made


class Signal:
    """One quantity over time: a line in its band, the truth, other runs, and the held configurations."""

    def __init__(self, name: str, *, level: bool = False):
        """Make it empty.

        Args:
            name: of the figure, by which the page finds its place.
            level: whether it is a NIS or NEES, on a logarithmic axis.
        """
        self.figure = new_figure(name, y_axis_type="log" if level else "linear")
        self.level = level
        self.source = ColumnDataSource({"time": [], "low": [], "high": [], "line": [], "truth": []})
        self.runs = ColumnDataSource({"xs": [], "ys": []})
        self.held = [ColumnDataSource({"time": [], "line": []}) for _ in HELD]
        draw = self.figure
        draw.varea("time", "low", "high", source=self.source, fill_alpha=0.2, name="band")
        self._fan = draw.multi_line("xs", "ys", source=self.runs, line_alpha=0.35, name="estimate", visible=False)
        self._others = [
            draw.line("time", "line", source=held, line_color=colour, line_width=1.3, visible=False)
            for held, colour in zip(self.held, HELD, strict=True)
        ]
        self._truth = draw.line("time", "truth", source=self.source, line_width=1.2, name="truth", visible=False)
        draw.line("time", "line", source=self.source, line_width=1.6, name="estimate")

    def show(
        self,
        time: np.ndarray,
        line: np.ndarray,
        band: tuple[np.ndarray, np.ndarray],
        truth: np.ndarray | None = None,
        runs: Sequence[np.ndarray] = (),
    ) -> None:
        """Draw new numbers, each (points,)."""
        low, high = band
        columns = {"time": time, "low": low, "high": high, "line": line, "truth": line if truth is None else truth}
        self.source.data = {name: as_sent(one) for name, one in columns.items()}
        _set_visible(self._truth, truth is not None)
        _set_visible(self._fan, len(runs) > 0)
        if len(runs) > 0:
            self.runs.data = {"xs": [as_sent(time)] * len(runs), "ys": [as_sent(one) for one in runs]}
        self._frame(time, [line, *([] if truth is None else [truth]), *runs], band)

    def hold(self, slot: int, time: np.ndarray, line: np.ndarray) -> None:
        """Draw a held configuration's line."""
        self.held[slot].data = {"time": as_sent(time), "line": as_sent(line)}
        _set_visible(self._others[slot], True)

    def drop(self, slot: int) -> None:
        """Draw it no longer."""
        _set_visible(self._others[slot], False)

    def _frame(self, time: np.ndarray, lines: list[np.ndarray], band: tuple[np.ndarray, np.ndarray]) -> None:
        """Move the axes where what is drawn leaves them, or has become small in them."""
        ends = [*lines, *_most_of(band)]
        ends = [one[np.isfinite(one) & (one > 0.0 if self.level else True)] for one in ends]
        values = np.concatenate([one for one in ends if len(one)] or [np.ones(1)])
        low, high = float(values.min()), float(values.max())
        if self.level:
            low, high = max(np.log10(low), np.log10(high) - 4.0), np.log10(high)
        if high - low < 1e-9 * max(abs(low), abs(high), 1e-30):
            low, high = low - 0.5, high + 0.5
        axis = self.figure.y_range
        was = (
            (np.log10(axis.start), np.log10(axis.end))
            if self.level and axis.start > 0.0
            else (axis.start, axis.end)
        )
        if not (was[0] <= low and high <= was[1] and high - low >= KEPT * (was[1] - was[0])):
            free = ROOM * (high - low)
            now = low - free, high + free
            axis.update(
                start=10.0 ** now[0] if self.level else now[0], end=10.0 ** now[1] if self.level else now[1]
            )
        if len(time) and (self.figure.x_range.start, self.figure.x_range.end) != (time[0], time[-1]):
            self.figure.x_range.update(start=float(time[0]), end=float(time[-1]))


def as_sent(values: np.ndarray) -> np.ndarray:
    """Numbers in the half as many bytes that a screen needs; without infinite ones, which no axis has."""
    with np.errstate(over="ignore"):
        short = np.asarray(values, dtype=np.float32)
    return np.where(np.isfinite(short), short, np.float32(np.nan))


def _most_of(band: tuple[np.ndarray, np.ndarray]) -> list[np.ndarray]:
    low, high = (one[np.isfinite(one)] for one in band)
    return [
        np.percentile(one, [at], keepdims=False) for one, at in ((low, 100 - OF_BAND), (high, OF_BAND)) if len(one)
    ]


def _set_visible(renderer: Any, visible: bool) -> None:
    if renderer.visible != visible:
        renderer.visible = visible
