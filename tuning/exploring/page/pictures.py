"""The pictures of a `View`: states with their band, innovations, NIS and NEES, autocorrelation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import BoxAnnotation, ColumnDataSource
from bokeh.plotting import figure

from tuning.exploring.bench import Bench
from tuning.exploring.figure import WITHIN_95, mean_of_runs
from tuning.exploring.page.colours import Colours, paint
from tuning.exploring.page.sent import Sent
from tuning.exploring.page.signal import Signal, new_figure
from tuning.exploring.page.thinning import extremes, places
from tuning.exploring.view import View

SHOWN = 3  # states at first
Look = tuple[int, int, bool]  # points across, which run, and whether errors are drawn in place of states


class Pictures:
    """All pictures over time of one bench, and what they show."""

    def __init__(self, bench: Bench, sent: Sent):
        """Make them empty; `sent` takes what is to be drawn."""
        self.sent = sent
        self.states = [Signal(f"state{place}", sent) for place in range(len(bench.states))]
        self.innovations = [Signal(f"innovation{place}", sent) for place in range(len(bench.measurements))]
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
        return [*(one.figure for one in self.signals), self.autocorrelation]

    def choose(self, states: Sequence[int]) -> None:
        """Which states are drawn."""
        self.chosen = tuple(place for place in states if 0 <= place < len(self.states))
        for place, one in enumerate(self.states):
            one.figure.visible = place in self.chosen

    def paint(self, colours: Colours) -> None:
        """Colour all of them."""
        for one in self.figures:
            paint(one, colours)
        self.white.fill_color = colours.band

    def show(self, view: View, look: Look) -> None:
        """Draw a view: one run's states, or the errors of all runs; what all runs say of consistency."""
        width, run, errors = look
        at = places(view.time.shape[1], width)
        run = min(run, len(view.estimate) - 1)
        time = view.time[run, at]
        for place in self.chosen:
            band = band_of(view, place, run, at, errors)
            line, truth, runs = lines_of(view, place, run, at, errors)
            self.states[place].show(time, line, band, truth, runs)
        for place, one in enumerate(self.innovations):
            half = WITHIN_95 * view.innovation_deviation[run, at, place]
            one.show(time, extremes(view.innovation[run, :, place], at), (-half, half))
        for one, values, (low, high) in self._levels(view):
            one.show(time, extremes(mean_of_runs(values), at), (low[at], high[at]))
        self._show_lags(view)

    def _levels(self, view: View) -> list[tuple[Signal, np.ndarray, tuple[np.ndarray, np.ndarray]]]:
        found = [(self.nis, view.nis, view.nis_band)]
        if self.nees and view.nees is not None and view.nees_band is not None:
            found.append((self.nees[0], view.nees, view.nees_band))
        return found

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
        at = places(view.time.shape[1], width)
        run = min(run, len(view.estimate) - 1)
        time = view.time[run, at]
        for place, one in enumerate(self.states):
            one.hold(slot, time, lines_of(view, place, run, at, errors)[0])
        for place, one in enumerate(self.innovations):
            one.hold(slot, time, extremes(view.innovation[run, :, place], at))
        for one, values, _ in self._levels(view):
            one.hold(slot, time, extremes(mean_of_runs(values), at))

    def drop(self, slot: int) -> None:
        """Draw a held configuration no longer."""
        for one in self.signals:
            one.drop(slot)


def band_of(view: View, place: int, run: int, at: np.ndarray, errors: bool) -> tuple[np.ndarray, np.ndarray]:
    """Where 95 % of a run's states lie, or of its errors."""
    half = WITHIN_95 * view.deviation[run, at, place]
    middle = 0.0 if errors and view.truth is not None else view.estimate[run, at, place]
    return middle - half, middle + half


def lines_of(view: View, place: int, run: int, at: np.ndarray, errors: bool) -> tuple:
    """A run's estimate of a state, and the truth; or if `errors` x_hat - x of this run, and of the others."""
    mean = view.estimate[run, at, place]
    if view.truth is None:
        return mean, None, ()
    if not errors:
        return mean, view.truth[run, at, place], ()
    fan = view.estimate[:, at, place] - view.truth[:, at, place]
    return fan[run], None, [one for number, one in enumerate(fan) if number != run]
