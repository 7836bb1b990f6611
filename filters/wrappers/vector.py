"""`EstimateStates`: a filter on every copy of a vector env, one compiled call for all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from filters.engine.batch import Beliefs
from filters.engine.belief import checked_actions
from filters.estimators.estimator import Estimator
from filters.estimators.foreign import ForeignFilter
from filters.estimators.session import EstimatorBeliefs
from filters.filter import Filter
from filters.monitoring.monitor import Monitor, monitor_of, watch_of
from filters.smoothers.online import WithSmoother
from filters.starts import FirstRestarts
from filters.wrappers.arguments import (
    APPENDED,
    OBSERVATIONS,
    WithMeasuredInputs,
    check_spaces,
    filter_for,
    given_filter,
    split_of,
)
from thruster_env.core.checks import as_floats, one_of, short_repr
from thruster_env.core.keys import EpisodeKeys, reset_mask
from thruster_env.core.streams import filter_generator
from thruster_env.model.state_space import StateSpaceModel


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
        self.filter = filter_for(env, filter, model, tuned, model_arguments, numbers)
        split = split_of(env, self.filter.model)
        inputs = len(split.inputs)
        actions = check_spaces(env.single_action_space, env.single_observation_space, self.filter.model, inputs)
        self._n, self._m = self.filter.model.n, split.channels
        self._appended = getattr(env.unwrapped, APPENDED, 0)
        length = {"estimate": self._n, "measurement+estimate": self._m + self._n, "belief": 2 * self._n}[
            observation
        ]
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
        self._done = np.zeros(self.num_envs, dtype=bool)
        self._low, self._high = actions.low.ravel(), actions.high.ravel()

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict | None = None):
        """Reset the env and the beliefs of the copies that it resets."""
        mask = reset_mask(options, self._keys)
        self._keys.seeds(seed)  # a wrong one changes nothing
        seeds: Any = seed  # Gymnasium takes a list of them, too, but its annotation does not say so
        observations, info = self.env.reset(seed=seeds, options=options)
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
        ignored = self._done if self.autoreset_mode == AutoresetMode.NEXT_STEP else False
        u = np.clip(checked_actions(actions, self.num_envs, len(self._low), ignored), self._low, self._high)
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        if "recorded_input" in info:
            u = np.where(info["_recorded_input"][:, None], info["recorded_input"], u)
        z = self._measurements(observations, info)
        done = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP and done.any():
            last = info.get("final_info", {})
            u = np.where(done[:, None], last["recorded_input"], u) if "recorded_input" in last else u
            self._end(u, z, done, info)
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
        which = np.flatnonzero(mask)
        self._restarts.start(which)
        self._last_measured[which] = 0.0
        for i in which if self._watches else ():
            self._watches[i].restart()
        self._beliefs.start(which, self._keys.draw(which), z)

    def _end(self, u, z, done, info) -> None:
        """Update with the last measurements of episodes that end; put these estimates into final_obs and info."""
        final = np.full(self.num_envs, None, dtype=object) if "final_obs" not in info else info["final_obs"]
        observations = np.zeros(
            (self.num_envs, *(self.env.single_observation_space.shape or ())), dtype=np.float32
        )
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
        mean, cov = beliefs.part("mean", n), beliefs.part("cov", n, n)
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
