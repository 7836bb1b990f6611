"""`EstimateState`: a filter around any Gymnasium env, its estimate in the observation and in info."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.ma import MaskedArray

from filters.engine.belief import checked_actions
from filters.estimators.estimator import Estimator
from filters.filter import Filter
from filters.monitoring.monitor import Monitor, monitor_of, watch_of
from filters.smoothers.online import WithSmoother
from filters.starts import FirstRestart
from filters.wrappers.arguments import (
    APPENDED,
    OBSERVATIONS,
    EstimatorInSpec,
    ModelInSpec,
    WithMeasuredInputs,
    check_spaces,
    filter_for,
    given_filter,
    split_of,
)
from thruster_env.core.checks import as_floats, one_of, short_repr
from thruster_env.core.checks import seed as checked_seed
from thruster_env.core.streams import draw_key, filter_generator
from thruster_env.model.state_space import StateSpaceModel

FLOAT32 = np.dtype(np.float32)  # a cast to a dtype is quicker than one to its type


class EstimateState(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Run a filter beside an env: predict with the action, update with the measurement.

    The observation becomes, in float32,

    - "estimate": the mean of the state, (n,);
    - "measurement+estimate": the measurement, then the mean, (m + n,);
    - "belief": the mean, then the standard deviations, (2 n,).

    Entries that the env appends to its measurement (validity flags, a reference signal) stay at the end of
    the observation. Some channels of an env may be inputs of the model (`filters.wrappers.arguments`): m
    includes them in the observation, but not in the innovation.

    The info dictionary gains `estimate` (n,), `estimate_cov` (n, n), `innovation` (m,), `innovation_cov` (m, m)
    and `estimate_divergences`, the number of restarts from the prior after an estimate that was not finite; after
    one `estimate_restarts` says which step and states were the first, and the likely cause. All are in the units
    of the model. The measurement is `info["measurement"]` if the env reports it (missing where `measurement_valid`
    is false), otherwise the observation. For a missing measurement, the observation repeats the last one (0 at
    first). The filter predicts with the action clipped to the action space or, if an env replays a log, with
    `info["recorded_input"]`. The filter's random numbers come from the reset seed through a separate stream; the
    env's generator is never used. With a monitor info also gains `health`, with `ok` and the `alarms` of the step
    (`filters.monitoring.Health`). With a smoothing lag it gains `smoothed` (n,) and `smoothed_cov` (n, n): the
    state so many steps ago, given all measurements up to now; in the first steps the state at the reset.

    Args:
        env: any env with Box actions and observations.
        filter: name of a filter in `filters.FILTERS`, which `thruster filters` lists; "ekf" if None. Or a filter
            object with its model, such as `tuning.tune(...).filter`; or an estimator of
            another package, as `filters.estimators.estimator.Estimator`, a function that makes one
            from a model, or "module:object" for either; a covariance that it does not return is zero,
            an innovation NaN.
        observation: one of the three forms above.
        model: None for the model that the env, or a wrapper around it, offers by `state_space_model(**arguments)`,
            as a bow thruster does; "module:factory" of a function that returns a `StateSpaceModel`; or a
            `StateSpaceModel` (which the env's spec cannot hold as JSON).
        tuned: path of a tuned file, which gives filter, parameters and model arguments; or the result of
            `tuning.tune`, whose `filter` is used with its model.
        monitor: tests on the innovations, as a `filters.monitoring.Monitor`, a mapping of its attributes, its
            number of steps between false alarms, or True for its defaults; None for none.
        smoothing_lag: number of steps of a fixed-lag smoother, of the filters kf, ekf, iekf, ukf and ckf; None for
            none.
        model_arguments: mapping of arguments of the env's own model or of the factory: for a bow thruster
            `process_noise_cov`, `measurement_noise_cov`, `prior_cov_factor`, `parameter_factors`,
            `operating_voltage`.
        **numbers: the filter's own parameters, such as `ensemble_size`, or further arguments of the function.

    Raises:
        ValueError: if an argument is unknown or wrong, or spaces and model do not fit.
    """

    def __init__(
        self,
        env: gym.Env,
        filter: str | Filter | Estimator | Callable | None = None,
        observation: str = "estimate",
        model: str | StateSpaceModel | None = None,
        tuned: Any = None,
        model_arguments: Mapping | None = None,
        monitor: Monitor | Mapping | float | None = None,
        smoothing_lag: int | None = None,
        **numbers,
    ):
        model = model.content if isinstance(model, ModelInSpec) else model
        model_in_spec = ModelInSpec(model) if isinstance(model, StateSpaceModel) else model
        filter = filter.content if isinstance(filter, EstimatorInSpec) else filter
        filter, tuned = given_filter(filter, tuned)
        filter_in_spec = filter if filter is None or isinstance(filter, str) else EstimatorInSpec(filter)
        recorded = {
            "filter": filter_in_spec,
            "observation": observation,
            "model": model_in_spec,
            "tuned": tuned,
            **numbers,
        }
        recorded |= {"model_arguments": model_arguments, "smoothing_lag": smoothing_lag}
        watches = monitor_of(monitor)
        recorded["monitor"] = watches and watches.as_mapping()
        gym.utils.RecordConstructorArgs.__init__(self, **recorded)
        gym.Wrapper.__init__(self, env)
        self._form = one_of("observation", observation, OBSERVATIONS)
        self.filter = filter_for(env, filter, model, tuned, model_arguments, numbers)
        split = split_of(env, self.filter.model)
        self._split = bool(split.inputs)  # whether some channels are inputs of the model
        actions = check_spaces(env.action_space, env.observation_space, self.filter.model, len(split.inputs))
        n, m = self.filter.model.n, split.channels
        # What an env appends to its measurement, validity flags and the reference, stays in the observation.
        self._appended = env.get_wrapper_attr(APPENDED) if env.has_wrapper_attr(APPENDED) else 0
        length = {"estimate": n, "measurement+estimate": m + n, "belief": 2 * n}[observation] + self._appended
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, shape=(length,), dtype=np.float32)
        session: Any = self.filter.session()
        if smoothing_lag is not None:
            session = WithSmoother(session, self.filter, smoothing_lag)
        self._lagged = smoothing_lag is not None
        self._session = WithMeasuredInputs(session, split) if split.inputs else session
        self._channels, self._measurements = split.channels, list(split.measurements)
        self._watch, self._first = watch_of(watches, self.filter), FirstRestart(self.filter)
        self._generator = filter_generator(None)
        base: Any = env.unwrapped
        if hasattr(base, "overlay"):  # it draws the estimate beside the truth
            base.render_overlay = self._overlay
        low, high = actions.low.ravel(), actions.high.ravel()
        self._bounds = list(zip(low.tolist(), high.tolist(), strict=True))
        self._has_one_input = len(self._bounds) == 1

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Reset env and filter; the belief is the prior, updated with the first measurement."""
        seed = checked_seed(seed)
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._generator = filter_generator(seed)
        z = _measurement(observation, info)
        m = self._channels
        if np.shape(z) != (m,):
            raise ValueError(f"a measurement must have the model's {m} entries, but got {short_repr(z)}")
        self._last_measured = np.zeros(m)
        self._session.start(draw_key(self._generator), z)
        self._first = FirstRestart(self.filter)
        self._first.note(self._session, None, as_floats(z)[self._measurements])
        if self._watch is not None:
            self._watch.restart()
        return self._observe(observation, z, info), info

    def step(self, action):
        """Step the env, then predict with the clipped action and update with the measurement.

        Raises ValueError, before the env is stepped, for an action that is not numeric or has the wrong size.
        """
        u = self._clipped(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        if "recorded_input" in info:
            u = info["recorded_input"].tolist()
        z = info.get("measurement")
        if z is None or "measurement_valid" in info or type(z) is MaskedArray:
            z = _measurement(observation, info)
        self._session.step(u, z)
        if self._split:
            self._first.note(self._session, self._session.used, as_floats(z)[self._measurements])
        else:
            self._first.note(self._session, u, z)
        return self._observe(observation, z, info), reward, terminated, truncated, info

    def _clipped(self, action) -> Sequence[float]:
        if self._has_one_input and type(action) is np.ndarray and action.size == 1:
            value, (low, high) = action.item(), self._bounds[0]  # the frequent case has to be quick
            if type(value) is float and value == value:
                return (low if value < low else high if value > high else value,)
        values = checked_actions(action, 1, len(self._bounds))[0].tolist()
        return [min(max(v, low), high) for v, (low, high) in zip(values, self._bounds, strict=True)]

    def _overlay(self):
        label, model, session = self.filter.name, self.filter.model, self._session
        base: Any = self.unwrapped
        return base.overlay(label, model, session.mean, session.cov)

    def _observe(self, observation, z, info) -> np.ndarray:
        session = self._session
        mean, cov = session.mean.copy(), session.cov.copy()
        info["estimate"] = mean
        info["estimate_cov"] = cov
        info["innovation"] = session.innovation.copy()
        info["innovation_cov"] = session.innovation_cov.copy()
        info["estimate_divergences"] = np.int64(session.divergences)  # clients may ask for a dtype
        if restarts := self._first.restarts(session.divergences):
            info["estimate_restarts"] = restarts.sentence
        if self._lagged:
            info["smoothed"], info["smoothed_cov"] = session.smoothed()
        if self._watch is not None:
            measured = as_floats(z)[self._measurements]
            info["health"] = self._watch.step(info["innovation"], info["innovation_cov"], measured)
        if self._form == "estimate" and not self._appended:
            return mean.astype(FLOAT32)
        parts = [mean]
        if self._form == "belief":
            parts.append(np.sqrt(np.diag(cov)))
        elif self._form == "measurement+estimate":
            self._last_measured = np.where(np.isnan(z), self._last_measured, z)
            parts.insert(0, self._last_measured)
        if self._appended:
            parts.append(observation[-self._appended :])
        return np.concatenate(parts).astype(np.float32)


def _measurement(observation, info) -> np.ndarray:
    z = info.get("measurement")
    if z is None:
        return as_floats(observation).ravel()
    z, valid = as_floats(z), info.get("measurement_valid")
    return z if valid is None else np.where(valid, z, np.nan)
