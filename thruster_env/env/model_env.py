"""`ModelEnv`: a Gymnasium env whose plant is a state-space model."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import positive, short_repr
from thruster_env.core.checks import seed as checked_seed
from thruster_env.core.compiled import CompiledOrPython, function_fingerprint, is_interpreting
from thruster_env.core.streams import GROUP, draw_key
from thruster_env.env.commands import some_numbers
from thruster_env.model.shape import padded
from thruster_env.model.simulate import truth_steps_of
from thruster_env.model.state_space import StateSpaceModel


class ModelEnv(gym.Env):
    """A state-space model as an env: the action is its input, the observation its measurement.

        x_{k+1} = f(x_k, u_k) + w,  w ~ N(0, Q);   z_k = h(x_k) + v,  v ~ N(0, R)

    The first episode after `reset(seed=s)` is the trajectory that `thruster_env.model.simulate.simulate` draws
    for the key of seed s under the same inputs, and the data of seed s in a tuning problem of the same model.
    `info` holds "state" (n,) and "measurement" (m,) in float64. The reward is 0 and episodes do not end; use
    `gymnasium.wrappers.TimeLimit` to end them.

    Args:
        truth: the model that generates states and measurements.
        assumed: the model that filters assume, returned by `state_space_model`: a model, or a function that makes
            one from changes by name; the truth if None.
        low: smallest input, one number or p, in the units of the inputs.
        high: largest input, one number or p.
        dt: sample time [s], compared with that of tuned files; None if unknown. It has no other effect:
            covariances are per step and do not scale with dt.

    Raises:
        ValueError: if the truth is not a model, or bounds or dt are wrong.
    """

    metadata = {"render_modes": []}
    action_space: gym.spaces.Box

    def __init__(
        self,
        truth: StateSpaceModel,
        assumed: StateSpaceModel | Callable[..., StateSpaceModel] | None = None,
        *,
        low=-np.inf,
        high=np.inf,
        dt: float | None = None,
    ):
        """Make spaces and memory; see the class for the arguments."""
        if not isinstance(truth, StateSpaceModel):
            raise ValueError(f"the truth of an env must be a StateSpaceModel, but it is {short_repr(truth)}")
        self.truth, self.dt = truth, None if dt is None else positive("dt", dt)
        assumed = truth if assumed is None else assumed
        self.state_space_model = partial(with_noise, assumed) if isinstance(assumed, StateSpaceModel) else assumed
        self.action_space = gym.spaces.Box(*_bounds(low, high, truth.inputs), dtype=np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (truth.m,), np.float64)
        self._numbers, self._key, self._step = truth.numbers, np.zeros(2), 0
        self._x, self._z, self._u = np.zeros(truth.n), np.zeros(truth.m), np.zeros(truth.inputs)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Draw a key from the env's generator, and by it an initial state and a first measurement."""
        super().reset(seed=checked_seed(seed))
        self._key, self._step = draw_key(self.np_random), 0
        return self._propagated()

    def step(self, action):
        """Apply an input (p,), clipped to its bounds, for one step; ValueError for one that is not p numbers."""
        inputs = some_numbers(action, self.truth.input_quantities)
        self._u[:] = np.clip(inputs, self.action_space.low, self.action_space.high)
        self._step += 1
        observation, info = self._propagated()
        return observation, 0.0, False, False, info

    def _propagated(self) -> tuple[np.ndarray, dict]:
        move = _mover(*truth_steps_of(self.truth), max(self.truth.n, self.truth.m), is_interpreting())
        move(self._x, self._z, self._u, self._step, self._key, self._numbers)
        return self._z.copy(), {"state": self._x.copy(), "measurement": self._z.copy()}


def with_noise(
    model: StateSpaceModel,
    *,
    process_noise_cov=None,
    measurement_noise_cov=None,
    prior_cov_factor: float | None = None,
) -> StateSpaceModel:
    """A model with another Q or R, and with P_0 multiplied by a factor, if given."""
    changes = {"process_noise_cov": process_noise_cov, "measurement_noise_cov": measurement_noise_cov}
    if prior_cov_factor is not None:
        changes["prior_cov"] = positive("prior_cov_factor", prior_cov_factor) * model.prior_cov
    return model.replace(**{name: value for name, value in changes.items() if value is not None})


