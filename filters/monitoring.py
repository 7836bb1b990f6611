"""An alarm when a sensor fails: tests on a filter's innovations with a stated rate of false alarms.

Normalised innovations e of a consistent filter are independent and N(0, 1). The average run length is the mean
number of steps until a test raises an alarm; without a fault it is the mean time between false alarms. All tests
of a step are one compiled function without an allocation, so that it may run on a boat.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import as_floats, at_least, one_of, positive, short_repr
from thruster_env.core.compiled import is_interpreting
from thruster_env.model.turns import Turn, readings

if TYPE_CHECKING:
    from filters.filter import Filter
    from thruster_env.graphs.loops import Loops

OUTLIER, CUSUM, GLR, VARIANCE, STUCK, MISSING = range(6)
# Of a channel: both CUSUMs, and the steps at which they left zero; squares and their number; equal readings and
# the last one; missing ones; how many innovations are in the ring, and where the next one goes; then the ring.
ABOVE, ABOVE_SINCE, BELOW, BELOW_SINCE, SQUARES, COUNT, EQUAL, LAST, GONE, FILLED, NEXT, RING = range(12)
LARGEST = 1e100  # of normalised innovations
NODES = 80  # of the integral equation
LARGEST_THRESHOLD = 60.0  # of thresholds, in standard deviations
MEANING = {
    "outlier": "a measurement that cannot be",
    "cusum": "a bias",
    "glr": "a bias",
    "variance": "another variance of the noise",
    "stuck": "equal readings",
    "missing": "no readings",
}
STATISTICAL = 4  # of them have false alarms
SAFELY = 2  # times the longest run of equal, or missing, readings of what is healthy
THRESHOLDS = "thresholds"


def step_tests(state, k, innovation, cov, z, limits, raised, since, sizes):
    """Work out all tests of a step.

    Args:
        state: (m, RING + N), changed; zeros before the first step.
        k: number of the step.
        innovation: v (m,).
        cov: S (m, m).
        z: measurement (m,), NaN where nothing was measured.
        limits: what `Monitor.limits` gives.
        raised: set: whether a test raises an alarm at this step, (6, m).
        since: set where it does: the step at which it began, (6, m).
        sizes: set where it does: biases and outliers in the measurement's unit, ratios of variances, else numbers
            of steps, (6, m).

    Returns:
        Whether a channel is dead: stuck or missing, at this step as since its alarm.
    """
    m, window = innovation.shape[0], state.shape[1] - RING
    reference, cusum, glr, low, high, block = limits[0], limits[1], limits[2], limits[3], limits[4], limits[5]
    stuck, missing = limits[6], limits[7]
    largest, worst = 0.0, 0
    for i in range(m):
        for test in range(6):
            raised[test, i] = 0.0
        if not z[i] == z[i]:
            state[i, GONE] += 1.0
            if state[i, GONE] == missing:
                raised[MISSING, i], since[MISSING, i], sizes[MISSING, i] = 1.0, k - missing + 1.0, missing
            continue
        state[i, GONE] = 0.0
        deviation = cov[i, i] ** 0.5
        e = innovation[i] / deviation
        if not abs(e) < LARGEST:  # a filter that is lost says nothing of a sensor
            continue
        if abs(e) > largest:
            largest, worst = abs(e), i
        state[i, EQUAL] = state[i, EQUAL] + 1.0 if z[i] == state[i, LAST] and state[i, EQUAL] > 0.0 else 1.0
        state[i, LAST] = z[i]
        if state[i, EQUAL] == stuck:
            raised[STUCK, i], since[STUCK, i], sizes[STUCK, i] = 1.0, k - stuck + 1.0, stuck
        for sign, total, began in ((1.0, ABOVE, ABOVE_SINCE), (-1.0, BELOW, BELOW_SINCE)):
            if state[i, total] == 0.0:
                state[i, began] = k
            state[i, total] = max(0.0, state[i, total] + sign * e - reference)
            if state[i, total] >= cusum:
                count = k - state[i, began] + 1.0
                raised[CUSUM, i], since[CUSUM, i] = 1.0, state[i, began]
                sizes[CUSUM, i] = sign * (state[i, total] / count + reference) * deviation
                state[i, total] = 0.0
        state[i, SQUARES] += e * e
        state[i, COUNT] += 1.0
        if state[i, COUNT] == block:
            if not low <= state[i, SQUARES] <= high:
                raised[VARIANCE, i], since[VARIANCE, i] = 1.0, k - block + 1.0
                sizes[VARIANCE, i] = state[i, SQUARES] / block
            state[i, SQUARES] = state[i, COUNT] = 0.0
        newest = int(state[i, NEXT])
        state[i, RING + newest] = e
        state[i, NEXT] = float((newest + 1) % window)
        state[i, FILLED] = min(state[i, FILLED] + 1.0, float(window))
        sum_of_last, best, length = 0.0, 0.0, 0
        for j in range(int(state[i, FILLED])):
            sum_of_last += state[i, RING + (newest - j) % window]
            ratio = sum_of_last * sum_of_last / (j + 1.0)
            if ratio > best:
                best, length = ratio, j + 1
                sizes[GLR, i] = sum_of_last / (j + 1.0) * deviation
        if best >= glr * glr:
            raised[GLR, i], since[GLR, i] = 1.0, k - length + 1.0
            state[i, FILLED] = 0.0
    if largest > 0.0:
        squared, present = squared_innovation(innovation, cov, z)
        if squared >= limits[7 + present]:
            raised[OUTLIER, worst], since[OUTLIER, worst], sizes[OUTLIER, worst] = 1.0, k, innovation[worst]
    dead = False
    for i in range(m):
        dead = dead or state[i, EQUAL] >= stuck or state[i, GONE] >= missing
    return dead


def squared_innovation(innovation, cov, z):
    """V' S^-1 v of the channels that are there, by elimination, and their number."""
    m, count, total = innovation.shape[0], 0, 0.0
    s, v = cov.copy(), innovation.copy()
    for i in range(m):
        if z[i] == z[i]:
            count += 1
            total += v[i] * v[i] / s[i, i]
            for j in range(i + 1, m):
                factor = s[j, i] / s[i, i]
                v[j] -= factor * v[i]
                for a in range(i + 1, m):
                    s[j, a] -= factor * s[i, a]
    return total, count


