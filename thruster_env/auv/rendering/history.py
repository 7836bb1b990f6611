"""The contents of a picture: moments, and a filter's estimates of them."""

from __future__ import annotations

from typing import NamedTuple


class Moment(NamedTuple):
    """The truth at the end of a step, one entry of the strip charts."""

    time: float  # since the start of the episode [s]
    x: float  # north [m]
    y: float  # east [m]
    depth: float  # [m]
    phi: float  # [rad]
    theta: float  # [rad]
    psi: float  # [rad]
    u: float  # [m/s]
    measured_depth: float | None  # None where the sensors have none
    measured_u: float | None
    reference_depth: float  # of the path abreast [m]
    reference_u: float  # [m/s]
    thrust: float  # [N]
    stern: float  # [rad]
    rudder: float  # [rad]


class Overlay(NamedTuple):
    """What a filter believes of a moment; None where it believes nothing."""

    label: str  # name of the filter in the legend
    x: float | None = None  # [m]
    x_std: float | None = None
    y: float | None = None
    y_std: float | None = None
    depth: float | None = None
    depth_std: float | None = None
    phi: float | None = None  # [rad]
    theta: float | None = None
    psi: float | None = None
    u: float | None = None  # [m/s]
    u_std: float | None = None