def _bounds(low, high, count: int) -> tuple[np.ndarray, np.ndarray]:
    try:
        low, high = (
            np.array(np.broadcast_to(np.asarray(bound, dtype=np.float64), count)) for bound in (low, high)
        )
    except (TypeError, ValueError):
        low, high = np.full(1, np.nan), np.zeros(1)
    if not (low <= high).all():
        raise ValueError(f"low and high must be one number or {count}, low at most high, but they are not")
    return low, high


@lru_cache(maxsize=64)
def _mover(
    begin: Callable, advance: Callable, measure: Callable, largest: int, interpreting: bool
) -> CompiledOrPython:
    fingerprint = function_fingerprint(begin, advance, measure, within=__name__)
    room = padded(largest, GROUP)

    def move(x, z, u, step, key, numbers):
        fingerprint  # noqa: B018 - part of the cache's key
        draws = np.zeros(room)
        if step == 0:
            begin(x, draws, key[0], key[1], numbers)
        else:
            advance(x, u, draws, step, key[0], key[1], numbers)
        measure(z, x, draws, step, key[0], key[1], numbers)

    return CompiledOrPython(move)


# The interface of a plant's env or vector env for filters: its model, and checks of tuned files.


class ModelledEnv:
    """An env with a `plant`, which offers the plant's model to filters.

    Attributes:
        plant_name: the plant's name in messages.
    """

    plant_name: ClassVar[str] = "a plant"
    plant: Any

    def model_maker(self) -> Callable[..., StateSpaceModel]:
        """The function that makes a model of the plant and of changes by name."""
        raise NotImplementedError

    def tuned_differences(self, tuned_for: Mapping, file: str) -> list[str]:
        """Minor differences between a tuned file's plant and the env's; ValueError for essential ones.

        None by default: states, inputs, sensors and dt are compared for every model.
        """
        return []

    def state_space_model(self, **changes) -> StateSpaceModel:
        """The model of the env's plant, exact unless changed; changes are arguments of its `model_maker`.

        Raises ValueError if an argument is wrong; the message states the rule and the value.
        """
        make = self.model_maker()
        known = list(inspect.signature(make).parameters)[1:]
        unknown = sorted(set(changes) - set(known))
        if unknown:
            rule = f"arguments of {self.plant_name}'s model must be among {', '.join(known)}"
            raise ValueError(f"{rule}, but got {', '.join(map(repr, unknown))}")
        return make(self.plant, **changes)

    def check_tuned_for(self, tuned_for: Mapping | None, file: str) -> None:
        """Raise ValueError if a tuned file is for another plant than the env's; warn if it is for other noise.

        A file without this entry (None) is not compared.
        """
        if tuned_for is not None:
            differences = self.tuned_differences(tuned_for, file)
            if differences:
                warnings.warn(f"{file} was tuned for {', '.join(differences)}", stacklevel=5)


# A policy's memory between two steps of its env.


def remembered(state, episode_start, at_start: np.ndarray) -> np.ndarray:
    """The state (..., k) of the last call, or its initial value at the start of an episode."""
    if state is None:
        return at_start
    if episode_start is None:
        return np.asarray(state)
    starts = np.reshape(episode_start, at_start.shape[:-1]).astype(bool)
    return np.where(starts[..., None], at_start, state)


# Channels of an env that a model takes as inputs, such as an attitude from an AHRS, and as measurements.


class Split(NamedTuple):
    """Indices of an env's channels that are inputs of a model, and of those that are measurements.

    Attributes:
        inputs: channels of the model's last inputs, in their order.
        measurements: channels of its measurements.
        channels: number of the env's channels.
    """

    inputs: tuple[int, ...]
    measurements: tuple[int, ...]
    channels: int


def split(model: StateSpaceModel, actions: int, channels: Sequence[str]) -> Split | None:
    """Find a model's inputs beyond the first `actions`, and its measurements, among channels by their symbols.

    None if there are no such inputs, or if one of them is no channel.
    """
    inputs = [quantity.symbol for quantity in model.input_quantities[actions:]]
    measurements = [quantity.symbol for quantity in model.measurements]
    if not inputs or not set(inputs + measurements) <= set(channels):
        return None
    return Split(tuple(map(channels.index, inputs)), tuple(map(channels.index, measurements)), len(channels))