def run_tests(state, innovations, covs, measurements, limits, raised, since, sizes):
    """Work out all tests of K steps; raised, since and sizes are (K, 6, m)."""
    for k in range(innovations.shape[0]):
        step_tests(
            state, float(k), innovations[k], covs[k], measurements[k], limits, raised[k], since[k], sizes[k]
        )


def new_state(channels: int, window: int) -> np.ndarray:
    """The state before the first step."""
    return np.zeros((channels, RING + window))


def chi_square(steps: float, degrees: int) -> float:
    """What chi^2 of so many degrees of freedom exceeds once in so many steps."""
    from scipy.special import chdtri  # here, as below, because SciPy takes long to import

    return float(chdtri(degrees, min(1.0 / steps, 1.0)))


def cusum_run_length(threshold: float, reference: float, shift: float = 0.0, sides: int = 2) -> float:
    """Average run length of the CUSUM g = max(0, g + e - k), or of one for each sign, for e ~ N(shift, 1).

        L(u) = 1 + L(0) F(k - u) + int_0^h L(y) f(y + k - u) dy,   1/L = 1/L_above + 1/L_below

    by Gauss-Legendre quadrature.

    Args:
        threshold: h.
        reference: k, half of the bias that is to be found soonest.
        shift: mean of e.
        sides: 2 for both signs, 1 for a bias above zero.

    Source: Page (1954); the integral equation: Goel, Wu (1971), "Determination of A.R.L. and a contour nomogram
    for CUSUM charts", Technometrics 13; two sides: Siegmund (1985), Sequential Analysis, section 2.6.
    """
    rates = [1.0 / _one_sided(threshold, reference, sign * shift) for sign in (1.0, -1.0)[:sides]]
    return 1.0 / sum(rates)


def _one_sided(h: float, k: float, shift: float) -> float:
    from scipy.special import ndtr

    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    y, w = 0.5 * h * (nodes + 1.0), 0.5 * h * weights
    k = k - shift
    density = np.exp(-0.5 * (y[None, :] + k - y[:, None]) ** 2) / math.sqrt(2.0 * math.pi)
    from_zero = w * np.exp(-0.5 * (y + k) ** 2) / math.sqrt(2.0 * math.pi)
    matrix = np.block([[1.0 - ndtr(k), -from_zero[None, :]], [-ndtr(k - y)[:, None], np.eye(NODES) - density * w]])
    return float(np.linalg.solve(matrix, np.ones(NODES + 1))[0])


