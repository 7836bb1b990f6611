"""The pictures of the page: those of a `View` over time or lags, and a `Map` of score or NIS over two knobs.

A `View` has states with their band, innovations, NIS and NEES, and autocorrelation. All that the page draws next
goes in one message: several would be drawn in as many frames of the screen.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from bokeh.events import Tap
from bokeh.models import (
    BasicTicker,
    BoxAnnotation,
    ColorBar,
    ColumnDataSource,
    CustomJSTickFormatter,
    LogColorMapper,
    Range1d,
)
from bokeh.palettes import Cividis256, RdBu11
from bokeh.plotting import figure

from tuning.exploring.bench import Bench, Map, Trial
from tuning.exploring.view import WITHIN_95, Knob, View, mean_of_runs, present

Column = np.ndarray | Sequence[np.ndarray]
HELD = ("#d55e00", "#009e73", "#cc79a7", "#e69f00")  # Okabe, Ito (2008), "Color universal design"
HEIGHT = 132  # [px]
ROOM = 0.06  # of a range, left free at its ends
KEPT = 0.45  # of an axis that what is drawn has to fill, or the axis is drawn anew
OF_BAND = 0.98  # of a band's points that are always in the picture: at the start it is often much wider
SHOWN = 3  # states at first
Look = tuple[int, int, bool]  # points across, which run, and whether errors are drawn in place of states
MAP_HEIGHT = 330  # [px]
BAD = 5.0  # times the least score, where the scale of colours ends
TICKS = "const size = log ? 10**tick : tick; return size < 1e-2 || size >= 1e4 ? size.toExponential(log ? 0 : 1)"


class Sent:
    """Columns of numbers and ends of axes that wait to be sent.

    The script of the page puts them into the models of the same names (`draw` in page.js). Those of the server
    keep what they began with.
    """

    def __init__(self) -> None:
        """Nothing waits."""
        self._columns: dict[str, dict[str, Column]] = {}
        self._axes: dict[str, dict[str, tuple[float, float]]] = {}

    def columns(self, source: str, columns: dict[str, Column]) -> None:
        """All columns of a source: numbers, or several lines of numbers."""
        self._columns[source] = columns

    def axis(self, figure: str, axis: str, start: float, end: float) -> None:
        """The ends of a figure's axis, "x" or "y"."""
        self._axes.setdefault(figure, {})[axis] = start, end

    def take(self) -> dict[str, Any]:
        """All that waits: float32 numbers in base 64, and which parts of them are whose; empty if nothing does."""
        numbers: list[np.ndarray] = []
        size = 0

        def part(column: Column) -> list:
            nonlocal size
            if not isinstance(column, np.ndarray):
                return [part(line) for line in column]
            numbers.append(as_sent(column))
            size += column.size
            return [size - column.size, size]

        parts = {
            source: {name: part(column) for name, column in columns.items()}
            for source, columns in self._columns.items()
        }
        axes, self._columns, self._axes = self._axes, {}, {}
        if not (parts or axes):
            return {}
        sent = b"".join(array.tobytes() for array in numbers)
        return {"numbers": base64.b64encode(sent).decode(), "columns": parts, "axes": axes}


def as_sent(values: np.ndarray) -> np.ndarray:
    """Numbers in the half as many bytes that a screen needs; without infinite ones, which no axis has."""
    with np.errstate(over="ignore"):
        short = np.asarray(values, dtype=np.float32)
    return np.where(np.isfinite(short), short, np.float32(np.nan)).astype("<f4", copy=False)


def drawn_steps(steps: int, width: int) -> np.ndarray:
    """Which steps are drawn on so many pixels: all, or evenly spaced ones from the first to the last."""
    if steps <= width:
        return np.arange(steps)
    return np.linspace(0, steps - 1, width).round().astype(int)


