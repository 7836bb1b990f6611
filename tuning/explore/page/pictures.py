"""The pictures of a `View`: states with their band, innovations, NIS and NEES, autocorrelation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import BoxAnnotation, ColumnDataSource, CustomJSTickFormatter, Span
from bokeh.plotting import figure

from tuning.explore.bench import Bench, View
from tuning.explore.figure import WITHIN_95, mean_of_runs
from tuning.explore.page.colours import HELD, Colours, paint
from tuning.explore.page.thinning import extremes, places

SHOWN = 3  # states at first
HEIGHT = 150  # [px]
PLAIN = CustomJSTickFormatter(code="return String(+tick.toPrecision(4)).replace('-', '\\u2212')")


def new_figure(name: str, x: str, y: str, height: int = HEIGHT, **options: Any) -> figure:
    """An empty picture as wide as its place, on the page's own ground, which a finger scrolls past."""
    made = figure(
        name=name,
        height=height,
        sizing_mode="stretch_width",
        tools=options.pop("tools", ""),
        toolbar_location=None,
        x_axis_label=x,
        y_axis_label=y,
        min_border_left=58,
        background_fill_color=None,
        border_fill_color=None,
        outline_line_color=None,
        **options,
    )
    made.axis.axis_label_text_font_style = "normal"
    made.axis.axis_label_text_font_size = made.axis.major_label_text_font_size = "12px"
    made.axis.minor_tick_line_color = None
    made.yaxis.ticker.desired_num_ticks = 4
    return made


class Signal:
    """One quantity over time: a line in its band, the truth if there is one, and the held configurations."""

    def __init__(self, name: str, label: str, *, fan: int = 0, level: bool = False):
        """Make it empty.

        Args:
            name: of the figure, by which the page finds its place.
            label: of the y axis.
            fan: how many further runs are drawn as thin lines.
            level: whether it is a NIS or NEES: on a logarithmic axis, with a fixed interval for a band.
        """
        self.figure = new_figure(name, "time [s]", label, y_axis_type="log" if level else "linear")
        self.level = level
        columns = ["time", "low", "high", "line", "truth", *(f"run{number}" for number in range(fan))]
        self.source = ColumnDataSource({column: [] for column in columns})
        self.held = [ColumnDataSource({"time": [], "line": []}) for _ in HELD]
        draw = self.figure
        if level:
            self.interval = BoxAnnotation(fill_alpha=0.18, line_color=None)
            draw.add_layout(self.interval)
        else:
            draw.varea("time", "low", "high", source=self.source, fill_alpha=0.2, name="band")
            draw.add_layout(Span(location=0.0, dimension="width", line_alpha=0.0))
        for number in range(fan):
            draw.line("time", f"run{number}", source=self.source, line_alpha=0.35, name="estimate")
        for held, colour in zip(self.held, HELD, strict=True):
            draw.line("time", "line", source=held, line_color=colour, line_width=1.3, name="held")
        draw.line("time", "truth", source=self.source, line_width=1.2, name="truth")
        draw.line("time", "line", source=self.source, line_width=1.6, name="estimate")
        self._columns = columns

    def show(self, **columns: np.ndarray) -> None:
        """Draw new numbers, each (points,); what is left out is not drawn."""
        nothing = np.full(len(columns["time"]), np.nan, dtype=np.float32)
        self.source.data = {name: as_sent(columns.get(name, nothing)) for name in self._columns}

    def hold(self, slot: int, time: np.ndarray | None, line: np.ndarray | None) -> None:
        """Draw a held configuration's line, or none."""
        empty = time is None or line is None
        self.held[slot].data = (
            {"time": [], "line": []} if empty else {"time": as_sent(time), "line": as_sent(line)}
        )


def as_sent(values: np.ndarray) -> np.ndarray:
    """Numbers in the half as many bytes that a screen needs; without infinite ones, which no axis has."""
    with np.errstate(over="ignore"):
        short = np.asarray(values, dtype=np.float32)
    return np.where(np.isfinite(short), short, np.float32(np.nan))