def cusum_threshold(steps: float, reference: float, sides: int = 2) -> float:
    """The threshold h of a CUSUM with so many steps between false alarms, for the reference value k."""
    return _where(lambda h: math.log(cusum_run_length(h, reference, sides=sides) / steps), 1e-6)


def glr_run_length(threshold: float, window: int) -> float:
    """Average run length of the generalised likelihood ratio for a bias that began at most `window` steps ago.

        max_{n <= N} |e_{k-n+1} + ... + e_k| / sqrt(n) >= h,   L = sqrt(2 pi) exp(h^2/2) / (h D)
        D = (h^2/2) sum_{n <= N} nu(h / sqrt n)^2 / n^2,   nu(x) = (2/x) (F(x/2) - 1/2) / (x/2 F(x/2) + f(x/2))

    For windows of 10 to 100 steps simulations agree within 8 %.

    Source: Siegmund (1988), "Approximate tail probabilities for the maxima of some random fields", Annals of
    Probability 16; Siegmund, Venkatraman (1995), "Using the generalized likelihood ratio statistic for sequential
    detection of a change-point", Annals of Statistics 23; nu: Siegmund, Yakir (2007), Statistics of Gene Mapping.
    """
    from scipy.special import ndtr

    n = np.arange(1, window + 1)
    x = threshold / np.sqrt(n)
    density = np.exp(-0.125 * x**2) / math.sqrt(2.0 * math.pi)
    nu = (2.0 / x) * (ndtr(0.5 * x) - 0.5) / (0.5 * x * ndtr(0.5 * x) + density)
    chances = 0.5 * threshold**2 * float((nu**2 / n**2).sum())
    return math.sqrt(2.0 * math.pi) * math.exp(0.5 * threshold**2) / (threshold * chances)


def glr_threshold(steps: float, window: int) -> float:
    """The threshold h of the likelihood ratio with so many steps between false alarms."""
    return _where(lambda h: math.log(glr_run_length(h, window) / steps), 1.0)


def _where(function: Callable[[float], float], least: float) -> float:
    """Where a growing function is zero; `least` if it is above zero everywhere."""
    if function(least) >= 0.0:
        return least
    from scipy.optimize import brentq

    high = 1.0
    while function(high) < 0.0 and high < LARGEST_THRESHOLD:
        high *= 1.5
    return float(brentq(function, least, high, xtol=1e-10))


TESTS = ("outlier", "cusum", "glr", "variance", "stuck", "missing")  # in the order of `recursion`


class Alarm(NamedTuple):
    """A test that speaks against a channel."""

    test: str  # one of TESTS
    channel: int
    step: int  # at which it was raised
    since: int  # the step at which it began, most likely
    size: float  # of a bias or outlier in the channel's unit, a ratio of variances, or a number of readings

    @property
    def meaning(self) -> str:
        """The likely fault of the channel."""
        return MEANING[self.test]


class Health(NamedTuple):
    """The verdict of the tests at a step."""

    ok: bool  # no alarm was raised within the last `Monitor.memory` steps, and no channel is stuck or missing
    alarms: tuple[Alarm, ...]  # raised at this step


