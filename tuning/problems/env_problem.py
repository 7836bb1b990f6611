"""`EnvProblem`: any Gymnasium env under a policy, and the model that filters assume for it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random

from filters.wrappers.arguments import clipping_space, refuse_normalised
from thruster_env.core.checks import as_floats, covariance, covariance_root, short_repr
from thruster_env.core.modules import error_line
from thruster_env.core.streams import (
    ACTION_SPACE,
    ADDED_NOISE,
    GLOBAL_GENERATORS,
    POLICY,
    RANDOM_ACTIONS,
    GlobalGenerators,
    derived_generator,
    derived_seed,
    draw_key,
    episode_keys,
    filter_keys,
    normal_block,
)
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.assumed import AssumedProblem, as_argument, rows_of
from tuning.problems.data import FIRST_SCORED_STEP, Data
from tuning.problems.model_problem import NamedArguments
from tuning.problems.problem import Parameter
from tuning.problems.scenario import Excitation, excitation_of

Policy = str | Mapping | Excitation | Callable
RANDOM = "random"
LARGEST = 1e3  # random action, where the action space has no limit
SCALE_SEEDS = range(16)  # seeds whose true states' standard deviation is the scale, where none is given
DIFFERENCE = 1e-6  # of two runs of a seed, as part of the largest number: threads leave less


class Episodes(gym.Wrapper):
    """An env that offers filters a problem's model; the first episode of a seed has the measurements of its data.

    `info` holds "measurement" (m,), with the noise that the problem adds, and where the problem knows it "state"
    (n,). Observation, reward and all else are the env's. After a seeded reset the env has its own global
    generators.

    Args:
        env: of the problem.
        problem: its model, and how it measures.
    """

    def __init__(self, env: gym.Env, problem: EnvProblem):
        """Take env and problem."""
        super().__init__(env)
        self.state_space_model = NamedArguments(problem)
        self._problem, self._generator, self._key, self._step = problem, np_random()[0], np.zeros(2), 0
        self._generators = GlobalGenerators()

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Reset the env, and draw the key of the episode's measurement noise."""
        if seed is not None:
            self._generators.seed(derived_seed(seed, GLOBAL_GENERATORS))
            self._generator = np_random(seed)[0]
        with self._generators.used():
            observation, info = self.env.reset(seed=seed, options=options)
            self._key, self._step = draw_key(self._generator), 0
            return observation, self._told(observation, info)

    def step(self, action):
        """Step the env."""
        with self._generators.used():
            observation, reward, terminated, truncated, info = self.env.step(action)
            self._step += 1
            return observation, reward, terminated, truncated, self._told(observation, info)

    def _told(self, observation, info: dict) -> dict:
        problem, info = self._problem, dict(info)
        z = problem.measured(observation, info)
        if problem.noise_cov is not None:
            z = z + measurement_noise(self._key[None], np.array([self._step]), problem.noise_cov)[0, 0]
        if problem.measure is not None:  # whose entries are no longer those that the env's flags are of
            info.pop("measurement_valid", None)
        info["measurement"] = z
        if problem.has_truth and (problem.state_of is not None or "state" in info):
            info["state"] = problem.state(self.env, info)
        return info


