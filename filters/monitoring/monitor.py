"""An alarm when a sensor lies: tests on a filter's innovations with a stated rate of false alarms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from filters.monitoring import recursion
from filters.monitoring.recursion import chi_square, cusum_threshold, glr_threshold
from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import as_floats, at_least, one_of, positive, short_repr
from thruster_env.core.compiled import CompiledOrPython, inlined

if TYPE_CHECKING:
    from filters.filter import Filter

TESTS = ("outlier", "cusum", "glr", "variance", "stuck", "missing")  # in the order of `recursion`
MEANING = {
    "outlier": "a measurement that cannot be",
    "cusum": "a bias",
    "glr": "a bias",
    "variance": "another variance of the noise",
    "stuck": "equal readings",
    "missing": "no readings",
}
STATISTICAL = 4  # of them have false alarms


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
        """The thresholds as `recursion.step_tests` takes them."""
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
        """
        v, s, z = (np.ascontiguousarray(as_floats(array)) for array in (innovations, covs, measurements))
        steps, m = z.shape
        shape = steps, len(TESTS), m
        raised, since, sizes = np.zeros(shape, dtype=bool), np.zeros(shape), np.zeros(shape)
        state = recursion.new_state(m, self.window)
        _compiled()[1](state, v, s, z, self.limits(m), raised, since, sizes)
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
    return monitor.watch(filter_.model.m)


@cache
def _limits(monitor: Monitor, channels: int) -> np.ndarray:
    each, block = monitor.steps_of(channels), monitor.block
    chance = min(block / each, 1.0)  # of each block
    low, high = float(chdtri(block, 1.0 - 0.5 * chance)), float(chdtri(block, 0.5 * chance))
    first = [0.5 * monitor.bias, cusum_threshold(each, 0.5 * monitor.bias), glr_threshold(each, monitor.window)]
    of_outliers = [chi_square(STATISTICAL * monitor.steps_between, count) for count in range(1, channels + 1)]
    limits = np.array([*first, low, high, block, monitor.stuck, monitor.missing, *of_outliers], dtype=np.float64)
    limits.flags.writeable = False
    return limits


@cache
def _compiled() -> tuple[CompiledOrPython, CompiledOrPython]:
    """`recursion.step_tests` and `run_tests`, compiled at their first call."""
    inlined(recursion.squared_innovation)
    inlined(recursion.step_tests)
    return CompiledOrPython(recursion.step_tests), CompiledOrPython(recursion.run_tests)


class Watch:
    """The tests of one belief, step by step.

    Attributes:
        latest: the latest alarm of each channel, None before the first.
    """

    def __init__(self, monitor: Monitor, channels: int):
        self.monitor, self._limits = monitor, monitor.limits(channels)
        shape = len(TESTS), channels
        self._out = np.zeros(shape, dtype=bool), np.zeros(shape), np.zeros(shape)
        self._state = recursion.new_state(channels, monitor.window)
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
        """Take the innovation (m,), its covariance (m, m) and the measurement (m,), NaN where there was none."""
        raised, since, sizes = self._out
        tests = self._state, float(self._k), innovation, cov, z, self._limits, raised, since, sizes
        dead = _compiled()[0](*tests)
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


# A monitor in a tuned file: its attributes as data, and the thresholds that follow from them.

SAFELY = 2  # times the longest run of equal, or missing, readings of what is healthy
THRESHOLDS = "thresholds"


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


def monitor_data(monitor: Monitor, channels: int) -> dict[str, Any]:
    """A monitor's attributes, and its thresholds by test, as JSON can hold them.

    Thresholds of `outlier` are those of one channel, two, ... that are there; of `variance` the least and the
    largest sum of a block.
    """
    _, cusum, glr, low, high, _, stuck, missing, *outliers = monitor.limits(channels).tolist()
    thresholds = {"outlier": outliers, "cusum": cusum, "glr": glr, "variance": [low, high]}
    return {**monitor.as_mapping(), THRESHOLDS: {**thresholds, "stuck": stuck, "missing": missing}}


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