@dataclass(frozen=True)
class Monitor:
    """Tests on innovations v with covariance S, on each channel by e_i = v_i / sqrt(S_ii), N(0, 1) if all is well.

        outlier   v' S^-1 v of a step, chi^2
        cusum     sums of e above and below, g = max(0, g +- e - b/2): a bias of b standard deviations, soonest
        glr       max over n <= window of |sum of the last n e| / sqrt(n): a bias of any size, and since when
        variance  sum of e^2 over `block` steps, one block after the other, chi^2: too much noise, or too little
        stuck     equal readings in a row
        missing   steps in a row without a reading

    The first four have thresholds such that all of them, of all channels together, raise one false alarm in
    `steps_between` steps on average, a quarter each. That holds for white innovations, those of a filter with the
    right model; otherwise there are more. After an alarm a test restarts.

    Attributes:
        steps_between: steps between two false alarms.
        bias: b, in standard deviations of the innovation.
        window: steps that a bias may be old, 10 to 100.
        block: steps of a block.
        stuck: equal readings in a row that raise an alarm.
        missing: missing readings in a row that raise an alarm.
        memory: steps for which an alarm counts; a channel that is stuck or missing counts until it is neither.

    Raises:
        ValueError: if an attribute is out of its range.

    Source: Basseville, Nikiforov (1993), Detection of Abrupt Changes, chapters 2 and 7; Willsky, Jones (1976) for
    the likelihood ratio of innovations.
    """

    steps_between: float = 100_000.0
    bias: float = 1.0
    window: int = 50
    block: int = 50
    stuck: int = 10
    missing: int = 10
    memory: int = 50

    def __post_init__(self):
        steps = positive("steps_between", self.steps_between)
        if not 100.0 <= steps <= 1e12:
            raise ValueError(f"steps_between must be from 100 to 1e12, but got {short_repr(self.steps_between)}")
        object.__setattr__(self, "steps_between", steps)
        object.__setattr__(self, "bias", positive("bias", self.bias))
        for name, least, most in (
            ("window", 10, 100),
            ("block", 10, 100_000),
            ("stuck", 2, 10**9),
            ("missing", 1, 10**9),
            ("memory", 1, 10**9),
        ):
            object.__setattr__(self, name, at_least(name, getattr(self, name), least, most))

    def as_mapping(self) -> dict[str, Any]:
        """The attributes, as data for a file."""
        return asdict(self)

    def steps_of(self, channels: int) -> float:
        """Steps between false alarms of each test of one channel."""
        return self.steps_between * STATISTICAL * channels

    def limits(self, channels: int) -> np.ndarray:
        """The thresholds as `step_tests` takes them."""
        return _limits(self, channels)

    def watch(self, channels: int) -> Watch:
        """The tests of one belief with this number of channels, before its first step."""
        return Watch(self, channels)

    def alarms(self, innovations: np.ndarray, covs: np.ndarray, measurements: np.ndarray) -> list[Alarm]:
        """All alarms of a run of K steps.

        Args:
            innovations: (K, m).
            covs: (K, m, m).
            measurements: (K, m), NaN where nothing was measured.

        Raises:
            ValueError: if shapes do not fit.
        """
        v, s, z = (np.ascontiguousarray(as_floats(array)) for array in (innovations, covs, measurements))
        if z.ndim != 2 or (v.shape, s.shape) != (z.shape, (*z.shape, z.shape[1])):
            rule = "innovations and measurements must have the shape (K, m), covs (K, m, m)"
            raise ValueError(f"{rule}, but got {v.shape}, {z.shape} and {s.shape}")
        steps, m = z.shape
        shape = steps, len(TESTS), m
        raised, since, sizes = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        state = new_state(m, self.window)
        _compiled(is_interpreting())[1](state, v, s, z, self.limits(m), raised, since, sizes)
        return [
            Alarm(TESTS[test], int(i), int(k), int(since[k, test, i]), float(sizes[k, test, i]))
            for k, test, i in np.argwhere(raised)
        ]


def monitor_of(argument: Monitor | Mapping | float | None) -> Monitor | None:
    """A monitor from what users write: one, its attributes, its steps between false alarms, or True; else None."""
    if argument is None or argument is False or isinstance(argument, Monitor):
        return argument or None
    if isinstance(argument, Mapping):
        for name in argument:
            one_of("an attribute of a monitor", name, tuple(Monitor.__dataclass_fields__))
        return Monitor(**argument)
    return Monitor() if argument is True else Monitor(steps_between=argument)


def watch_of(monitor: Monitor | None, filter_: Filter) -> Watch | None:
    """The tests of one belief of a filter; ValueError for one without a covariance."""
    if monitor is None:
        return None
    if not filter_.has_covariance:
        raise ValueError(f"a monitor needs a filter with a covariance, but {filter_.name!r} has none")
    return Watch(monitor, filter_.model.m, filter_.model.measured_turns)


@cache
def _limits(monitor: Monitor, channels: int) -> np.ndarray:
    from scipy.special import chdtri

    each, block = monitor.steps_of(channels), monitor.block
    chance = min(block / each, 1.0)  # of each block
    low, high = float(chdtri(block, 1.0 - 0.5 * chance)), float(chdtri(block, 0.5 * chance))
    first = [0.5 * monitor.bias, cusum_threshold(each, 0.5 * monitor.bias), glr_threshold(each, monitor.window)]
    of_outliers = [chi_square(STATISTICAL * monitor.steps_between, count) for count in range(1, channels + 1)]
    limits = np.array([*first, low, high, block, monitor.stuck, monitor.missing, *of_outliers], dtype=np.float64)
    limits.flags.writeable = False
    return limits


