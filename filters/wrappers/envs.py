"""`EstimateState` and `EstimateStates`: a filter around any Gymnasium env, or on every copy of a vector env.

The estimate is in the observation and in info. All copies of a vector env are filtered in one compiled call.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from filters.engine.batch import Beliefs
from filters.engine.belief import checked_actions
from filters.estimators.foreign import Estimator, EstimatorBeliefs, ForeignFilter
from filters.filter import Filter
from filters.monitoring import Monitor, monitor_of, watch_of
from filters.named import NamedMaker, model_named
from filters.smoothers import WithSmoother
from filters.starts import FirstRestart, FirstRestarts
from filters.wrappers.arguments import (
    OBSERVATIONS,
    EstimatorInSpec,
    ModelInSpec,
    WithMeasuredInputs,
    appended_entries,
    check_spaces,
    clipping_space,
    filter_for,
    given_filter,
    refuse_normalised,
    split_of,
    warn_if_far,
)
from thruster_env.core.checks import as_floats, one_of, short_repr
from thruster_env.core.checks import seed as checked_seed
from thruster_env.core.streams import EpisodeKeys, draw_key, filter_generator, reset_mask
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
        env: any env with Box actions and observations. What changes its actions, as `RescaleAction` does, belongs
            around the filter if the model is the env's own.
        filter: name of a filter in `filters.FILTERS`, which `thruster filters` lists; "ekf" if None. Or a filter
            object with its model, such as `tuning.tune(...).filter`; or an estimator of
            another package, as `filters.estimators.foreign.Estimator`, a function that makes one
            from a model, or "module:object" for either; a covariance that it does not return is zero,
            an innovation NaN.
        observation: one of the three forms above.
        model: None for the model that the env, or a wrapper around it, offers by `state_space_model(**arguments)`,
            as a bow thruster does; a model by name with its numbers, such as
            "constant-velocity:acceleration=0.04,R=0.25" or "pendulum:length=0.4" (`filters.named`), of the env's
            `dt`; "module:factory" of a function that returns a `StateSpaceModel`; or a `StateSpaceModel` (which
            the env's spec cannot hold as JSON). Of a model without inputs the filter ignores the actions.
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
        self._name = str(model) if isinstance(model_named(model), NamedMaker) else ""
        self.filter = filter_for(env, filter, model, tuned, model_arguments, numbers)
        split = split_of(env, self.filter.model)
        self._split = bool(split.inputs)  # whether some channels are inputs of the model
        actions = check_spaces(clipping_space(env), env.observation_space, self.filter.model, len(split.inputs))
        n, m = self.filter.model.n, split.channels
        # What an env appends to its measurement, validity flags and the reference, stays in the observation.
        self._appended = appended_entries(env)
        length = {"estimate": n, "measurement+estimate": m + n, "belief": n + self.filter.model.t}[observation]
        length += self._appended
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
        refuse_normalised(self.env, info)
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
        if self._name:
            warn_if_far(self._name, self._session.innovation, self._session.innovation_cov)
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
        if z is None or "measurement_valid" in info or hasattr(z, "filled"):
            z = _measurement(observation, info)
        self._session.step(u, z)
        if self._split:
            self._first.note(self._session, self._session.used, as_floats(z)[self._measurements])
        else:
            self._first.note(self._session, u, z)
        return self._observe(observation, z, info), reward, terminated, truncated, info

    def _clipped(self, action) -> Sequence[float]:
        if not self._bounds:
            return ()
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


class EstimateStates(gym.vector.VectorWrapper):
    """Run a filter beside every copy of a vector env, as `EstimateState` does beside a single env.

    Copy i of `reset(seed=s)` equals an `EstimateState` around a single env with `reset(seed=s + i)`, later
    episodes too. A copy whose episode begins starts from the prior, updated with the first measurement: in the
    mode NEXT_STEP at the step after the end, whose action is ignored; in SAME_STEP within the step, and then
    `final_obs` and `final_info` hold the last estimate; in DISABLED where `options["reset_mask"]` is true.

    The info dictionary gains, with one row for each copy, `estimate` (N, n), `estimate_cov` (N, n, n),
    `innovation` (N, m), `innovation_cov` (N, m, m) and `estimate_divergences` (N,); with a monitor `health`, an
    array of N objects; with a smoothing lag `smoothed` (N, n) and `smoothed_cov` (N, n, n). In a step in which
    copies restart from the prior, and in no other, `estimate_restarts` has a sentence for each of these.

    Args:
        env: any vector env with Box actions and observations.
        filter, observation, model, tuned, model_arguments, monitor, smoothing_lag, **numbers: those of
            `EstimateState`.

    Raises:
        ValueError: if an argument is unknown or wrong, or spaces and model do not fit.
    """

    def __init__(
        self,
        env: gym.vector.VectorEnv,
        filter: str | Filter | Estimator | Callable | None = None,
        observation: str = "estimate",
        model: str | StateSpaceModel | None = None,
        tuned: Any = None,
        model_arguments: Mapping | None = None,
        monitor: Monitor | Mapping | float | None = None,
        smoothing_lag: int | None = None,
        **numbers,
    ):
        super().__init__(env)
        self._form = one_of("observation", observation, OBSERVATIONS)
        filter, tuned = given_filter(filter, tuned)
        self._name = str(model) if isinstance(model_named(model), NamedMaker) else ""
        self.filter = filter_for(env, filter, model, tuned, model_arguments, numbers)
        split = split_of(env, self.filter.model)
        inputs = len(split.inputs)
        actions = check_spaces(clipping_space(env), env.single_observation_space, self.filter.model, inputs)
        self._n, self._m = self.filter.model.n, split.channels
        self._appended = appended_entries(env)
        length = {
            "estimate": self._n,
            "measurement+estimate": self._m + self._n,
            "belief": self._n + self.filter.model.t,
        }[observation]
        shape = (length + self._appended,)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, shape=shape, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.autoreset_mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        kind = EstimatorBeliefs if isinstance(self.filter, ForeignFilter) else Beliefs
        beliefs: Any = kind(self.filter, self.num_envs)
        if smoothing_lag is not None:
            beliefs = WithSmoother(beliefs, self.filter, smoothing_lag, self.num_envs)
        self._lagged = smoothing_lag is not None
        self._beliefs = WithMeasuredInputs(beliefs, split) if inputs else beliefs
        self._restarts, self._used = FirstRestarts(self.filter, self.num_envs), np.zeros((self.num_envs, 0))
        self._keys = EpisodeKeys(self.num_envs, filter_generator)
        self._last_measured = np.zeros((self.num_envs, self._m))
        watches = monitor_of(monitor)
        watches_of_copies = [watch_of(watches, self.filter) for _ in range(self.num_envs)]
        self._watches = [watch for watch in watches_of_copies if watch is not None]  # of all copies, or of none
        self._reports: list = [None] * self.num_envs
        self._measured = list(split.measurements)
        self._done, self._begun = np.zeros(self.num_envs, dtype=bool), False
        self._low, self._high = actions.low.ravel(), actions.high.ravel()

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict | None = None):
        """Reset the env and the beliefs of the copies that it resets."""
        mask = reset_mask(options, self._keys)
        self._keys.seeds(seed)  # a wrong one changes nothing
        seeds: Any = seed  # Gymnasium takes a list of them, too, but its annotation does not say so
        observations, info = self.env.reset(seed=seeds, options=options)
        refuse_normalised(self.env, info)
        which = np.ones(self.num_envs, dtype=bool) if mask is None else mask
        self._keys.seed(seed, which)
        z = self._measurements(observations, info)
        self._start(which, z)
        self._done[which] = False
        return self._observe(observations, z, info, stepped=which), info

    def step(self, actions):
        """Step the env, then predict with the clipped actions and update with the measurements.

        Raises ValueError, before the envs are stepped, for actions that are not numeric or have the wrong size.
        """
        if not self._begun:
            raise gym.error.ResetNeeded("copies must begin with reset(), but step came first")
        ignored = self._done if self.autoreset_mode == AutoresetMode.NEXT_STEP else False
        u = np.zeros((self.num_envs, 0))
        if len(self._low):
            u = np.clip(checked_actions(actions, self.num_envs, len(self._low), ignored), self._low, self._high)
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        if "recorded_input" in info:
            u = np.where(info["_recorded_input"][:, None], info["recorded_input"], u)
        z = self._measurements(observations, info)
        done = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP and done.any():
            last = info.get("final_info", {})
            u = np.where(done[:, None], last["recorded_input"], u) if "recorded_input" in last else u
            self._end(u, z, done, observations, info)
            self._start(done, z)
        elif self.autoreset_mode == AutoresetMode.NEXT_STEP and self._done.any():
            self._advance(u, z, idle=self._done)
            self._start(self._done, z)
        else:
            self._advance(u, z)
        self._done = done
        return self._observe(observations, z, info), rewards, terminated, truncated, info

    def _advance(self, u: np.ndarray, z: np.ndarray, **idle: np.ndarray) -> None:
        self._beliefs.step(u, z, **idle)
        self._used = getattr(self._beliefs, "used", u)

    def _start(self, mask: np.ndarray, z: np.ndarray) -> None:
        which, self._begun = np.flatnonzero(mask), True  # the first time they are all
        self._restarts.start(which)
        self._last_measured[which] = 0.0
        for i in which if self._watches else ():
            self._watches[i].restart()
        self._beliefs.start(which, self._keys.draw(which), z)
        if self._name:
            m, part = self.filter.model.m, self._beliefs.part
            warn_if_far(self._name, part("innovation", m)[which], part("innovation_cov", m, m)[which])

    def _end(self, u, z, done, observations, info) -> None:
        """Update with the last measurements of episodes that end; put these estimates into final_obs and info."""
        final = np.full(self.num_envs, None, dtype=object) if "final_obs" not in info else info["final_obs"]
        observations = observations.copy()
        for i in np.flatnonzero(done):
            observations[i] = final[i]
        final_info = info.setdefault("final_info", {})
        last = np.where(done[:, None], self._measurements(observations, final_info), z)
        self._advance(u, last)
        last_observations = self._observe(observations, last, final_info, done)
        info["final_obs"] = final.copy()
        for i in np.flatnonzero(done):
            info["final_obs"][i] = last_observations[i]

    def _measurements(self, observations, info) -> np.ndarray:
        z = info.get("measurement")
        if z is None:
            z = observations.reshape(self.num_envs, -1)
        z = as_floats(z)
        if z.shape != (self.num_envs, self._m):
            rule = f"measurements must have shape {(self.num_envs, self._m)}"
            raise ValueError(f"{rule}, but got {short_repr(np.shape(z))}")
        reported, valid = info.get("_measurement"), info.get("measurement_valid")
        if reported is not None and not np.all(reported):  # Gymnasium has zeros for copies that reported none
            observed = as_floats(observations).reshape(self.num_envs, -1)[:, : self._m]
            z = np.where(reported[:, None], z, observed)
        if valid is None:
            return z
        flagged = info.get("_measurement_valid")
        return np.where(valid if flagged is None else valid | ~flagged[:, None], z, np.nan)

    def _observe(
        self, observations, z, info: dict[str, Any], mask: np.ndarray | None = None, stepped=None
    ) -> np.ndarray:
        """Report copies of a mask; those of `stepped` (N,), by default all, have a new measurement."""
        n, m, beliefs = self._n, self.filter.model.m, self._beliefs
        mean, cov = beliefs.part("mean", n), beliefs.part("cov", *[self.filter.model.t] * 2)
        reported = np.ones(self.num_envs, dtype=bool) if mask is None else mask.copy()
        stepped = reported if stepped is None else stepped
        added = {
            "estimate": mean,
            "estimate_cov": cov,
            "innovation": beliefs.part("innovation", m),
            "innovation_cov": beliefs.part("innovation_cov", m, m),
            "estimate_divergences": beliefs.part("divergences").astype(np.int64),
        }
        if self._lagged:
            added["smoothed"], added["smoothed_cov"] = beliefs.smoothed()
        if self._watches:
            added["health"] = self._health(added["innovation"], added["innovation_cov"], z, reported, stepped)
        info |= added
        info |= {f"_{key}": reported for key in added}
        counts, measured = added["estimate_divergences"], z[:, self._measured]
        restarts = self._restarts.note(stepped, counts, (mean, cov), self._used, measured)
        if restarts is not None:
            restarted = np.array([sentence is not None for sentence in restarts])
            info |= {"estimate_restarts": restarts, "_estimate_restarts": restarted}
        parts = [mean]
        if self._form == "belief":
            parts.append(np.sqrt(np.diagonal(cov, axis1=1, axis2=2)))
        elif self._form == "measurement+estimate":
            self._last_measured = np.where(np.isnan(z) | ~stepped[:, None], self._last_measured, z)
            parts.insert(0, self._last_measured)
        if self._appended:
            parts.append(observations[:, -self._appended :])
        return np.concatenate(parts, axis=1).astype(np.float32)

    def _health(self, innovations: np.ndarray, covs: np.ndarray, z: np.ndarray, reported, stepped) -> np.ndarray:
        """Reports (N,) of the monitors, without a new measurement the last; None of copies that are not there."""
        reports = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(reported):
            if stepped[i]:
                self._reports[i] = self._watches[i].step(innovations[i], covs[i], z[i, self._measured])
            reports[i] = self._reports[i]
        return reports


def make_env(
    env_id: str,
    filter: str = "ekf",
    observation: str = "estimate",
    filter_arguments: Mapping | None = None,
    model_arguments: Mapping | None = None,
    **env_arguments,
) -> EstimateState:
    """A single env of an id with a filter around it; see `EstimateState` for the arguments.

    `filter_arguments` are the filter's own parameters; all arguments that are not named here go to the env.
    """
    env = _made(gym.spec(env_id).entry_point, env_arguments)
    numbers = _checked(filter_arguments)
    return EstimateState(env, filter, observation, model_arguments=model_arguments, **numbers)


def make_vector_env(
    env_id: str,
    filter: str = "ekf",
    observation: str = "estimate",
    filter_arguments: Mapping | None = None,
    model_arguments: Mapping | None = None,
    **env_arguments,
) -> EstimateStates:
    """The native vector env of an id with a filter on every copy; see `EstimateStates` for the arguments."""
    env = _made(gym.spec(env_id).vector_entry_point, env_arguments)
    numbers = _checked(filter_arguments)
    return EstimateStates(env, filter, observation, model_arguments=model_arguments, **numbers)


def _made(entry: Any, arguments: Mapping) -> Any:
    create = load_env_creator(entry) if isinstance(entry, str) else entry
    return create(**arguments)


def _checked(arguments: Mapping | None) -> dict:
    if arguments is not None and not isinstance(arguments, Mapping):
        raise ValueError(f"filter_arguments must be a mapping, but got {short_repr(arguments)}")
    return dict(arguments or {})
