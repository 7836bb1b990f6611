"""Which filters the studies of the vehicle compare, by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from filters import EnsembleKalmanFilter, ExtendedKalmanFilter, FuzzyKalmanFilter, UnscentedKalmanFilter
from filters.filter import Filter
from thruster_env.model.state_space import StateSpaceModel
from tuning.experiments.vehicle.mean_propagation import MeanPropagatingEnKF
from tuning.experiments.vehicle.models import papers_model
from tuning.experiments.vehicle.own_attitude import OwnAttitudeKalmanFilter
from tuning.experiments.vehicle.printed import FUZZY_HIGH, FUZZY_LOW

MEMBERS = (50, 100, 200, 300)
NARROW_LOW = (0.5, -0.1, -0.1, -0.1, -0.3, -0.3)  # [m/s], [rad/s]: approximate range on the paths after the start
NARROW_HIGH = (1.1, 0.1, 0.1, 0.1, 0.3, 0.3)
MEASUREMENTS = "measurements, no filter"
EULER = {"integration": "euler"}  # as in the papers; the truth and our other filters use Runge-Kutta


class Estimator(NamedTuple):
    """A filter with its name in tables."""

    label: str
    filter: Filter | None  # None: the measurements themselves

    @property
    def has_attitude(self) -> bool:
        """Whether roll and pitch are estimated."""
        return self.filter is not None and self.filter.model.n > 6


def level_model(world: str = "vehicle") -> StateSpaceModel:
    """The papers' model: six velocities, roll and pitch zero, Euler's method."""
    return papers_model("velocities", world, attitude="level", **EULER)


def measured() -> Estimator:
    """The measured u, v, w and r as they are."""
    return Estimator(MEASUREMENTS, None)


def kalman(world: str = "vehicle") -> list[Estimator]:
    """Extended and unscented filter of eight states, extended ones of the papers' six."""
    motion, level = papers_model("motion", world), papers_model("velocities", world, attitude="level")
    own = papers_model("velocities", world)
    return [
        Estimator("EKF8", ExtendedKalmanFilter(model=motion)),
        Estimator("UKF8", UnscentedKalmanFilter(model=motion)),
        Estimator("EKF6 level", ExtendedKalmanFilter(model=level)),
        Estimator("EKF6 own attitude", OwnAttitudeKalmanFilter(model=own)),
    ]


def ensembles(states: int, world: str = "vehicle", members: Sequence[int] = MEMBERS) -> list[Estimator]:
    """The ensemble filter for each number of members, and that of equation (24) for the least; Euler's method."""
    model = papers_model("motion", world, **EULER) if states == 8 else level_model(world)
    right = [
        Estimator(f"EnKF{states} N={count}", EnsembleKalmanFilter(model=model, ensemble_size=count))
        for count in members
    ]
    printed = MeanPropagatingEnKF(model=model, ensemble_size=min(members))
    return [*right, Estimator(f"EnKF{states} N={min(members)} by eq. (24)", printed)]


def fuzzy(world: str = "vehicle") -> list[Estimator]:
    """The fuzzy filter of 64 rules in four readings.

    All linearise Euler's method, I + A dt. The printed bounds without and with offsets; the same with a separate
    estimate for each rule, blended for output only; and a range about the manoeuvre.
    """
    model = level_model(world)
    bounds: dict[str, Any] = {"low": np.array(FUZZY_LOW), "high": np.array(FUZZY_HIGH)}
    narrow: dict[str, Any] = {"low": np.array(NARROW_LOW), "high": np.array(NARROW_HIGH)}
    return [
        Estimator("fuzzy 0..1", FuzzyKalmanFilter(model=model, offsets=False, **bounds)),
        Estimator("fuzzy 0..1 offsets", FuzzyKalmanFilter(model=model, **bounds)),
        Estimator("fuzzy 0..1 own", FuzzyKalmanFilter(model=model, offsets=False, blending="output", **bounds)),
        Estimator("fuzzy narrow offsets", FuzzyKalmanFilter(model=model, **narrow)),
    ]