class Pictures:
    """All pictures over time of one bench, and what they show."""

    def __init__(self, bench: Bench, seeds: int):
        """Make them empty, for as many runs at once."""
        self.bench, self.seeds = bench, seeds
        labels = [f"{name} [{unit}]" if unit else name for name, unit in bench.states]
        self.states = [Signal(f"state{place}", label, fan=seeds) for place, label in enumerate(labels)]
        named = [f"{name} [{unit}]" if unit else name for name, unit in bench.measurements]
        self.innovations = [Signal(f"innovation{place}", label) for place, label in enumerate(named)]
        self.nis = Signal("nis", "NIS", level=True)
        self.nees = [Signal("nees", "NEES", level=True)] if bench.has_truth else []
        self.lags = ColumnDataSource({"lag": [], "value": []})
        self.autocorrelation = self._autocorrelation()
        self.chosen: tuple[int, ...] = tuple(range(min(SHOWN, len(self.states))))
        self.choose(self.chosen)

    @property
    def signals(self) -> list[Signal]:
        """All that are drawn over time."""
        return [*self.states, *self.innovations, self.nis, *self.nees]

    @property
    def figures(self) -> list[figure]:
        """All figures, in the order of the page."""
        return [*(one.figure for one in self.signals), self.autocorrelation]

    def _autocorrelation(self) -> figure:
        made = new_figure("autocorrelation", "lag [steps]", "autocorrelation", y_range=(-1.0, 1.0))
        self.white = BoxAnnotation(fill_alpha=0.18, line_color=None)
        made.add_layout(self.white)
        made.segment("lag", 0, "lag", "value", source=self.lags, line_width=3, name="estimate")
        return made

    def choose(self, states: Sequence[int]) -> None:
        """Which states are drawn."""
        self.chosen = tuple(place for place in states if 0 <= place < len(self.states))
        for place, one in enumerate(self.states):
            one.figure.visible = place in self.chosen

    def paint(self, colours: Colours) -> None:
        """Colour all of them."""
        for one in self.figures:
            paint(one, colours)

    def show(self, view: View, width: int, run: int, errors: bool) -> None:
        """Draw a view: one run's states, or the errors of all runs; what all runs say of consistency."""
        at = places(len(view.time), width)
        time = view.time[at]
        run = min(run, len(view.estimate) - 1)
        for place in self.chosen:
            self.states[place].show(time=time, **state_lines(view, place, run, at, errors))
        for place, one in enumerate(self.innovations):
            half = WITHIN_95 * view.innovation_deviation[run, at, place]
            one.show(time=time, low=-half, high=half, line=extremes(view.innovation[run, :, place], at))
        for name, one in (("nis", self.nis), *(("nees", one) for one in self.nees)):
            one.show(time=time, line=extremes(mean_of_runs(getattr(view, name)), at))
            low, high = getattr(view, f"{name}_band")
            if (one.interval.bottom, one.interval.top) != (low, high):
                one.interval.update(bottom=low, top=high)
        self._show_lags(view)

    def _show_lags(self, view: View) -> None:
        values = np.asarray(view.autocorrelation)
        channels, lags = values.shape
        shift = (np.arange(channels) - (channels - 1) / 2) * 0.6 / max(channels, 1)
        lag = (np.arange(1, lags + 1)[None, :] + shift[:, None]).ravel()
        self.lags.data = {"lag": as_sent(lag), "value": as_sent(values.ravel())}
        if self.white.top != view.autocorrelation_band:
            self.white.update(bottom=-view.autocorrelation_band, top=view.autocorrelation_band)

    def hold(self, slot: int, view: View | None, width: int, run: int, errors: bool) -> None:
        """Draw a held configuration in its colour, or with None clear it."""
        if view is None:
            for one in self.signals:
                one.hold(slot, None, None)
            return
        at = places(len(view.time), width)
        time, run = view.time[at], min(run, len(view.estimate) - 1)
        for place, one in enumerate(self.states):
            one.hold(slot, time, state_lines(view, place, run, at, errors)["line"])
        for place, one in enumerate(self.innovations):
            one.hold(slot, time, extremes(view.innovation[run, :, place], at))
        self.nis.hold(slot, time, extremes(mean_of_runs(view.nis), at))
        for one in self.nees:
            one.hold(slot, time, extremes(mean_of_runs(view.nees), at))


def state_lines(view: View, place: int, run: int, at: np.ndarray, errors: bool) -> dict[str, np.ndarray]:
    """What is drawn of one state: of one run with its 95 % band, or if `errors` x_hat - x of all runs."""
    mean, half = view.estimate[run, at, place], WITHIN_95 * view.deviation[run, at, place]
    if view.truth is None:
        return {"line": mean, "low": mean - half, "high": mean + half}
    truth = view.truth[run, at, place]
    if not errors:
        return {"line": mean, "low": mean - half, "high": mean + half, "truth": truth}
    fan = view.estimate[:, at, place] - view.truth[:, at, place]
    others = {f"run{number}": one for number, one in enumerate(fan) if number != run}
    return {"line": mean - truth, "low": -half, "high": half, **others}
