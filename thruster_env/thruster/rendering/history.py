"""Contents of a picture: the truth at each step, and the estimate of a filter."""

from __future__ import annotations

from typing import NamedTuple


class Moment(NamedTuple):
    """The truth at the end of a step, one entry of the strip charts."""

    time: float  # since the start of the episode [s]
    omega_m: float  # motor speed [rad/s]
    U_a: float  # section-average flow velocity [m/s]
    thrust: float  # [N]
    measured_thrust: float  # [N]
    reference: float | None  # thrust to hold [N]
    voltage: float  # [V]
    ambient_velocity: float = 0.0  # U_0 [m/s]


class Overlay(NamedTuple):
    """The estimate of a filter at a step; None where it has none."""

    label: str  # name of the filter in the legend
    thrust: float | None = None  # [N]
    thrust_std: float | None = None  # standard deviation [N]
    omega_m: float | None = None  # [rad/s]
    omega_m_std: float | None = None  # [rad/s]
    U_a: float | None = None  # [m/s]
    U_a_std: float | None = None  # [m/s]
