"""The picture of one quantity over time, or over lags: a line in its band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure

from tuning.exploring.figure import present
from tuning.exploring.page.colours import HELD
from tuning.exploring.page.sent import Sent, as_sent
from tuning.exploring.page.thinning import corners

HEIGHT = 132  # [px]
ROOM = 0.06  # of a range, left free at its ends
KEPT = 0.45  # of an axis that what is drawn has to fill, or the axis is drawn anew
OF_BAND = 0.98  # of a band's points that are always in the picture: at the start it is often much wider


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

    def __init__(self, name: str, sent: Sent, *, level: bool = False):
        """Make it empty.

        Args:
            name: of the figure, by which the page finds its place.
            sent: takes what is to be drawn.
            level: whether it is a NIS or NEES, on a logarithmic axis.
        """
        self.figure = new_figure(name, y_axis_type="log" if level else "linear")
        self.name, self.sent, self.level = name, sent, level
        self.columns: dict[str, np.ndarray] = {}  # what is drawn
        self.runs: list[np.ndarray] = []
        self._across = self._along = (0.0, 1.0)  # ends of the axes, of y as they are drawn
        lines = ColumnDataSource({"time": [], "line": [], "truth": []}, name=f"{name} lines")
        between = ColumnDataSource({"time": [], "low": [], "high": []}, name=f"{name} band")
        self._runs = ColumnDataSource({"xs": [], "ys": []}, name=f"{name} runs")
        self.held = [ColumnDataSource({"time": [], "line": []}) for _ in HELD]
        draw = self.figure
        draw.varea("time", "low", "high", source=between, fill_alpha=0.2, name="band")
        self._fan = draw.multi_line("xs", "ys", source=self._runs, line_alpha=0.35, name="estimate", visible=False)
        self._others = [
            draw.line("time", "line", source=held, line_color=colour, visible=False)
            for held, colour in zip(self.held, HELD, strict=True)
        ]
        self._truth = draw.line("time", "truth", source=lines, name="truth", visible=False)
        draw.line("time", "line", source=lines, name="estimate")

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
        self.columns = {"time": time, "low": low, "high": high, "line": line}
        self.columns["truth"] = line if truth is None else truth
        parts = ("band", ("low", "high"), corners(low, high)), ("lines", ("line", "truth"), ~np.isnan(line))
        for what, names, some in parts:
            self.sent.columns(f"{self.name} {what}", {one: self.columns[one][some] for one in ("time", *names)})
        self.runs = list(runs)
        _set_visible(self._truth, truth is not None)
        _set_visible(self._fan, len(runs) > 0)
        if self.runs:
            self.sent.columns(f"{self.name} runs", {"xs": [time] * len(runs), "ys": self.runs})
        self._frame(time, [line, *([] if truth is None else [truth]), *runs], band)

    def hold(self, slot: int, time: np.ndarray, line: np.ndarray) -> None:
        """Draw a held configuration's line."""
        at, values = present(time, line)
        self.held[slot].data = {"time": as_sent(at), "line": as_sent(values)}
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
        was = self._across
        if not (was[0] <= low and high <= was[1] and high - low >= KEPT * (was[1] - was[0])):
            free = ROOM * (high - low)
            self._across = start, end = low - free, high + free
            self.sent.axis(self.name, "y", *((10.0**start, 10.0**end) if self.level else (start, end)))
        if len(time) and self._along != (time[0], time[-1]):
            self._along = float(time[0]), float(time[-1])
            self.sent.axis(self.name, "x", *self._along)


def _most_of(band: tuple[np.ndarray, np.ndarray]) -> list[np.ndarray]:
    """Where most of a band ends, below and above."""
    low, high = (np.sort(one[np.isfinite(one)]) for one in band)
    within = [int(share * (len(one) - 1)) for one, share in ((low, 1.0 - OF_BAND), (high, OF_BAND))]
    return [one[[at]] for one, at in zip((low, high), within, strict=True) if len(one)]


def _set_visible(renderer: Any, visible: bool) -> None:
    if renderer.visible != visible:
        renderer.visible = visible