def extremes(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Of each stretch between two places the value farthest from the mean, so that no peak is lost.

    Args:
        values: (steps,).
        at: places of `drawn_steps`, (points,).

    Returns:
        (points,); NaN where a stretch has no number.
    """
    if len(at) == len(values):
        return values
    finite = np.isfinite(values)
    centre = values[finite].mean() if finite.any() else 0.0
    away = np.where(finite, np.abs(values - centre), -1.0)
    largest = np.maximum.reduceat(away, at)
    interval = np.searchsorted(at, np.arange(len(values)), side="right") - 1
    peaks = np.flatnonzero(away == largest[interval])
    first = peaks[np.unique(interval[peaks], return_index=True)[1]]
    return values[first]


def corners(*lines: np.ndarray) -> np.ndarray:
    """Places that are enough to draw lines, (points,) each: those within a stretch where all are level are not."""
    same = np.ones(len(lines[0]) - 1, dtype=bool)
    for line in lines:
        same &= (line[1:] == line[:-1]) | (np.isnan(line[1:]) & np.isnan(line[:-1]))
    return np.flatnonzero(~(np.append(False, same) & np.append(same, False)))


class Colours(NamedTuple):
    """Of one ground."""

    ink: str
    axis: str
    grid: str
    estimate: str
    band: str


DARK = Colours(ink="#f2f4f6", axis="#aab3bd", grid="#333a43", estimate="#62b5f0", band="#62b5f0")


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


def new_figure(name: str, height: int = HEIGHT, **options: Any) -> figure:
    """An empty picture as wide as its place, on the page's own ground, which a finger scrolls past.

    Its axes stand where they are until the server moves them: pictures are to be compared while one drags, and a
    browser then need not lay them out.
    """
    empty = figure(
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
    empty.axis.axis_label_text_font_style = "normal"
    empty.axis.axis_label_text_font_size = empty.axis.major_label_text_font_size = "12px"
    empty.axis.minor_tick_line_color = None
    empty.xgrid.visible = False
    empty.yaxis.ticker.desired_num_ticks = 4
    return empty


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
            draw.line("time", "line", source=source, line_color=colour, visible=False)
            for source, colour in zip(self.held, HELD, strict=True)
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
        for what, names, mask in parts:
            self.sent.columns(
                f"{self.name} {what}", {column: self.columns[column][mask] for column in ("time", *names)}
            )
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
        ends = [end[np.isfinite(end) & (end > 0.0 if self.level else True)] for end in ends]
        values = np.concatenate([end for end in ends if len(end)] or [np.ones(1)])
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
    low, high = (np.sort(edge[np.isfinite(edge)]) for edge in band)
    within = [int(share * (len(edge) - 1)) for edge, share in ((low, 1.0 - OF_BAND), (high, OF_BAND))]
    return [edge[[at]] for edge, at in zip((low, high), within, strict=True) if len(edge)]


def _set_visible(renderer: Any, visible: bool) -> None:
    if renderer.visible != visible:
        renderer.visible = visible


class Pictures:
    """All pictures over time of one bench, and what they show."""

    def __init__(self, bench: Bench, sent: Sent):
        """Make them empty; `sent` takes what is to be drawn."""
        self.sent = sent
        self.states = [Signal(f"state{i}", sent) for i in range(len(bench.states))]
        self.innovations = [Signal(f"innovation{i}", sent) for i in range(len(bench.measurements))]
        self.nis = Signal("nis", sent, level=True)
        self.nees = [Signal("nees", sent, level=True)] if bench.has_truth else []
        self.lags = ColumnDataSource({"lag": [], "value": []}, name="lags")
        self.autocorrelation = new_figure("autocorrelation")
        self.autocorrelation.y_range.update(start=-1.0, end=1.0)
        self.white = BoxAnnotation(bottom=0.0, top=0.0, fill_alpha=0.18, line_color=None)
        self.autocorrelation.add_layout(self.white)
        self.autocorrelation.segment("lag", 0, "lag", "value", source=self.lags, line_width=3, name="estimate")
        self.chosen: tuple[int, ...] = ()
        self.choose(range(SHOWN))

    @property
    def signals(self) -> list[Signal]:
        """All that are drawn over time."""
        return [*self.states, *self.innovations, self.nis, *self.nees]

    @property
    def figures(self) -> list[figure]:
        """All figures, in the order of the page."""
        return [*(signal.figure for signal in self.signals), self.autocorrelation]

    def choose(self, states: Sequence[int]) -> None:
        """Which states are drawn."""
        self.chosen = tuple(i for i in states if 0 <= i < len(self.states))
        for i, signal in enumerate(self.states):
            signal.figure.visible = i in self.chosen

    def paint(self, colours: Colours) -> None:
        """Colour all of them."""
        for picture in self.figures:
            paint(picture, colours)
        self.white.fill_color = colours.band

    def show(self, view: View, look: Look) -> None:
        """Draw a view: one run's states, or the errors of all runs; what all runs say of consistency."""
        width, run, errors = look
        at = drawn_steps(view.time.shape[1], width)
        run = min(run, len(view.estimate) - 1)
        time = view.time[run, at]
        for i in self.chosen:
            band = band_of(view, i, run, at, errors)
            line, truth, runs = lines_of(view, i, run, at, errors)
            self.states[i].show(time, line, band, truth, runs)
        for i, signal in enumerate(self.innovations):
            half = WITHIN_95 * view.innovation_deviation[run, at, i]
            signal.show(time, extremes(view.innovation[run, :, i], at), (-half, half))
        for signal, values, (low, high) in self._levels(view):
            signal.show(time, extremes(mean_of_runs(values), at), (low[at], high[at]))
        self._show_lags(view)

    def _levels(self, view: View) -> list[tuple[Signal, np.ndarray, tuple[np.ndarray, np.ndarray]]]:
        levels = [(self.nis, view.nis, view.nis_band)]
        if self.nees and view.nees is not None and view.nees_band is not None:
            levels.append((self.nees[0], view.nees, view.nees_band))
        return levels

    def _show_lags(self, view: View) -> None:
        values = np.asarray(view.autocorrelation)
        channels, lags = values.shape
        shift = (np.arange(channels) - (channels - 1) / 2) * 0.6 / max(channels, 1)
        lag = (np.arange(1, lags + 1)[None, :] + shift[:, None]).ravel()
        self.sent.columns("lags", {"lag": lag, "value": values.ravel()})
        if self.white.top != view.autocorrelation_band:
            self.white.update(bottom=-view.autocorrelation_band, top=view.autocorrelation_band)
            self.autocorrelation.x_range.update(start=0.0, end=lags + 1.0)

    def hold(self, slot: int, view: View, look: Look) -> None:
        """Draw a held configuration in its colour."""
        width, run, errors = look
        at = drawn_steps(view.time.shape[1], width)
        run = min(run, len(view.estimate) - 1)
        time = view.time[run, at]
        for i, signal in enumerate(self.states):
            signal.hold(slot, time, lines_of(view, i, run, at, errors)[0])
        for i, signal in enumerate(self.innovations):
            signal.hold(slot, time, extremes(view.innovation[run, :, i], at))
        for signal, values, _ in self._levels(view):
            signal.hold(slot, time, extremes(mean_of_runs(values), at))

    def drop(self, slot: int) -> None:
        """Draw a held configuration no longer."""
        for signal in self.signals:
            signal.drop(slot)


def band_of(view: View, i: int, run: int, at: np.ndarray, errors: bool) -> tuple[np.ndarray, np.ndarray]:
    """Where 95 % of a run's states lie, or of its errors."""
    half = WITHIN_95 * view.deviation[run, at, i]
    middle = 0.0 if errors and view.truth is not None else view.estimate[run, at, i]
    return middle - half, middle + half


def lines_of(view: View, i: int, run: int, at: np.ndarray, errors: bool) -> tuple:
    """A run's estimate of a state, and the truth; or if `errors` x_hat - x of this run, and of the others."""
    mean = view.estimate[run, at, i]
    if view.truth is None:
        return mean, None, ()
    if not errors:
        return mean, view.truth[run, at, i], ()
    fan = view.estimate[:, at, i] - view.truth[:, at, i]
    return fan[run], None, [errors_of_run for number, errors_of_run in enumerate(fan) if number != run]


TICKS += " : String(+size.toPrecision(3))"


class MapPicture:
    """Score or NIS over two knobs; a click takes their values."""

    def __init__(self, knobs: Sequence[Knob], on_click: Callable[[dict[str, float]], None], sent: Sent):
        """Make it empty.

        Args:
            knobs: all that may be an axis.
            on_click: called with the two values of a click.
            sent: takes where one is.
        """
        self.set_knobs(knobs)
        self._taken, self._sent = on_click, sent
        self.map: Map | None = None
        self.figure = new_figure("map", MAP_HEIGHT, tools="tap")
        self.image = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        self.trials, self.path = (ColumnDataSource({"x": [], "y": []}) for _ in range(2))
        self.here: dict[str, list[float]] = {}
        here = ColumnDataSource({"x": [], "y": []}, name="where one is")
        self.mapper = LogColorMapper(palette=Cividis256[::-1], low=1.0, high=BAD)
        draw = self.figure
        draw.image("image", "x", "y", "dw", "dh", source=self.image, color_mapper=self.mapper)
        top = {"level": "overlay"}  # on a canvas of its own: the map need not be drawn again
        draw.line("x", "y", source=self.path, line_width=2, name="trials", **top)
        draw.scatter(
            "x", "y", source=self.trials, size=7, fill_color="white", line_width=1.2, name="trials", **top
        )
        cross = {"source": here, "marker": "cross", **top}  # light around dark: it is seen on all colours
        draw.scatter("x", "y", size=20, line_color="white", line_width=6, **cross)
        draw.scatter("x", "y", size=18, line_color="#1b1f24", line_width=2.5, **cross)
        self.bar = ColorBar(color_mapper=self.mapper, width=12, padding=4, background_fill_color=None)
        self.bar.major_label_text_font_size = "12px"
        draw.add_layout(self.bar, "right")
        draw.on_event(Tap, self._click)
        for axis in (draw.xaxis[0], draw.yaxis[0]):
            axis.ticker = BasicTicker(desired_num_ticks=5, mantissas=[1, 2, 5])
            axis.formatter = CustomJSTickFormatter(args={"log": True}, code=TICKS)

    def set_knobs(self, knobs: Sequence[Knob]) -> None:
        """Begin anew with another filter's knobs."""
        self._knobs = {knob.name: knob for knob in knobs}
        self.map = None

    def paint(self, colours: Colours) -> None:
        """Colour it."""
        paint(self.figure, colours)
        self.bar.major_label_text_color = colours.axis

    def show(self, map_: Map, what: str) -> None:
        """Draw a map: its "score", or its "nis"."""
        self.map = map_
        values = np.array(map_.nis if what == "nis" else map_.score, dtype=float)
        values[~np.isfinite(values) | (values <= 0.0)] = np.nan
        if what == "nis":
            self.mapper.update(palette=RdBu11, low=0.1, high=10.0)
        else:
            least = float(np.nanmin(values)) if np.isfinite(values).any() else 1.0
            self.mapper.update(palette=Cividis256[::-1], low=least, high=BAD * least)
        (left, width), (bottom, height) = (
            self._extent(name, along) for name, along in ((map_.x, map_.xs), (map_.y, map_.ys))
        )
        self.image.data = {"image": [as_sent(values)], "x": [left], "y": [bottom], "dw": [width], "dh": [height]}
        for axis, name in ((self.figure.xaxis[0], map_.x), (self.figure.yaxis[0], map_.y)):
            knob = self._knobs[name]
            axis.axis_label = f"{knob.label} [{knob.unit}]" if knob.unit else knob.label
            axis.formatter.args = {"log": knob.log}
        self.figure.x_range.update(start=left, end=left + width)
        self.figure.y_range.update(start=bottom, end=bottom + height)

    def mark(self, values: Mapping[str, float]) -> None:
        """Draw where one is."""
        if self.map is None:
            return
        now = {"x": [self._place(self.map.x, values)], "y": [self._place(self.map.y, values)]}
        if self.here != now:
            self.here = now
            self._sent.columns("where one is", {axis: np.array(at) for axis, at in now.items()})

    def points(self, trials: Sequence[Trial]) -> None:
        """Draw a study's trials, and the path of the best one so far."""
        if self.map is None:
            return
        least, path = np.inf, []
        for trial in trials:
            if trial.score < least and not trial.pruned:
                least = trial.score
                path.append(trial)
        for source, points in ((self.trials, trials), (self.path, path)):
            source.data = {
                axis: np.array([self._place(name, trial.values) for trial in points], dtype=float)
                for axis, name in (("x", self.map.x), ("y", self.map.y))
            }

    def _place(self, name: str, values: Mapping[str, float]) -> float:
        value = values.get(name, np.nan)
        if not self._knobs[name].log:
            return value
        return float(np.log10(value)) if value > 0.0 else np.nan

    def _extent(self, name: str, along: np.ndarray) -> tuple[float, float]:
        """The beginning and the length of an axis, whose outermost points are the middles of their cells."""
        at = np.log10(along) if self._knobs[name].log else np.asarray(along, dtype=float)
        step = (at[-1] - at[0]) / (len(at) - 1)
        return float(at[0] - step / 2), float(at[-1] - at[0] + step)

    def _click(self, event: Tap) -> None:
        if self.map is None:
            return
        values = {}
        for name, at in ((self.map.x, event.x), (self.map.y, event.y)):
            knob = self._knobs[name]
            value = 10.0**at if knob.log else at
            value = min(max(value, knob.low), knob.high)
            values[name] = float(round(value)) if knob.integer else value
        self._taken(values)
