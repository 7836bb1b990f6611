"""Observation sets: the choices of a policy's observation.

Every observation ends with the reference of the next step. What comes before it is, in float32,

| observation set | entries |
|---|---|
| raw | measured thrust |
| raw+action | measured thrust, the last voltage |
| stack | the last 8 measured thrusts, each with the voltage before it, latest first |
| lowpass, kf, ekf, ukf, enkf | thrust of the estimate, estimate of omega_m and U_a |
| belief | the same of the enkf, then two standard deviations |
| true | true thrust, omega_m and U_a |

Thrust is a nonlinear function of the state, and the reward compares it with the reference. Raw observations
contain thrust, so estimates have it added: no policy has to learn the equation of the propeller.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import one_of

if TYPE_CHECKING:
    from tuning.policies.controllers import ClassicalPolicy

STACKED = 8
MEMBERS = MappingProxyType({"ensemble_size": 50})

# Returns (copies, episodes) of so many copies of a policy, stepped side by side, on the same training seeds.
TrainingReturns = Callable[["ClassicalPolicy", int, int], np.ndarray]


class ObservationSet(NamedTuple):
    """What a policy observes."""

    about: str
    filter: str | None = None  # name in `filters.FILTERS`
    numbers: Mapping = MappingProxyType({})  # default parameters of the filter
    form: str = "estimate"  # as of `filters.EstimateState`
    is_true: bool = False  # whether it is the true state
    pairs: int = 0  # number of last measurements, each with the voltage before it

    @property
    def shows_state(self) -> bool:
        """Whether the observation begins with a state, estimated or true."""
        return self.is_true or self.filter is not None


OBSERVATION_SETS: dict[str, ObservationSet] = {
    "raw": ObservationSet("the measured thrust"),
    "raw+action": ObservationSet("the measured thrust and the last voltage", pairs=1),
    "stack": ObservationSet(f"the last {STACKED} measured thrusts and voltages", pairs=STACKED),
    "lowpass": ObservationSet("the low-passed thrust, and the state that belongs to it", "low-pass"),
    "kf": ObservationSet("the estimate of a Kalman filter", "kf"),
    "ekf": ObservationSet("the estimate of an extended Kalman filter", "ekf"),
    "ukf": ObservationSet("the estimate of an unscented Kalman filter", "ukf"),
    "enkf": ObservationSet("the estimate of an ensemble Kalman filter", "enkf", MEMBERS),
    "belief": ObservationSet("the enkf's estimate with its standard deviations", "enkf", MEMBERS, form="belief"),
    "true": ObservationSet("the true state", is_true=True),
}


def find_observation_set(name: str) -> ObservationSet:
    """The observation set of a name; raises ValueError for an unknown one."""
    return OBSERVATION_SETS[one_of("observe", name, tuple(OBSERVATION_SETS))]


def box_of(space: gym.Space) -> gym.spaces.Box:
    """The same space; ValueError unless it is a Box, for policies observe and act in boxes only."""
    if not isinstance(space, gym.spaces.Box):
        raise ValueError(f"a space must be a Box, but got {space}")
    return space


def size_of(space: gym.Space) -> int:
    """Number of entries of a Box with one axis."""
    return box_of(space).shape[0]