@cache
def _compiled(interpreting: bool) -> tuple[Loops, Loops]:
    """`step_tests` and `run_tests`, compiled at their first call; those of `interpreted` are others."""
    from thruster_env.graphs.loops import Loops

    return Loops(step_tests), Loops(run_tests)


class Watch:
    """The tests of one belief, step by step.

    Attributes:
        latest: the latest alarm of each channel, None before the first.
    """

    def __init__(self, monitor: Monitor, channels: int, turns: tuple[Turn, ...] = ()):
        self.monitor, self._limits, self._turns = monitor, monitor.limits(channels), turns
        shape = len(TESTS), channels
        self._out = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._state = new_state(channels, monitor.window)
        self.restart()

    def restart(self) -> None:
        """Begin anew."""
        self._state[:] = 0.0
        self._k = 0
        self._last: int | None = None  # step of the last alarm
        self.latest: list[Alarm | None] = [None] * len(self._state)

    def memory(self) -> tuple:
        """What the tests remember, for `recall`."""
        return self._state.copy(), self._k, self._last, tuple(self.latest)

    def recall(self, memory: tuple) -> None:
        """Continue from what the tests remembered."""
        self._state[:], self._k, self._last, latest = memory
        self.latest = list(latest)

    def step(self, innovation: np.ndarray, cov: np.ndarray, z: np.ndarray) -> Health:
        """Take the innovation (m,), its covariance (m, m) and the measurement z, NaN where there was none."""
        raised, since, sizes = self._out
        innovation, cov, z = (np.ascontiguousarray(part, dtype=np.float64) for part in (innovation, cov, z))
        z = readings(z, self._turns) if self._turns else z
        count = (len(self._state),)
        if innovation.shape != count or z.shape != count or cov.shape != 2 * count:
            rule = f"a monitor of {count[0]} channels must get as many innovations and measurements"
            raise ValueError(f"{rule}, but got {innovation.shape}, {z.shape} and a covariance {cov.shape}")
        tests = self._state, float(self._k), innovation, cov, z, self._limits, raised, since, sizes
        dead = _compiled(is_interpreting())[0](*tests)
        alarms: tuple[Alarm, ...] = ()
        if raised.any():
            alarms = tuple(
                Alarm(TESTS[test], int(i), self._k, int(since[test, i]), float(sizes[test, i]))
                for test, i in np.argwhere(raised)
            )
            self._last = self._k
            for alarm in alarms:
                self.latest[alarm.channel] = alarm
        ok = not dead and (self._last is None or self._k - self._last >= self.monitor.memory)
        self._k += 1
        return Health(ok, alarms)


def monitor_for(measurements: np.ndarray, monitor: Monitor | None = None) -> Monitor:
    """A monitor whose `stuck` and `missing` are above those of healthy runs, twice the longest and one.

    Args:
        measurements: z of runs (B, K + 1, m), NaN where nothing was measured; what follows the last reading of a
            run does not count.
        monitor: the other attributes, and the least of these two.
    """
    monitor, equal, gone = monitor or Monitor(), 0, 0
    for run in as_floats(measurements):
        present = ~np.isnan(run)
        rows = int(np.flatnonzero(present.any(axis=1)).max(initial=-1)) + 1
        for z in run[:rows].T:
            readings = z[~np.isnan(z)]
            equal = max(equal, _longest(readings[1:] == readings[:-1]) + 1)
            gone = max(gone, _longest(np.isnan(z)))
    stuck, missing = SAFELY * equal + 1, SAFELY * gone + 1
    return replace(monitor, stuck=max(stuck, monitor.stuck), missing=max(missing, monitor.missing))


def _longest(flags: np.ndarray) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def tuned_monitor(path: str | Path) -> Monitor:
    """The monitor of a tuned file.

    Raises:
        ValueError: for a file that cannot be read, or has none, as those of before version 0.1.
    """
    stored = read_tuned_file(path).get("monitor")
    if stored is None:
        raise ValueError(f"a tuned file must have a monitor (tune again, or give the steps), but {path} has none")
    if not isinstance(stored, Mapping):
        raise ValueError(f"the monitor of a tuned file must be a mapping, but {path} has {short_repr(stored)}")
    try:
        monitor = monitor_of({name: value for name, value in stored.items() if name != THRESHOLDS})
    except ValueError as error:
        raise ValueError(f"{error} (in the tuned file {path})") from None
    return monitor or Monitor()
