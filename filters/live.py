"""A filter on real clocks: steps of any length, each sensor at its own times, late samples put in order."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from filters.engine.belief import Belief, vector_like
from filters.engine.session import Session
from filters.monitoring.monitor import Alarm, Health, Monitor, monitor_of, watch_of
from filters.starts import FirstRestart, Restarts
from thruster_env.core.checks import as_floats, finite, one_of, positive, short_repr
from thruster_env.core.stamps import closeness, count_steps, resolution_of

if TYPE_CHECKING:
    from filters.filter import Filter


class Event(NamedTuple):
    """Something that was done, and the belief and the monitor before it."""

    begin: float
    end: float  # a prediction from `begin` to here; the same for an update
    given: np.ndarray  # u (p,) of a prediction, z (m,) of an update
    before: Belief
    length: float  # of the step before it
    tests: tuple  # what the monitor remembered

    @property
    def is_prediction(self) -> bool:
        """Whether time goes on in it."""
        return self.end > self.begin


class Live:
    """One belief, moved on to any time and updated with any sensor.

        live = make_filter("ekf", thruster_model()).live(late=0.5)
        live.start(12.30)
        live.predict_to(12.314, u=[11.0])     # what acted since 12.30
        live.update(12.314, "thrust", 3.2)

    The sample time has to be one of the model's constants, by the name `dt`, or `substep` for a part of it. A
    longer step is divided into equal ones that are at most as long, up to a million. Q of a step of length dt is
    that of the model for its own sample time, times the ratio of the two, unless `noise` says otherwise.

    Args:
        filter_: any filter of such a model.
        noise: Q (n, n) of a step by its length [s], as `ContinuousModel.noise`; None for Gaussian diffusion.
        late: samples that are so late [s] are put in order: the filter goes back, takes them, and repeats what
            came after. The estimate is that of the right order.
        skip_missing: whether a NaN is left out; else it is refused.
        monitor: tests on the innovations, as wrappers take them. It sees all samples in the order in which they
            were measured: where a late one comes in, it goes back as well. Its steps are updates, of any sensor.
        resolution: of the stamps [s]; float64's where that is coarser, as of seconds since 1970. Two stamps that
            are no further apart are one, and a step that is longer than the sample time by no more is one step.

    Attributes:
        time: of the belief [s].
        mean, cov: views on its mean (n,) and covariance (n, n).
        innovation, innovation_cov: of the last update.
        health: what the monitor said at the last update, with the alarms that a late sample brought about at later
            ones; None without a monitor.

    Raises:
        ValueError: for a model without such a constant, or a wrong argument.
    """

    def __init__(
        self,
        filter_: Filter,
        *,
        noise: Callable[[float], Any] | None = None,
        late: float = 0.0,
        skip_missing: bool = True,
        monitor: Monitor | Mapping | float | None = None,
        resolution: float = 0.0,
    ):
        """Find the sample time; `start` comes next."""
        self._session = Session(filter_)
        self._step = self._session.sample_time
        self._late = positive("late", late, zero_allowed=True)
        self._resolution = positive("resolution", resolution, zero_allowed=True)
        self._noise, self._skips = noise, skip_missing
        self._has_one_q = "Q" in filter_.fixed_noise  # which is that of a step as long as the model's
        self._watch, self._first = watch_of(monitor_of(monitor), filter_), FirstRestart(filter_)
        self._filter = filter_
        model = filter_.model
        self._channels = {one.symbol: i for i, one in enumerate(model.measurements)}
        self._nothing, self._inputs = np.full(model.m, np.nan), model.inputs
        self._events: list[Event] = []
        self._raised: list[tuple[Alarm, ...]] = []  # by the monitor at each event
        self._held = np.zeros(0)  # the input that acts
        self._length = self._step  # of the last step
        self._last: np.ndarray | None = None  # the input of a prediction that no update has followed
        self.time = math.nan
        self.health: Health | None = None

    @property
    def mean(self) -> np.ndarray:
        """View of the mean (n,)."""
        return self._session.mean

    @property
    def cov(self) -> np.ndarray:
        """View of the covariance (n, n)."""
        return self._session.cov

    @property
    def innovation(self) -> np.ndarray:
        """View of the innovation (m,) of the last update."""
        return self._session.innovation

    @property
    def innovation_cov(self) -> np.ndarray:
        """View of its covariance (m, m)."""
        return self._session.innovation_cov

    @property
    def divergences(self) -> int:
        """Restarts from the prior, so far."""
        return self._session.divergences

    @property
    def restarts(self) -> Restarts | None:
        """The same with the first one's update, states and likely cause; None if there was none."""
        return self._first.restarts(self.divergences)

    def told(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """Copies of mean, covariance and the last innovation with its covariance, and its log-likelihood."""
        return self._session.told()

    def start(self, time: float, z: Sequence[float] | np.ndarray | None = None, key=(0, 0)) -> None:
        """Begin with the prior at a time [s], updated with a measurement z (m,) if there is one."""
        time = finite("time", time)
        given = self._nothing if z is None else self._checked(np.broadcast_to(as_floats(z), self._nothing.shape))
        self._set_length(self._step)
        self._session.start(key, given)
        self._first, self._last = FirstRestart(self._filter), None
        self._first.note(self._session, None, given)
        self._events, self._raised, self.time, self._held = [], [], time, np.zeros(0)
        if self._watch is not None:
            self._watch.restart()
            self.health = self._watch.step(self.innovation, self.innovation_cov, given)

    def predict_to(self, time: float, u: Sequence[float] | np.ndarray | None = None) -> None:
        """Move the belief on to a time [s], under the input u (p,) that has acted since the last one.

        Raises ValueError for an earlier time, or an input that is not finite numbers.
        """
        self._has_begun()
        time = finite("time", time)
        near = self._near(time)
        if time < self.time - near:
            raise ValueError(f"time must not step back behind {self.time:.9g} s, but got {time:.9g}")
        given = as_floats(() if u is None else u).reshape(-1)
        if given.shape != (self._inputs,) or not np.isfinite(given).all():
            raise ValueError(f"u must be {self._inputs} finite numbers, but got {short_repr(u)}")
        if time > self.time + near:
            self._predict(time, given)

    def update(self, time: float, sensor: str | Sequence[str] | None, z: float | Sequence[float]) -> None:
        """Take what a sensor measured at a time [s].

        A later time than that of the belief is first predicted to, under the last input. An earlier one is put in
        order, if it is not later than `late`.

        Args:
            time: at which it was measured, not at which it arrived.
            sensor: symbol of a channel, several, or None for all.
            z: as many numbers.

        Raises:
            ValueError: for an unknown sensor, an infinite number, NaN where that is refused, or a sample that is
                too late.
        """
        self._has_begun()
        time, given = finite("time", time), self._measured(sensor, z)
        near = self._near(time)
        if time > self.time + near:
            self._predict(time, self._held)
        if time >= self.time - near:
            alarms = self._update(given)
        elif time < self.time - self._late - near:
            raise ValueError(
                f"a sample must be at most late = {self._late:g} s late, but one of {time:.9g} s came at "
                f"{self.time:.9g} s"
            )
        else:
            alarms = self._insert(time, given, near)
        if self.health is not None:
            self.health = Health(self.health.ok, alarms)

    def _has_begun(self) -> None:
        if math.isnan(self.time):
            raise ValueError("start(time) must come before predict_to and update")

    def _near(self, time: float) -> float:
        """How far two stamps may be apart to be one [s]."""
        return closeness(self._step, resolution_of(max(abs(time), abs(self.time)), self._resolution))

    def _measured(self, sensor: str | Sequence[str] | None, z: float | Sequence[float]) -> np.ndarray:
        values = as_floats([z] if np.ndim(z) == 0 else z).reshape(-1)  # a single None is missing, too
        names = [sensor] if isinstance(sensor, str) else list(self._channels) if sensor is None else list(sensor)
        if len(values) != len(names):
            raise ValueError(f"z must have a number for each of {', '.join(names)}, but got {short_repr(z)}")
        given = self._nothing.copy()
        for name, value in zip(names, values.tolist(), strict=True):
            given[self._channels[one_of("sensor", name, tuple(self._channels))]] = value
        self._checked(values)
        return given

    def _checked(self, values: np.ndarray) -> np.ndarray:
        vector_like("z", values, values, missing_allowed=True)
        if not self._skips and np.isnan(values).any():
            raise ValueError(f"z must not be NaN with skip_missing=False, but got {short_repr(values.tolist())}")
        return values

    def _predict(self, time: float, u: np.ndarray) -> None:
        """Steps of equal length up to a time."""
        session = self._session
        if len(u) != self._inputs:
            raise ValueError(
                f"predict_to(time, u) must give the input before a sample at {time:.9g} s, a later time"
            )
        exact = resolution_of(max(abs(time), abs(self.time)), self._resolution)
        count = count_steps(time - self.time, self._step, exact)
        length = (time - self.time) / count
        self._remember(time, u)
        self._set_length(length)
        if self._noise is not None:
            session.set_noise(process_noise_cov=self._noise(length))
        elif not (self._has_one_q and abs(length - self._step) <= closeness(self._step, exact)):
            session.scale_process_noise(length / self._step)
        self._repeat(u, count)
        self._last = u
        self.time, self._held = time, u

    def _repeat(self, u: np.ndarray, count: int) -> None:
        """Predictions under one input; if they end at no finite number once more, to hold the last one that is."""
        session, before = self._session, self._session.belief()
        self._first.hold(session)
        session.run("predict", u=u, count=count)
        if count > 1 and not self._is_finite():
            session.load(before)
            while count > 0 and self._is_finite():
                self._first.hold(session)
                session.run("predict", u=u)
                count -= 1
            session.run("predict", u=u, count=count)

    def _is_finite(self) -> bool:
        return bool(np.isfinite(self.mean).all() and np.isfinite(self.cov).all())

    def _set_length(self, length: float) -> None:
        self._length = length
        self._session.set_dt(length)

    def _update(self, z: np.ndarray) -> tuple[Alarm, ...]:
        """Update with z (m,); return the alarms of the monitor."""
        self._remember(self.time, z)
        self._session.run("update", z=z)
        self._first.note(self._session, self._last, z)
        self._last = None
        if self._watch is None:
            return ()
        self.health = self._watch.step(self.innovation, self.innovation_cov, z)
        if self._raised:
            self._raised[-1] = self.health.alarms
        return self.health.alarms

    def _remember(self, end: float, given: np.ndarray) -> None:
        """Keep what is about to be done as long as a late sample may come before it."""
        if self._late > 0.0:
            tests = () if self._watch is None else self._watch.memory()
            self._events.append(Event(self.time, end, given, self._session.belief(), self._length, tests))
            self._raised.append(())
            oldest = end - self._late - self._near(end)
            while self._events[0].end < oldest:
                del self._events[0], self._raised[0]

    def _insert(self, time: float, z: np.ndarray, near: float) -> tuple[Alarm, ...]:
        """Go back to a time, take what was measured there, and do again what came after it.

        Returns the alarms that there were not before.
        """
        place = next((i for i, one in enumerate(self._events) if one.end > time + near), None)
        if place is None or self._events[place].begin > time + near:
            raise ValueError(f"a sample must not be earlier than the start, but got one at {time:.9g} s")
        again, self._events = self._events[place:], self._events[:place]
        raised, self._raised = self._raised[place:], self._raised[:place]
        first = again[0]
        self._session.load(first.before)
        self._set_length(first.length)
        self.time = first.begin
        if self._watch is not None:
            self._watch.recall(first.tests)
        if time > first.begin + near:
            self._predict(time, first.given)
        alarms = list(self._update(z))
        for one in again:
            if one.is_prediction:
                self._predict(one.end, one.given)
            else:
                alarms += self._update(one.given)
        for old in (alarm for some in raised for alarm in some):  # of which one may come some steps later now
            same = [new for new in alarms if (new.test, new.channel) == (old.test, old.channel)]
            if same:
                alarms.remove(same[0])
        return tuple(alarms)
