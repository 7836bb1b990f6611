"""What is found in a column of numbers: the model, Q and R with intervals, what they mean, and a picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import chdtrc

from filters.bounds import steady_state
from filters.consistency.nees import LAGS, Whiteness, whiteness
from filters.engine.batch import Prepared
from filters.gaussian.kalman import KalmanFilter
from filters.models import MOST_HARMONICS, named_model
from filters.named import NamedMaker, text_of
from filters.runs import FilteredRuns
from thruster_env.core.streams import filter_keys
from thruster_env.core.text_tables import Table, Unfolded
from thruster_env.model.affine import AffineModel
from thruster_env.model.continuous import ContinuousModel
from tuning.api.result import Result, frame, plain_data
from tuning.likelihood.ascent import climb
from tuning.series.column import LEAST_ROWS, Column, seconds_text
from tuning.series.fit import CANDIDATES, Candidate, Choice, Number, behind, choose, filtered
from tuning.series.likelihood import ColumnLikelihood, R, model_of
from tuning.series.paste import ARDUINO, BURST, UnequalSteps, lines_of

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

LONGEST_SEASON = 12  # values of a pattern that is tried, each of which is a state
MOST_LAGS = 4  # of an autoregression that is tried
WHITE = 0.001  # probability from which innovations count as white
HIDDEN = 1e-9  # share of a mode in the measurements, below which they do not show it
SLOW = 1e-3  # Hz, below which a frequency is also given as a period
PERIODIC = {"harmonic", "seasonal"}  # models of a period
OF_PERIOD = "A period of "
NEVER = "the filter never forgets its start"
WIDE = 4  # states, beyond which matrices are not printed
LARGE = 0.05  # correlation of innovations that matters
OF_NOISE = 1.5  # variance of the difference of two sensors of one quantity, over that of their noise, at most

# Of a period that stands out.
CHANCE = 1e-6  # that the highest of a record of noise is called a period
FACTOR = 4.0  # above what noise has by this chance: spectra of other signals are not flat
NEIGHBOURS = 41  # frequencies whose median is the level about one
FEWEST = 3  # periods in the record
MOST = 2_000_000  # rows of the grid
KNOWN = 60.0, 3600.0, 43200.0, 86400.0, 604800.0, 365.25 * 86400.0  # s, taken where the record cannot tell another


class Period(NamedTuple):
    """A period [s] and the number of its harmonics that stand out."""

    seconds: float
    harmonics: int

    @property
    def model(self) -> str:
        """The named model of a level with a course of this period."""
        count = f",harmonics={self.harmonics}" if self.harmonics > 1 else ""
        return f"constant + harmonic:period={self.seconds:.7g}{count}"


def outstanding_period(column: Column) -> Period | None:
    """The longest period whose harmonics include the highest line of the spectrum; None without a line.

    The spectrum is of differences of neighbours, as a level that walks has a flat one then. The power of white
    noise is exponentially distributed: with this chance the highest of n is above log(n/CHANCE)/log(2) medians.
    """
    times = column.times
    grid = column.dt * np.arange(math.floor(times[-1] / column.dt) + 1.0)
    if len(grid) > MOST or len(grid) < 8 * FEWEST:
        return None
    axis = int(np.nanstd(column.table, axis=0).argmax())
    known = column.measured[:, axis]
    z = np.diff(np.interp(grid, times[known], column.table[known, axis]))
    power = np.abs(np.fft.rfft((z - z.mean()) * np.hanning(len(z)))) ** 2
    level = median_filter(power, NEIGHBOURS, mode="nearest") + 1e-12 * power.max()
    heights = power / level
    heights[:FEWEST] = 0.0
    least = FACTOR * math.log(len(power) / CHANCE) / math.log(2.0)
    inner = slice(1, -1)
    is_line = np.zeros(len(power), bool)
    is_line[inner] = (power[inner] >= power[:-2]) & (power[inner] >= power[2:]) & (heights[inner] > least)
    lines = np.flatnonzero(is_line)
    if not len(lines):
        return None
    positions = np.array([_between(np.log(power[line - 1 : line + 2]), int(line)) for line in lines])
    highest = positions[int(heights[lines].argmax())]
    multiples = highest / positions
    first = positions[np.abs(multiples - np.round(multiples)) * positions < 0.5][0]
    orders = positions / first
    harmonic = [round(order) for order in orders.tolist() if abs(order - round(order)) * first < 0.5]
    seconds = len(z) * column.dt / first
    near = [period for period in KNOWN if abs(len(z) * column.dt / period - first) < 0.5]
    seconds = near[0] if near else float(f"{seconds:.5g}")
    most = min(MOST_HARMONICS, math.floor(0.5 * seconds / column.dt))
    return Period(seconds, max(order for order in harmonic if order <= most)) if most else None


def _between(logarithms: np.ndarray, line: int) -> float:
    """The position of a peak, by the parabola through its logarithm and those beside it."""
    before, at, after = logarithms.tolist()
    bend = before - 2.0 * at + after
    return line + (0.5 * (before - after) / bend if bend < 0.0 else 0.0)


def choose_among_all(column: Column, progress: Callable[[str], None] = lambda name: None) -> Choice:
    """The choice among `fit.CANDIDATES`; if none leaves white innovations, also among lags and periods."""

    def further(chosen: Candidate, level: np.ndarray | None) -> list[str]:
        fit = SeriesFit(column, chosen, (chosen,), (), level)
        return fit.missing_models() if fit.is_wrong else []

    return choose(column, CANDIDATES, progress, further)


@dataclass(frozen=True, eq=False, repr=False)
class SeriesFit(Result):
    """The model of a column of numbers, its Q and R, and what they mean.

    Attributes:
        column: the numbers and their times.
        chosen: the chosen candidate.
        candidates: all that were tried, best first.
        numbers: the model's free numbers and R, with 95 % intervals.
        level: the mean about which the signal of each axis varies, (axes,), if it does.
        left_out: outliers, which are not in `column`, (K, axes), NaN elsewhere; None if there are none.
        gate: number of standard deviations of S beyond which numbers are outliers, if some were left out.
        jumps: rows at which an axis jumps, and its innovations there [standard deviations].
        peaks: why numbers far from their prediction were not left out; empty if there are none.
        files: that were written.
    """

    column: Column
    chosen: Candidate
    candidates: tuple[Candidate, ...]
    numbers: tuple[Number, ...]
    level: np.ndarray | None = None
    left_out: np.ndarray | None = None
    gate: float | None = None
    jumps: tuple[tuple[int, float], ...] = ()
    peaks: str = ""
    files: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the model."""
        return self.chosen.name

    @cached_property
    def model(self) -> AffineModel:
        """The model with its numbers, for a step of the usual length."""
        return model_of(named_model(self.name), self.column, self.chosen.values, self.level)

    @property
    def filter(self) -> KalmanFilter:
        """The Kalman filter, ready to use."""
        return KalmanFilter(model=self.model)

    @property
    def q(self) -> np.ndarray:
        """Q per step, (n, n)."""
        return self.model.process_noise_cov

    @property
    def r(self) -> float:
        """R, of each axis."""
        return float(self.model.measurement_noise_cov[0, 0])

    @cached_property
    def gain(self) -> np.ndarray:
        """The steady-state gain, (n,) or (n, axes), of x + K (z - C x)."""
        gain = self._gains()
        return gain[:, 0] if gain.shape[1] == 1 else gain

    def _gains(self) -> np.ndarray:
        a, _, _, c, _ = self.model.matrices()
        axes = self.model.m
        n = self.model.n // axes  # states of an axis, which are independent of the others
        a, c, q, r = a[:n, :n], c[:1, :n], self.q[:n, :n], self.model.measurement_noise_cov[:1, :1]
        rows = [c]
        for _ in range(n - 1):
            rows.append(rows[-1] @ a)
        orders = named_model(self.name).signal(self._values).orders
        effects = np.abs(np.concatenate(rows)).max(axis=0) / self.column.dt ** np.array(orders)
        measured = np.flatnonzero(effects > HIDDEN * effects.max())  # no gain of the others settles, nor matters
        of, gain = np.ix_(measured, measured), np.zeros((n, 1))
        gain[measured] = steady_state(a[of], c[:, measured], q[of], r)[1]
        return np.kron(np.eye(axes), gain)

    @property
    def memory(self) -> float:
        """Time in which the filter forgets an error of its state but for 1/e [s], where the data show it.

        They never show the quadrature of a harmonic with two samples in its period.
        """
        a, _, _, c, _ = self.model.matrices()
        rates, modes = np.linalg.eig(a - self._gains() @ c @ a)
        after, units = a @ modes, np.sqrt(np.diag(self.model.prior_cov))[:, None]
        units = np.where(units > 0.0, units, units.max())  # of states that begin at zero
        hidden = np.abs(c @ after / (np.abs(c) @ units)).max(axis=0) < HIDDEN * np.abs(after / units).max(axis=0)
        slowest = np.abs(rates[~hidden]).max(initial=0.0)
        return math.inf if slowest >= 1.0 else -self.column.dt / math.log(max(slowest, 1e-300))

    @property
    def plant(self) -> ContinuousModel:
        """The model in continuous time, for data with steps of any length.

            ekf = filters.make_filter("ekf", fit.plant.at(fit.column.dt))
            filters.run(ekf, z, dt=np.diff(t), noise=fit.plant.noise)

        Raises:
            ValueError: for a model of equal steps, as one with a season.
        """
        return self._maker.continuous(dt=self.column.dt)

    @property
    def _maker(self) -> NamedMaker:
        mean = self.column.mean if self.level is None else self.level
        return NamedMaker(
            self.name,
            self.column.quantities,
            self.chosen.values,
            mean=tuple(np.ravel(mean).tolist()) if named_model(self.name).about_mean else None,
            first=tuple(self.column.first.tolist()),
            spread=self.column.scales.spread,
        )

    @cached_property
    def estimates(self) -> FilteredRuns:
        """The filter on the data, a batch of one, as `filters.run` gives it: `to_frame()`, `plot()`."""
        signal = named_model(self.name).signal(self._values)
        runs = FilteredRuns(*filtered(signal, self.model, self.column))
        z, times = self.column.table[None], self.column.times
        none = np.zeros((1, len(times) - 1, 0))
        runs.data = Prepared(self.filter, filter_keys([0]), none, z, None, None, np.arange(len(times)), times)
        return runs

    @property
    def _values(self) -> dict[str, float]:
        """Values of the free numbers, without R."""
        return {name: value for name, value in self.chosen.values.items() if name != R}

    @cached_property
    def whiteness(self) -> Whiteness:
        """Whether the innovations are white."""
        present, lags = self.column.counted(self.model)[None], min(LAGS, len(self.column.values) // 4)
        return whiteness(self.estimates.innovations, self.estimates.innovation_covs, present, lags=lags)

    @property
    def is_wrong(self) -> bool:
        """Whether innovations are correlated so much that the model misses something in the data."""
        correlations = np.abs(self.whiteness.correlations)
        return self.whiteness.p_value < WHITE and float(correlations.max()) > LARGE

    @cached_property
    def _period(self) -> Period | None:
        return outstanding_period(self.column)

    def missing_models(self) -> list[str]:
        """Models that may have what this one misses: of a period that stands out, or more lags of equal steps."""
        names, period, steps, dt = [], self._period, self.column.stamps is None, self.column.dt
        if period is not None:
            rows, duration = round(period.seconds / dt), dt * len(self.column.values)
            is_whole = steps and abs(duration / (rows * dt) - duration / period.seconds) < 0.5  # periods
            if is_whole and period.harmonics > 1 and rows <= LONGEST_SEASON:
                names.append(f"constant + seasonal:period={rows * dt:.7g},seasons={rows}")
            else:
                names.append(period.model)
        return names + [f"ar:{lags}" for lags in range(2, MOST_LAGS + 1) if steps]

    def axes_differ(self) -> float:
        """Probability of so large a likelihood ratio, if all axes have the same numbers; 1 for one axis."""
        axes, candidate = len(self.column.quantities), named_model(self.name)
        if axes == 1:
            return 1.0
        values, gain = list(self.chosen.values.values()), 0.0
        for column in map(self.column.axis, range(axes)):
            likelihood = ColumnLikelihood(candidate, column)
            begin = likelihood.coordinates.clip(likelihood.coordinates.of(values))
            alone = climb(likelihood, begin).found.value
            gain += alone - likelihood.value(begin)
        return float(chdtrc((axes - 1) * len(values), 2.0 * gain))

    def sentences(self) -> list[str]:
        """What a reader has to know, most important first."""
        white, sentences = self.whiteness, []
        largest = np.unravel_index(int(np.argmax(np.abs(white.correlations))), white.correlations.shape)
        lag = int(largest[0])
        if self.is_wrong:
            correlation, time = white.correlations[largest], (lag + 1) * self.column.dt
            sentences.append(
                f"No model that was tried fits: innovations are correlated ({correlation:.2f} at a lag of "
                f"{seconds_text(time)}), so Q and R make up for what the model misses."
            )
            period = None if PERIODIC.intersection(self.name.replace(":", " ").split()) else self._period
            if period is not None:
                sentences.append(
                    f'{OF_PERIOD}{seconds_text(period.seconds)} stands out: try --model "{period.model}".'
                )
        sentences += [
            f"The data do not determine {number.name}: {number.low:.3g} to {number.high:.3g} are as likely."
            for number in self.numbers
            if not number.determined
        ]
        sentences += self._rounding_sentences()
        sentences += self._far_sentences()
        apart = self.axes_differ()
        if apart < WHITE:
            sentences.append(f"The axes differ (p = {apart:.2g}): fit each of them alone.")
        sentences += self._common_sentences()
        if not self.is_wrong:
            sentences.append(f"The innovations are white (p = {white.p_value:.2g}).")
        return [*sentences, *self.column.remarks]

    def _common_sentences(self) -> list[str]:
        """Axes that differ by their noise alone, as two sensors of one quantity do."""
        sentences = []
        for i, j in combinations(range(self.model.m), 2):
            pair = self.column.table[:, [i, j]]
            pair = pair[~np.isnan(pair).any(axis=1)]
            if len(pair) < LEAST_ROWS:
                continue
            spread, apart = float(np.var(pair, axis=0).min()), float(np.var(pair[:, 0] - pair[:, 1]))
            if apart < OF_NOISE * 2.0 * self.r < spread:  # of two signals it is twice the spread
                first, second = self.column.quantities[i].symbol, self.column.quantities[j].symbol
                sentences.append(
                    f"{first} and {second} differ by their noise alone, but axes have a state each: if both "
                    "measure one quantity, fit each alone, and filter both with one state."
                )
        return sentences

    def _rounding_sentences(self) -> list[str]:
        """Rounding that is taken for the signal, because a rounded number stays and so looks exact."""
        column, sentences = self.column, []
        high = self.numbers[-1].high if self.numbers else self.r
        for quantity, axis, step in zip(
            column.quantities, column.table.T, column.resolutions.tolist(), strict=True
        ):
            least, known = step**2 / 12.0, axis[~np.isnan(axis)]
            if high < least:
                repeats = f"{float(np.mean(np.diff(known) == 0.0)):.0%} of its numbers repeat the one before"
                sentences.append(
                    f"{quantity.symbol} changes in steps of {step:.3g}, and {repeats}: if it is rounded, R is at "
                    f"least {step:.3g}^2/12 = {least:.3g}, as an error of rounding that stays looks like signal. "
                    "Log more digits, or fit means of many rows."
                )
        return sentences

    @property
    def _real_jumps(self) -> list[tuple[int, float]]:
        """Jumps by more than the resolution of the numbers."""
        table, steps = self.column.table, 1.5 * self.column.resolutions
        return [
            (row, height) for row, height in self.jumps if not (np.abs(table[row] - table[row - 1]) <= steps).all()
        ]

    def _far_sentences(self) -> list[str]:
        """Outliers, what a filter has to do with them, and jumps."""
        sentences, times = [self.peaks] if self.peaks else [], self.column.times
        if self.left_out is not None and self.gate is not None:
            rows = np.flatnonzero((~np.isnan(self.left_out)).any(axis=1))
            where, who = f"row {rows[0]}, {times[rows[0]]:.4g} s", "1 number is an outlier and is left out"
            if len(rows) > 1:
                where = f"rows {rows[0]} to {rows[-1]}, {times[rows[0]]:.4g} to {times[rows[-1]]:.4g} s"
                who = f"{len(rows)} numbers are outliers and are left out"
            sentences += [
                f"{who} ({where}), beyond {self.gate:g} standard deviations of the prediction: Q and R are those "
                "of the others.",
                "A filter must leave out outliers, too: use the lines of --code, fit.filter.session("
                f"gate={self.gate:g}, most={BURST}) or --filter ekf-robust.",
            ]
        jumps = self._real_jumps
        if jumps:
            row, height = max(jumps, key=lambda jump: abs(jump[1]))
            count = f" {len(jumps)} times, the highest" if len(jumps) > 1 else ""
            sentences.append(
                f"The record jumps{count} at row {row} ({times[row]:.4g} s), by {abs(height):.0f} standard "
                "deviations of the prediction, and Q makes up for it: fit the rows before and after it alone."
            )
        return sentences

    def to_frame(self) -> pandas.DataFrame:
        """A row per number: meaning, unit, value, and the ends of its 95 % interval."""
        columns = [*zip(*(number for number in self.numbers), strict=True)]
        names = "number", "meaning", "value", "low", "high", "unit", "determined"
        return frame(dict(zip(names, columns, strict=True)), "number")

    def as_dict(self) -> dict[str, Any]:
        """All of it as plain data, for JSON."""
        f, _, _, h, offset = self.model.matrices()
        data = {
            "model": self.name,
            "rows": len(self.column.values),
            "measured": int(self.column.measured.any(axis=1).sum()),
            "outliers": 0 if self.left_out is None else int((~np.isnan(self.left_out)).sum()),
            "gate": self.gate,
            "jumps": [row for row, _ in self._real_jumps],
            "dt": self.column.dt,
            "numbers": {number.name: number._asdict() for number in self.numbers},
            "F": f,
            "H": h,
            "Q": self.q,
            "R": self.r,
            "offset": offset,
            "gain": self.gain,
            "forgets_in": self.memory,
            "white": {"p": self.whiteness.p_value, "wrong_model": self.is_wrong},
            "candidates": [
                {"model": name, "behind": loss, "standard_error": error} for name, loss, error in self._standings()
            ],
            "sentences": self.sentences(),
            "files": list(self.files),
        }
        return plain_data(data)

    def tables(self) -> list[Table | str]:
        """Half a page for the terminal: the model, its numbers with intervals, and what they mean."""
        column, first = self.column, []
        count = int(column.measured.any(axis=1).sum())
        off = np.zeros(column.measured.shape, bool) if self.left_out is None else ~np.isnan(self.left_out)
        outliers, missing = int(off.any(axis=1).sum()), int((~(column.measured | off)).all(axis=1).sum())
        names = ", ".join(quantity.short_label for quantity in column.quantities)
        apart, step = f"one each {_step_text(column.dt)}", "per step"
        if column.stamps is not None:
            steps = np.diff(column.stamps)
            apart, step = f"{_range_text(steps)} apart", f"of a step of {_step_text(column.dt)}"
        heading = f"{names}: {count} numbers, {apart}"
        sentences = self.sentences()
        if self.is_wrong:
            count = 1 + "".join(sentences[1:2]).startswith(OF_PERIOD)
            first, sentences = [sentences[0], *map(Unfolded, sentences[1:count])], sentences[count:]
        rows = [(number.name, *_digits(number), number.unit, _meaning(number)) for number in self.numbers]
        about = " plus ".join(part.about for part in named_model(self.name).parts)
        numbers = Table(
            f"Model: {self.name}, {about}", ["", "value", "95 % from", "to", "unit", ""], rows, words=True
        )
        forgets = f"the filter forgets in {seconds_text(self.memory)}" if math.isfinite(self.memory) else NEVER
        lines = [
            f"Q {step} = {_matrix(self.q, f'Q {step} = ')}" if len(self.q) <= WIDE else f"Q {step}: fit.q, --json",
            f"R = {self.r:.6g}" + " of each axis" * (self.model.m > 1),
            f"Steady-state gain = {_matrix(self.gain, 'Q per step = ')}: {forgets}"
            if len(self.q) <= WIDE
            else f"Steady-state gain: fit.gain; {forgets}",
        ]
        rivals = [
            f"{name} {-loss:.1f} +- {error:.1f}" for name, loss, error in self._standings() if name != self.name
        ]
        if rivals:
            sentences.append(f"Log-likelihood of unseen blocks less the best model's: {', '.join(rivals)}.")
        heading = f"{heading}, {missing} missing" if missing else heading
        heading = f"{heading}, {outliers} outliers left out" if outliers else heading
        further = "Next: --code FILE.md (fit.code) writes it for a controller; elsewhere it is"
        if any(path.endswith(".md") for path in self.files):
            further = "Other commands take it as"
        return [
            heading,
            *first,
            "",
            numbers,
            *lines,
            *sentences,
            *(f"wrote {path}" for path in self.files),
            further,
            Unfolded(f'--model "{self.text}"'),
        ]

    @property
    def text(self) -> str:
        """The model with its numbers as other commands and `EstimateState` take it (`filters.named`)."""
        numbers = {number.name: number.value for number in self.numbers}
        return text_of(self.name, numbers, self.model.m, None if self.level is None else self.level.tolist())

    def _standings(self) -> list[tuple[str, float, float]]:
        """Of each candidate, best first: by how much it is behind the best, and the standard error of that."""
        best = self.candidates[0]
        return [(candidate.name, *behind(candidate, best)) for candidate in self.candidates]

    def __repr__(self) -> str:
        values = ", ".join(f"{number.name} {number.value:.4g}" for number in self.numbers)
        return f"SeriesFit({self.name}: {values})"

    def figures(self) -> dict[str, Figure]:
        """The data with the estimate, and the innovations."""
        return {"The data with the estimate and its 95 % band, and the innovations": self.plot()}

    def plot(self) -> Figure:
        """The data with the estimate and its 95 % band, and the normalised innovations."""
        from matplotlib.figure import Figure

        axes = self.model.m
        figure = Figure(figsize=(8.0, 5.0), layout="constrained")
        plots = figure.subplots(2, axes, sharex=True, height_ratios=[2, 1], squeeze=False)
        for axis in range(axes):
            self._plot_axis(axis, *plots[:, axis])
        return figure

    def _plot_axis(self, axis: int, top: Any, bottom: Any) -> None:
        quantity, values, measured = self.column.quantities[axis], self.column.table[:, axis], self.column.measured
        times = self.column.times
        c, d = (part[axis] for part in self.model.matrices()[3:])
        means = self.estimates.means[0] @ c + d
        deviations = np.sqrt(np.einsum("i,kij,j->k", c, self.estimates.covs[0], c))
        normalised = self.estimates.innovations[0, :, axis] / np.sqrt(
            self.estimates.innovation_covs[0, :, axis, axis]
        )
        top.plot(times, values, ".", markersize=2.5, color="0.6", label="measured")
        top.plot(times, means, color="C0", linewidth=1.2, label=f"estimate, {self.name}")
        top.fill_between(
            times, means - 1.96 * deviations, means + 1.96 * deviations, color="C0", alpha=0.25, label="95 % band"
        )
        inside = values[measured[:, axis]]
        margin = 0.1 * np.ptp(inside)
        ends = inside.min() - margin, inside.max() + margin
        if self.left_out is not None:
            outliers = np.clip(self.left_out[:, axis], *ends)  # at an edge if beyond
            top.plot(times, outliers, "x", markersize=5, color="C1", clip_on=False, label="outliers, left out")
        top.set_ylim(*ends)
        top.set_ylabel(quantity.short_label)
        top.legend(loc="best", frameon=False, fontsize="small")
        bottom.plot(times, normalised, ".", markersize=2.5, color="0.4")
        bottom.axhspan(-1.96, 1.96, color="C0", alpha=0.15)
        bottom.set_ylabel("innovation\n[standard deviations]")
        bottom.set_xlabel("time [s]")

    def code(self, language: str = "python") -> str:
        """Lines to paste: "python" (ours), "filterpy", "pykalman", "matlab" or "arduino".

        Raises:
            ValueError: for another language, or for "arduino", whose gain is constant, if this filter forgets its
                first state more slowly than in the time of the record.
        """
        duration = float(self.column.times[-1])
        if language == ARDUINO and self.memory > duration:
            forgets = "never forgets" if math.isinf(self.memory) else f"forgets in {seconds_text(self.memory)}"
            raise ValueError(
                f"a filter of constant gain must forget its start within the record, {seconds_text(duration)}, "
                f'but {self.name} {forgets}: take code("python") or code("filterpy"), whose gain varies, or '
                "thruster tune and export, which write such a one in C"
            )
        column, signal, unequal = self.column, named_model(self.name).signal(self._values), None
        if column.stamps is not None and not signal.discrete:
            axes, steps = np.eye(self.model.m), np.diff(column.stamps)
            matrices = np.kron(axes, signal.slope), np.kron(axes, signal.densities)
            unequal = UnequalSteps(self._maker, column.dt, *matrices, float(steps.min()), float(steps.max()))
        off = 0 if self.left_out is None else ~np.isnan(self.left_out)
        gaps = column.stamps is not None or not (column.measured | off).all()
        return lines_of(language, self.model, self._gains(), column.dt, self.gate, column.turns, unequal, gaps)


def _step_text(dt: float) -> str:
    return seconds_text(dt) if dt > 120.0 else f"{dt:.4g} s"


def _range_text(steps: np.ndarray) -> str:
    least, most = float(steps.min()), float(steps.max())
    return f"{least:.4g} to {_step_text(most)}"


def _digits(number: Number) -> tuple[str, str, str]:
    """Value and ends of the interval, to as many digits as tell the ends of a narrow one apart."""
    width = (number.high - number.low) / max(abs(number.value), 1e-300)
    more = max(math.ceil(-math.log10(width)) - 1, 0) if 1e-9 < width < 1.0 else 0
    return f"{number.value:.{4 + more}g}", f"{number.low:.{3 + more}g}", f"{number.high:.{3 + more}g}"


def _meaning(number: Number) -> str:
    """What a number means; of a long time and of a slow frequency also in minutes, hours or days."""
    if number.unit == "Hz" and number.value < SLOW:
        return f"{number.meaning}, a period of {seconds_text(1.0 / number.value)}"
    if number.unit == "s" and number.value > 120.0:
        return f"{number.meaning}, {seconds_text(number.value)}"
    return number.meaning


def _matrix(values: np.ndarray, prefix: str) -> str:
    """Numbers as Python writes them, each to six digits."""
    formats: Any = {"float_kind": lambda value: f"{value:.6g}"}
    return np.array2string(np.asarray(values), separator=", ", prefix=prefix, formatter=formats)
