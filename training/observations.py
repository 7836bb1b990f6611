"""What a policy may observe: the arms that are compared.

Every observation ends with the reference thrust of the next step. What comes before it is, in float32,

| arm | entries |
|---|---|
| raw | measured thrust |
| raw+action | measured thrust, the last voltage |
| stack | the last 8 measured thrusts, each with the voltage before it, latest first |
| lowpass, kf, ekf, ukf, enkf | thrust of the estimate, estimate of omega_m and U_a |
| belief | the same of the enkf, then two standard deviations |
| true | true thrust, omega_m and U_a |

Thrust is a nonlinear function of the state, and the reward compares it with the reference. Raw observations hold
it; beside an estimate it stands so that no arm has to learn the equation of the propeller.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from numerics.checks import one_of

STACKED = 8


class Arm(NamedTuple):
    """What one kind of policy observes."""

    about: str
    filter: str | None = None  # name in `filters.FILTERS`
    numbers: Mapping = MappingProxyType({})  # of the filter, unless told otherwise
    form: str = "estimate"  # as of `filters.EstimateState`
    is_true: bool = False  # whether it is the true state
    pairs: int = 0  # last measurements, each with the voltage before it

    @property
    def shows_state(self) -> bool:
        """Whether the observation begins with a state, estimated or true."""
        return self.is_true or self.filter is not None


MEMBERS = MappingProxyType({"ensemble_size": 50})
ARMS: dict[str, Arm] = {
    "raw": Arm("the measured thrust"),
    "raw+action": Arm("the measured thrust and the last voltage", pairs=1),
    "stack": Arm(f"the last {STACKED} measured thrusts and voltages", pairs=STACKED),
    "lowpass": Arm("the low-passed thrust, and the state that belongs to it", "low-pass"),
    "kf": Arm("the estimate of a Kalman filter", "kf"),
    "ekf": Arm("the estimate of an extended Kalman filter", "ekf"),
    "ukf": Arm("the estimate of an unscented Kalman filter", "ukf"),
    "enkf": Arm("the estimate of an ensemble Kalman filter", "enkf", MEMBERS),
    "belief": Arm("the enkf's estimate with its standard deviations", "enkf", MEMBERS, form="belief"),
    "true": Arm("the true state", is_true=True),
}


def find_arm(name: str) -> Arm:
    """The arm of a name; raises ValueError for an unknown one."""
    return ARMS[one_of("observe", name, tuple(ARMS))]