def measurement_noise(keys: np.ndarray, steps: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Normal noise (B, K, m) with a covariance, a function of each episode's key and the step only.

    Args:
        keys: of the episodes, (B, 2).
        steps: numbers of the steps, (K,).
        cov: covariance (m, m).
    """
    size = len(cov)
    blocks = [normal_block(b, steps[None], ADDED_NOISE, keys[:, :1], keys[:, 1:]) for b in range(-(-size // 4))]
    draws = np.stack([draw for block in blocks for draw in block][:size], axis=-1)
    return draws @ covariance_root(cov).T


def checked_policy(policy: Policy) -> str | Excitation | Callable:
    """A policy unchanged, an excitation for a mapping with its name; ValueError for anything else."""
    if isinstance(policy, Excitation | Mapping):
        return excitation_of(policy)
    if policy != RANDOM and not callable(policy) and not hasattr(policy, "predict"):
        rule = "policy must be 'random', a function of the observation, an object with predict, or an excitation"
        raise ValueError(f"{rule}, but got {short_repr(policy)}")
    return policy


def chooser(policy: Any, space: gym.spaces.Box, seed: int) -> Callable:
    """The policy, or given actions (K, p), as a function of the observation, as the episode of a seed begins.

    A policy with `reset` is reset, with its own seed if it takes `seed`. What has `predict` is asked for its
    `deterministic` action, and gets its `state` and `episode_start` where it takes them, as the policies of
    Stable-Baselines3 do.
    """
    if isinstance(policy, str):
        generator = derived_generator(seed, RANDOM_ACTIONS)
        low, high = (np.clip(end, -LARGEST, LARGEST) for end in (space.low, space.high))
        return lambda observation: generator.uniform(low, high)
    if isinstance(policy, np.ndarray):
        rows = iter(policy)
        return lambda observation: next(rows)
    _begin(policy, seed)
    return _predicted(policy) if hasattr(policy, "predict") else policy


def _begin(policy: Any, seed: int) -> None:
    """Reset what remembers something: the object, or that of a method."""
    while isinstance(policy, partial):
        policy = policy.func
    owner = getattr(policy, "__self__", policy)
    reset = getattr(owner, "reset", None)
    if not callable(reset) or isinstance(owner, gym.Env | type):
        return
    arguments = {"seed": derived_seed(seed, POLICY)} if "seed" in _names(reset) else {}
    try:
        inspect.signature(reset).bind(**arguments)
    except (TypeError, ValueError):  # it asks for more: it is no beginning of an episode
        return
    reset(**arguments)


def _predicted(policy: Any) -> Callable:
    known = _names(policy.predict)
    fixed = {"deterministic": True} if "deterministic" in known else {}
    remembers = {"state", "episode_start"} <= known
    state, first = None, True

    def choose(observation):
        nonlocal state, first
        if not remembers:
            return policy.predict(observation, **fixed)[0]
        start = np.array([first])
        action, state = policy.predict(observation, state=state, episode_start=start, **fixed)
        first = False
        return action

    return choose


def _names(function: Callable) -> set[str]:
    """Names of the arguments of a function; none where it does not tell them."""
    try:
        return set(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        return set()


class EnvProblem(AssumedProblem):
    """Runs of a Gymnasium env under a policy, one episode a seed, with the true state kept.

    The inputs are the policy's actions, clipped to the action space as `EstimateState` clips them. The policy gets
    the env's observations, not a filter's estimates: all filters get the same runs.

    A run is a function of its seed: each source of random numbers has its own stream, and the env's action space
    and the global generators of Python, NumPy and torch are seeded as an episode begins. If an env or a policy
    remembers anything beyond an episode, or draws from its own generator, that is an error: the first run is
    repeated to find it.

    Args:
        env: an env; its id; or a function that makes it.
        policy: "random" for actions that are uniform over the action space; a function of the observation, or an
            object with `predict(observation)` as Stable-Baselines3 has it, which is asked to be deterministic
            (both are reset if they have `reset`, or `reset(seed)`); or an excitation, or a mapping with its name.
        model: the `StateSpaceModel` that filters assume, or a function of `parameters` that makes it.
        steps: length K of a run; that of the env's spec if None. No episode may terminate earlier.
        state_of: a function of the unwrapped env that returns its state (n,); `info["state"]` if None.
        measure: a function of (observation, info) that returns the measurement (m,); if None
            `info["measurement"]` (missing where `info["measurement_valid"]` is false), else the observation.
        measurement_noise_cov: R of normal noise that is added to the env's measurement; no noise if None.
        has_truth: whether there is a state to compare with; without it all metrics are of the innovations.
        scale: by which the score divides the error of each state, infinite for states that do not count; if None
            the standard deviation of each true state over 16 seeds: a constant estimate then has a score of 1.
        env_arguments: keyword arguments of the id or the function.
        first_scored_step, parameters, untuned, true, dt, name, about: those of `AssumedProblem`.

    Raises:
        ValueError: if env, policy and model do not fit each other, an argument is invalid, or two runs of one seed
            differ.
    """

    def __init__(
        self,
        env: gym.Env | str | Callable[..., gym.Env],
        policy: Policy,
        model: StateSpaceModel | Callable[..., StateSpaceModel],
        *,
        steps: int | None = None,
        state_of: Callable | None = None,
        measure: Callable | None = None,
        measurement_noise_cov=None,
        has_truth: bool = True,
        env_arguments: Mapping | None = None,
        first_scored_step: int = FIRST_SCORED_STEP,
        scale: Sequence[float] | None = None,
        parameters: Sequence[Parameter] | None = None,
        untuned: Mapping | None = None,
        true: Mapping | None = None,
        dt: float | None = None,
        name: str = "an env",
        about: str = "",
    ):
        """Make the env once, to check that all parts fit; see the class for the arguments."""
        self.env, self.env_arguments = env, dict(env_arguments or {})
        self.state_of, self.measure, self.has_truth = state_of, measure, bool(has_truth)
        self.policy, self._repeats = checked_policy(policy), False
        instance = self._make_env(name)
        try:
            space = _box(instance, name)
            if steps is None:
                steps = getattr(instance.spec, "max_episode_steps", None) or 500
            own_dt = getattr(instance.unwrapped, "dt", None)
            if dt is None and isinstance(own_dt, float):
                dt = own_dt
        finally:
            self._close(instance)
        super().__init__(
            model,
            steps=steps,
            first_scored_step=first_scored_step,
            scale=scale,
            parameters=parameters,
            untuned=untuned,
            true=true,
            dt=dt,
            name=name,
            about=about,
        )
        assumed = self.model()
        if int(np.prod(space.shape)) != assumed.inputs:
            raise ValueError(
                f"the action space of problem {name} must have the model's {assumed.inputs} entries, "
                f"but got {space}"
            )
        self.noise_cov = None
        if measurement_noise_cov is not None:
            self.noise_cov = covariance("measurement_noise_cov", measurement_noise_cov, assumed.m)

    @property
    def untuned(self) -> dict:
        """As for any problem, with the R of the noise that is added to the measurements."""
        if self.noise_cov is None or self._parameters is not None:
            return super().untuned
        return super().untuned | {"measurement_noise_cov": as_argument(self.noise_cov)} | (self._untuned or {})

    def make(self, seeds: tuple[int, ...]) -> Data:
        """Runs of the env, one a seed."""
        keys, env = episode_keys(seeds), self._make_env(self.name)
        excitation = None
        if isinstance(self.policy, Excitation):
            size = int(np.prod(_box(env, self.name).shape))
            excitation = self.policy.inputs(keys, self.steps, self._dt or 1.0, size)
        try:
            levels = [None] * len(seeds) if excitation is None else excitation
            runs = [self._run(env, seed, run_inputs) for seed, run_inputs in zip(seeds, levels, strict=True)]
            if runs and not self._repeats:
                self._check_repeated(seeds[0], runs[0], self._run(env, seeds[0], levels[0]))
        finally:
            self._close(env)
        inputs, measurements, true_states = (np.array(part, dtype=np.float64) for part in zip(*runs, strict=True))
        if self.noise_cov is not None:
            measurements = measurements + measurement_noise(keys, np.arange(measurements.shape[1]), self.noise_cov)
        states = true_states if self.has_truth else None
        outputs = None if states is None else self._outputs(states)
        return Data(seeds, inputs, measurements, filter_keys(seeds), self.first_scored_step, states, outputs)

    def make_env(self, **arguments: Any) -> gym.Env:
        """The env, a new one unless an env was given, which offers filters the problem's model.

        The first episode of a seed has the measurements of the seed's data under the same inputs; `info` has the
        measurement and, where the problem knows it, the state.

        Args:
            **arguments: of the id or the function, in place of `env_arguments` of the same name.

        Raises:
            ValueError: if it cannot be made.
        """
        if arguments and isinstance(self.env, gym.Env):
            raise ValueError(f"the env of problem {self.name} is made already, but got {', '.join(arguments)}")
        return Episodes(self._make_env(self.name, arguments), self)

    def found_scale(self) -> np.ndarray:
        """The standard deviation of each true state over the scored steps of 16 seeds."""
        data = self.data(SCALE_SEEDS)
        scale = rows_of(data.scored_rows(data.known_states), self.model()).std(axis=0)
        if not (scale > 0).all():
            raise ValueError(
                f"the scale of problem {self.name} must be given if a state does not move, "
                f"but its true states have the standard deviations {scale.tolist()}"
            )
        return scale

    def _outputs(self, states: np.ndarray) -> dict[str, np.ndarray]:
        model = self.model()
        is_full = states.shape[-1] == model.n
        return {symbol: model.output(symbol, states) for symbol in model.outputs} if is_full else {}

    def _check_repeated(self, seed: int, first: tuple, again: tuple) -> None:
        """Raise ValueError unless two runs of a seed, with others in between, are the same."""
        for what, values, other in zip(("inputs", "measurements", "states"), first, again, strict=True):
            pair = np.array(values, dtype=np.float64), np.array(other, dtype=np.float64)
            room = DIFFERENCE * np.nanmax(np.abs(pair), initial=0.0)
            same = np.isclose(*pair, rtol=0.0, atol=room, equal_nan=True).all(axis=-1)
            if not same.all():
                raise ValueError(
                    f"runs of problem {self.name} must be a function of the seed, but in two of seed {seed} "
                    f"the {what} differ from step {int(np.argmin(same))} on: env and policy must use only "
                    "generators seeded by reset(seed), and keep no memory of earlier episodes"
                )
        self._repeats = True

    def _run(self, env: gym.Env, seed: int, excitation: np.ndarray | None) -> tuple[list, list, list]:
        """Inputs (K, p), measurements (K + 1, m) and states (K + 1, n) of one episode, on seeded generators."""
        generators = GlobalGenerators()
        generators.seed(derived_seed(seed, GLOBAL_GENERATORS))
        env.action_space.seed(derived_seed(seed, ACTION_SPACE))  # a policy may sample it
        with generators.used():
            return self._episode(env, seed, excitation)

    def _episode(self, env: gym.Env, seed: int, excitation: np.ndarray | None) -> tuple[list, list, list]:
        space, inputs = _box(env, self.name), []
        begun = env.reset(seed=seed)
        if not isinstance(begun, tuple) or len(begun) != 2:
            rule = f"reset of the env of problem {self.name} must return (observation, info)"
            raise ValueError(f"{rule}, but returned {short_repr(begun)}")
        observation, info = begun
        if self.measure is None:
            refuse_normalised(env, info)
        measurements, states = [self.measured(observation, info)], [self.state(env, info)]
        choose = chooser(self.policy if excitation is None else excitation, space, seed)
        for k in range(self.steps):
            action = choose(observation)
            action = np.array(action, dtype=space.dtype).reshape(space.shape)  # an env may write into it
            inputs.append(np.clip(np.ravel(action).astype(np.float64), np.ravel(space.low), np.ravel(space.high)))
            observation, _, terminated, _, info = env.step(action)
            measurements.append(self.measured(observation, info))
            states.append(self.state(env, info))
            if terminated and k + 1 < self.steps:
                raise ValueError(
                    f"episodes of problem {self.name} must last {self.steps} steps, "
                    f"but that of seed {seed} ended after {k + 1}"
                )
        return inputs, measurements, states

    def measured(self, observation, info: Mapping) -> np.ndarray:
        """The measurement (m,) of an observation and its info, without the noise that is added, as a copy."""
        if self.measure is not None:
            return as_floats(self.measure(observation, info)).ravel().copy()
        if "measurement" not in info:
            return as_floats(observation).ravel().copy()
        z = as_floats(info["measurement"]).ravel().copy()
        return np.where(np.ravel(info.get("measurement_valid", True)), z, np.nan)

    def state(self, env: gym.Env, info: Mapping) -> np.ndarray:
        """The true state (n,), empty without truth; ValueError if it is not available."""
        if not self.has_truth:
            return np.zeros(0)
        if self.state_of is None and "state" not in info:
            raise ValueError(
                f'the env of problem {self.name} must show its state in info["state"], or state_of must '
                f"return it, but info has {', '.join(info) or 'nothing'}"
            )
        state = info["state"] if self.state_of is None else self.state_of(env.unwrapped)
        return as_floats(state).ravel().copy()

    def _make_env(self, name: str, arguments: Mapping | None = None) -> gym.Env:
        if isinstance(self.env, gym.Env):
            return self.env
        try:
            make = partial(gym.make, self.env) if isinstance(self.env, str) else self.env
            env = make(**{**self.env_arguments, **(arguments or {})})
        except (gym.error.Error, TypeError, ImportError) as error:
            raise ValueError(
                f"it must be possible to make the env of problem {name}, but {error_line(error)}"
            ) from error
        if not isinstance(env, gym.Env):
            raise ValueError(f"the env of problem {name} must be a gymnasium.Env, but it is {short_repr(env)}")
        return env

    def _close(self, env: gym.Env) -> None:
        if env is not self.env:
            env.close()


def _box(env: gym.Env, name: str) -> gym.spaces.Box:
    """The action space of an env; ValueError unless it is a Box."""
    space = clipping_space(env)
    if not isinstance(space, gym.spaces.Box):
        raise ValueError(
            f"an env must have a Box as its action space, but that of problem {name!r} is {space}: wrap it in "
            "gymnasium.wrappers.TransformAction or a gymnasium.ActionWrapper that maps numbers to its actions"
        )
    return space
