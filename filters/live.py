"""A filter on real clocks: steps of any length, each sensor at its own times, late samples put in order."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from filters.engine.belief import Belief, vector_like
from filters.engine.session import Session
from filters.monitoring import Alarm, Health, Monitor, monitor_of, watch_of
from filters.starts import FirstRestart, Restarts
from thruster_env.core.checks import as_floats, finite, one_of, positive, short_repr
from thruster_env.logs.grid import closeness, count_steps, resolution_of

if TYPE_CHECKING:
    from filters.filter import Filter


class Event(NamedTuple):
    """A prediction or an update, with the belief and the monitor's memory before it."""

    begin: float
    end: float  # a prediction from `begin` to here; the same for an update
    signal: np.ndarray  # u (p,) of a prediction, z (m,) of an update
    before: Belief
    length: float  # of the step before it
    tests: tuple  # the monitor's memory

    @property
    def is_prediction(self) -> bool:
        """Whether it moves the clock."""
        return self.end > self.begin


class Live:
    """One belief, predicted to any time and updated with any sensor.

        live = make_filter("ekf", thruster_model()).live(late=0.5)
        live.start(12.30)
        live.predict_to(12.314, u=[11.0])     # what acted since 12.30
        live.update(12.314, "thrust", 3.2)

    The sample time has to be one of the model's constants, by the name `dt`, or `substep` for a part of it. A
    longer step is divided into equal ones that are at most as long, up to a million. Q of a step of length dt is
    that of the model for its own sample time, times the ratio of the two, unless `noise` says otherwise. A Kalman
    filter has A and B of each length, `imm` the transitions of its modes within it.

    Args:
        filter_: any filter of such a model.
        noise: Q (n, n) of a step by its length [s], as `ContinuousModel.noise`; None for Gaussian diffusion.
        late: how late [s] a sample may arrive. The filter goes back, updates with it and repeats all later steps,
            so the estimate is as if it had arrived in time.
        skip_missing: whether a NaN is left out; else it is refused.
        monitor: tests on the innovations, as wrappers take them. It tests samples in the order of measurement, so
            it goes back for a late one, too. Each update, of any sensor, is one of its steps.
        resolution: of the stamps [s]; that of float64 where it is coarser, as for seconds since 1970. Two stamps
            no further apart are equal, and a step that exceeds the sample time by no more is one step.

    Attributes:
        time: of the belief [s].
        mean, cov: views on its mean (n,) and covariance (n, n).
        innovation, innovation_cov: of the last update.
        health: the monitor's verdict at the last update, with the alarms that a late sample raised at later ones;
            None without a monitor.

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
        self._step = filter_.sample_time if filter_.by_length else self._session.sample_time
        self._late = positive("late", late, zero_allowed=True)
        self._resolution = positive("resolution", resolution, zero_allowed=True)
        self._noise, self._skips = noise, skip_missing
        self._has_one_q = "Q" in filter_.fixed_noise  # which is that of a step as long as the model's
        if noise is not None:
            filter_.check_noise(process_noise_cov=noise)
        self._watch, self._first = watch_of(monitor_of(monitor), filter_), FirstRestart(filter_)
        self._filter = filter_
        model = filter_.model
        self._channels = {quantity.symbol: i for i, quantity in enumerate(model.measurements)}
        self._nothing, self._inputs = np.full(model.channels, np.nan), model.inputs
        self._events: list[Event] = []
        self._raised: list[tuple[Alarm, ...]] = []  # by the monitor at each event
        self._acting_input = np.zeros(0)  # since the last prediction
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

    def latest(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """Copies of mean, covariance and the last innovation with its covariance, and its log-likelihood."""
        return self._session.latest()

    def start(self, time: float, z: Sequence[float] | np.ndarray | None = None, key=(0, 0)) -> None:
        """Begin with the prior at a time [s], updated with a measurement z (m,) if there is one."""
        time = finite("time", time)
        measured = (
            self._nothing if z is None else self._checked(np.broadcast_to(as_floats(z), self._nothing.shape))
        )
        self._set_length(self._step, self._session)
        self._session.start(key, measured)
        self._first, self._last = FirstRestart(self._filter), None
        self._first.note(self._session, None, measured)
        self._events, self._raised, self.time, self._acting_input = [], [], time, np.zeros(0)
        if self._watch is not None:
            self._watch.restart()
            self.health = self._watch.step(self.innovation, self.innovation_cov, measured)

    def predict_to(self, time: float, u: Sequence[float] | np.ndarray | None = None) -> None:
        """Move the belief on to a time [s], under the input u (p,) that has acted since the last one.

        Raises ValueError for an earlier time, or an input that is not finite numbers.
        """
        self._has_begun()
        time = finite("time", time)
        near = self._near(time)
        if time < self.time - near:
            raise ValueError(f"time must not step back behind {self.time:.9g} s, but got {time:.9g}")
        checked = as_floats(() if u is None else u).reshape(-1)
        if checked.shape != (self._inputs,) or not np.isfinite(checked).all():
            count = f"{self._inputs} finite numbers" if self._inputs else "empty, because the model has no inputs"
            raise ValueError(f"u must be {count}, but got {short_repr(u)}")
        if time > self.time + near:
            self._predict(time, checked)

    def update(self, time: float, sensor: str | Sequence[str] | None, z: float | Sequence[float]) -> None:
        """Update with a sensor's measurement at a time [s].

        If that is later than the belief, the filter first predicts to it under the last input. If it is earlier by
        at most `late`, the filter goes back and repeats all later steps.

        Args:
            time: at which it was measured, not at which it arrived.
            sensor: symbol of a channel, several, or None for all.
            z: as many numbers.

        Raises:
            ValueError: for an unknown sensor, an infinite number, NaN where that is refused, or a sample that is
                too late.
        """
        self._has_begun()
        time, measured = finite("time", time), self._measured(sensor, z)
        near = self._near(time)
        if time > self.time + near:
            self._predict(time, self._acting_input)
        if time >= self.time - near:
            alarms = self._update(measured)
        elif time < self.time - self._late - near:
            rule = f"a sample must be at most late = {self._late:g} s late"
            raise ValueError(f"{rule}, but one of {time:.9g} s came at {self.time:.9g} s")
        else:
            alarms = self._insert(time, measured, near)
        if self.health is not None:
            self.health = Health(self.health.ok, alarms)

    def smoothed(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Mean (n,) and covariance (n, n) at an earlier time [s], given all samples so far.

        Rauch, Tung and Striebel's recursion (`filters.smooth`) over the steps since then, from the filter's
        estimates that it keeps for late samples. With the same lag behind `time` after each sample this is a
        fixed-lag smoother.

        Args:
            time: at most `late` before that of the belief.

        Raises:
            ValueError: for a filter without such a smoother, another time, or a restart in between.
        """
        from filters.filter import PageFilter  # which knows this module
        from filters.rts import passes, relation_of

        self._has_begun()
        relation, time = relation_of(self._filter, "smoothed"), finite("time", time)
        steps = [event for event in self._events if event.is_prediction and event.end > time + self._near(time)]
        begin = steps[0].begin if steps else self.time
        if not begin - self._near(time) <= time <= self.time + self._near(time):
            earliest = min((event.begin for event in self._events), default=self.time)
            rule = f"time must be within late = {self._late:g} s before the belief"
            raise ValueError(f"{rule}, {earliest:.9g} to {self.time:.9g} s, but got {time:.9g}")
        later, session = self._session.belief(), Session(self._filter)
        at = (later.mean, later.cov)
        begun = [event.before for event in steps]
        if any(belief.divergences != later.divergences for belief in begun):
            raise ValueError(f"time must be after the last restart, but got {time:.9g}")
        assert isinstance(self._filter, PageFilter)  # as all that have a relation
        run = passes(self._filter, relation)
        for event in reversed(steps):
            parts = [(event.begin, event.end)]
            if event.begin < time - self._near(time):
                parts = [(event.begin, time), (time, event.end)]
            session.load(event.before)
            beliefs = [(session.mean.copy(), session.cov.copy())]
            numbers: list[np.ndarray] = []
            first = 0
            for start, end in parts:
                first = len(numbers)  # of the row of `time`
                for _ in range(self._steps_between(session, start, end)):
                    session.run("predict", u=event.signal)
                    beliefs.append((session.mean.copy(), session.cov.copy()))
                    numbers.append(session.numbers.copy())
            beliefs[-1] = at
            means, covs = (np.array(part)[None] for part in zip(*beliefs, strict=True))
            inputs, restarted = np.tile(event.signal, (1, len(numbers), 1)), np.zeros(means.shape[:2], bool)
            means, covs = run((means, covs, restarted), inputs, len(numbers), np.array(numbers))
            at = means[0, first], covs[0, first]
        return at

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
        measured = self._nothing.copy()
        for name, value in zip(names, values.tolist(), strict=True):
            measured[self._channels[one_of("sensor", name, tuple(self._channels))]] = value
        self._checked(values)
        return measured

    def _checked(self, values: np.ndarray) -> np.ndarray:
        vector_like("z", values, values, missing_allowed=True)
        if not self._skips and np.isnan(values).any():
            raise ValueError(f"z must not be NaN with skip_missing=False, but got {short_repr(values.tolist())}")
        return values

    def _predict(self, time: float, u: np.ndarray) -> None:
        if len(u) != self._inputs:
            raise ValueError(
                f"predict_to(time, u) must give the input before a sample at {time:.9g} s, a later time"
            )
        self._remember(time, u)
        self._repeat(u, self._steps_between(self._session, self.time, time))
        self._last = u
        self.time, self._acting_input = time, u

    def _steps_between(self, session: Session, begin: float, end: float) -> int:
        """The number of equal steps between two times [s], for whose length a session gets F and Q."""
        exact = resolution_of(max(abs(begin), abs(end)), self._resolution)
        count = count_steps(end - begin, self._step, exact)
        length = (end - begin) / count
        self._set_length(length, session)
        if self._noise is not None:
            session.set_noise(process_noise_cov=self._noise(length))
        elif not self._filter.by_length and not (
            self._has_one_q and abs(length - self._step) <= closeness(self._step, exact)
        ):
            session.scale_process_noise(length / self._step)
        return count

    def _repeat(self, u: np.ndarray, count: int) -> None:
        """Predict under one input; if the result is not finite, repeat it and note the last finite belief."""
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

    def _set_length(self, length: float, session: Session) -> None:
        if session is self._session:
            self._length = length
        if self._filter.by_length:
            session.set_numbers(self._filter.of_length(length).numbers)
        else:
            session.set_dt(length)

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

    def _remember(self, end: float, signal: np.ndarray) -> None:
        """Keep the next event for as long as a late sample may precede it."""
        if self._late > 0.0:
            tests = () if self._watch is None else self._watch.memory()
            self._events.append(Event(self.time, end, signal, self._session.belief(), self._length, tests))
            self._raised.append(())
            oldest = end - self._late - self._near(end)
            while self._events[0].end < oldest:
                del self._events[0], self._raised[0]

    def _insert(self, time: float, z: np.ndarray, near: float) -> tuple[Alarm, ...]:
        """Go back to a time, update with its measurement, and repeat all later events; return the new alarms."""
        index = next((i for i, event in enumerate(self._events) if event.end > time + near), None)
        if index is None or self._events[index].begin > time + near:
            raise ValueError(f"a sample must not be earlier than the start, but got one at {time:.9g} s")
        again, self._events = self._events[index:], self._events[:index]
        raised, self._raised = self._raised[index:], self._raised[:index]
        first = again[0]
        self._session.load(first.before)
        self._set_length(first.length, self._session)
        self.time = first.begin
        if self._watch is not None:
            self._watch.recall(first.tests)
        if time > first.begin + near:
            self._predict(time, first.signal)
        alarms = list(self._update(z))
        for event in again:
            if event.is_prediction:
                self._predict(event.end, event.signal)
            else:
                alarms += self._update(event.signal)
        for old in (alarm for alarms_before in raised for alarm in alarms_before):  # it may now come later
            same = [new for new in alarms if (new.test, new.channel) == (old.test, old.channel)]
            if same:
                alarms.remove(same[0])
        return tuple(alarms)
