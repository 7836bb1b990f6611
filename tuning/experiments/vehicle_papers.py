"""The two papers on the vehicle: what they print, their settings and model, and the filters that are compared.

Integrals are by the trapezoidal rule. Yaw counts full turns; its errors are wrapped. Beside the package's filters
there are an extended filter that takes roll and pitch from its own dead reckoning, and the ensemble filter as
printed in one paper, whose members are all predicted from the mean.

Source of the transformation by yaw alone: Ngatini, Nurhadi (2019), equations 1 to 4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from filters import EnsembleKalmanFilter, ExtendedKalmanFilter, FuzzyKalmanFilter, UnscentedKalmanFilter
from filters.algebra.members import mean
from filters.engine.belief import Kernels, memory_offsets
from filters.filter import Filter
from filters.pages.kernels import page_kernels
from filters.pages.page import Page
from thruster_env.auv.dynamics import angle_rates, attitude_of, in_earth_axes
from thruster_env.auv.model import auv_model
from thruster_env.auv.parameters import SEGOROGENI
from thruster_env.core.angles import difference
from thruster_env.core.checks import one_of
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.files import read_toml
from thruster_env.core.streams import cosine_and_sine
from thruster_env.graphs.loops import Loops
from thruster_env.model.shape import Functions, Shape, constants_reader, number_offsets
from thruster_env.model.state_space import StateSpaceModel

DT = 0.001  # [s]
NOISE = 1e-6  # Q = R = 1e-6 I, in the units of the velocities squared
MEASURED = ("u", "v", "w", "r")  # H picks these
POSE = ("x", "y", "z", "psi")  # [m], [m], [m], [rad]
FUZZY_LOW, FUZZY_HIGH = (0.0,) * 6, (1.0,) * 6  # bounds of the velocities; the rules are the corners
RUNS = 10  # "mean of 10 runs"
ANGLE_NOISE = 1e-6  # of roll and pitch, standard deviation per step [rad]: so Q of eight states is not singular
START = (1e-3,) * 6 + (1e-4,) * 2 + (0.0,) * 4  # standard deviations about rest at the origin; P_0 is not printed
WORLDS = {"vehicle": SEGOROGENI, "no restoring moments": SEGOROGENI._replace(zG=0.0)}
"""Segorogeni with our parameters, and the same with the centre of gravity at the centre of buoyancy.

Then nothing depends on roll and pitch, so that the papers' six velocities are a closed system.
"""
COUNTS = {"velocities": 6, "motion": 8, "navigation": 12}


class PrintedRow(NamedTuple):
    """One filter on one path."""

    rmse: Mapping[str, float]  # by component of the pose: x, y, z [m], psi [rad]; not every table has all
    seconds: float
    final_percent: Mapping[str, float] = {}  # error at the end over the path's end, it seems


class PrintedPath(NamedTuple):
    """Ensemble and fuzzy Kalman filter on one path."""

    enkf: PrintedRow
    fkf: PrintedRow
    remark: str = ""  # misprint, or how it was interpreted


class Paper(NamedTuple):
    """A source with remarks for its readers."""

    name: str
    source: str
    remarks: Sequence[str]


def papers_model(states: str, world: str = "vehicle", **arguments) -> StateSpaceModel:
    """The model of so many states at the papers' noise and sensors, u, v, w and r measured at every step of 1 ms.

    Process noise is on velocities, as in the papers, and very small on roll and pitch; yaw and position have none.
    The inputs are X_prop, K_prop, delta_s and delta_r, and for "velocities" also roll and pitch.

    Args:
        states: "velocities", "motion" or "navigation".
        world: one of `WORLDS`.
        **arguments: others of `thruster_env.auv.model.auv_model`.

    Raises:
        ValueError: for an unknown world, and as `auv_model` does.
    """
    noise = (NOISE,) * 6 + (ANGLE_NOISE**2,) * 2 + (0.0,) * 4
    settings: dict[str, Any] = {
        "preset": WORLDS[one_of("world", world, tuple(WORLDS))],
        "dt": DT,
        "propeller_torque": None,
        "sensors": MEASURED,
        "measurement_noise_cov": (NOISE,) * len(MEASURED),
        "initial_state": {"mean": (0.0,) * 12, "cov": [deviation**2 for deviation in START]},
        "process_noise_cov": noise[: COUNTS[one_of("states", states, tuple(COUNTS))]],
    }
    return auv_model(states=states, **settings | arguments)


PRINTED_MEMBERS = 50  # beside the 64 rules of the fuzzy filter
PRINTED = read_toml(Path(__file__).with_suffix(".toml"), "printed values")
NGATINI2017, NGATINI2019 = (Paper(name, paper["source"], paper["remarks"]) for name, paper in PRINTED.items())
PRINTED_PATHS = {
    name: PrintedPath(PrintedRow(**path["enkf"]), PrintedRow(**path["fkf"]), path.get("remark", ""))
    for name, path in PRINTED[NGATINI2017.name]["paths"].items()
}
TABLE_III = {int(count): PrintedRow(**row) for count, row in PRINTED[NGATINI2019.name]["members"].items()}

POSE_ANGLES = (False, False, False, True)  # of x, y, z and yaw
KEPT = 5  # roll, pitch and the last p, q, r
MEMBERS = (50, 100, 200, 300)
NARROW_LOW = (0.5, -0.1, -0.1, -0.1, -0.3, -0.3)  # [m/s], [rad/s]: approximate range on the paths after the start
NARROW_HIGH = (1.1, 0.1, 0.1, 0.1, 0.3, 0.3)
MEASUREMENTS = "measurements, no filter"
EULER = {"integration": "euler"}  # as in the papers; the truth and our other filters use Runge-Kutta


def next_attitude(phi, theta, before, after, dt):
    """Roll and pitch [rad] a step later, by Heun's rule; p, q, r [rad/s] were before and are after."""
    rolling, pitching, _ = angle_rates(attitude_of(phi, theta), before[0], before[1], before[2])
    attitude = attitude_of(phi + dt * rolling, theta + dt * pitching)
    rolling_there, pitching_there, _ = angle_rates(attitude, after[0], after[1], after[2])
    half = 0.5 * dt
    return phi + half * (rolling + rolling_there), theta + half * (pitching + pitching_there)


@cache
def _attitude_reckoner(interpreting: bool) -> Loops:

    def reckon(rates, dt, attitudes):
        for b in range(rates.shape[0]):
            phi = theta = 0.0
            for k in range(1, rates.shape[1]):
                before = rates[b, k - 1, 0], rates[b, k - 1, 1], rates[b, k - 1, 2]
                after = rates[b, k, 0], rates[b, k, 1], rates[b, k, 2]
                phi, theta = next_attitude(phi, theta, before, after, dt)
                attitudes[b, k, 0] = phi
                attitudes[b, k, 1] = theta

    return Loops(reckon)


def reckoned_attitude(velocities: np.ndarray, dt: float) -> np.ndarray:
    """Roll and pitch (B, K + 1, 2) [rad] from p, q, r of velocities (B, K + 1, 6), level at the start."""
    attitudes = np.zeros((*velocities.shape[:2], 2))
    _attitude_reckoner(is_interpreting())(np.ascontiguousarray(velocities[..., 3:]), dt, attitudes)
    return attitudes


def full_pose(velocities: np.ndarray, attitudes: np.ndarray | None, dt: float) -> np.ndarray:
    """Position x, y, z [m] and yaw [rad], (B, K + 1, 4), by the full transformation from the origin.

    Args:
        velocities: u, v, w [m/s] and p, q, r [rad/s] in the body's axes, (B, K + 1, 6).
        attitudes: roll and pitch [rad], (B, K + 1, 2); dead-reckoned from the velocities if None.
        dt: time of a step [s].
    """
    if attitudes is None:
        attitudes = reckoned_attitude(velocities, dt)
    u, v, w, p, q, r = np.moveaxis(velocities, -1, 0)
    attitude = attitude_of(attitudes[..., 0], attitudes[..., 1])
    yaw = _integral(angle_rates(attitude, p, q, r)[2], dt)
    return np.stack([*(_integral(rate, dt) for rate in in_earth_axes(attitude, yaw, u, v, w)), yaw], axis=-1)


def planar_pose(velocities: np.ndarray, dt: float) -> np.ndarray:
    """The same by the papers' transformation, which turns by yaw alone: z' = w, psi' = r."""
    components = np.moveaxis(velocities, -1, 0)
    yaw = _integral(components[5], dt)
    rates = planar_kinematics(tuple(components), yaw)
    return np.stack([*(_integral(rate, dt) for rate in rates[:3]), yaw], axis=-1)


def pose_errors(poses: np.ndarray, true_poses: np.ndarray) -> np.ndarray:
    """Errors (..., 4) of positions [m] and of yaw [rad], which are the short way round."""
    return difference(poses, true_poses, POSE_ANGLES)


def _integral(rates: np.ndarray, dt: float) -> np.ndarray:
    return cumulative_trapezoid(rates, dx=dt, initial=0.0)


@lru_cache(maxsize=64)
def own_attitude_kernels(functions: Functions, shape: Shape) -> Kernels:
    """Kernels of the extended filter for a model whose last two inputs are roll and pitch."""
    n, m, inner = shape.n, shape.m, page_kernels(ExtendedKalmanFilter.page, functions, shape)
    layout, source, constants = memory_offsets(n, m), number_offsets(n, m), constants_reader(shape)
    start_filter, predict_filter, update_filter = inner.start, inner.predict, inner.update
    mean, step, extras, substeps = layout.mean, layout.step, layout.extras, source.substeps
    roll, pitch = shape.inputs - 2, shape.inputs - 1

    def start(memory, numbers, size):
        start_filter(memory, numbers, size)
        for i in range(KEPT):
            memory[0][extras + i] = 0.0

    def predict(memory, u, numbers, size):
        row, _, _ = memory
        u[roll] = row[extras]
        u[pitch] = row[extras + 1]
        predict_filter(memory, u, numbers, size)

    def update(memory, z, numbers, size):
        row, _, _ = memory
        update_filter(memory, z, numbers, size)
        after = row[mean + 3], row[mean + 4], row[mean + 5]
        if row[step] > 0.0:
            before = row[extras + 2], row[extras + 3], row[extras + 4]
            dt = constants(numbers).substep * numbers[substeps]
            row[extras], row[extras + 1] = next_attitude(row[extras], row[extras + 1], before, after, dt)
        row[extras + 2], row[extras + 3], row[extras + 4] = after

    return inner._replace(start=start, predict=predict, update=update, extras=KEPT, vectors=())


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnAttitudeKalmanFilter(ExtendedKalmanFilter):
    """The extended Kalman filter of u, v, w, p, q, r with its own attitude.

        predict: with roll and pitch as inputs, integrated from its estimates of p, q, r
        update:  that of `ExtendedKalmanFilter`, then roll and pitch a step further by Heun's rule

    It treats the attitude as known, so its covariance is too small. The given roll and pitch, the last two inputs
    of the model `auv_model(states="velocities")`, are overwritten. The vehicle starts level.
    """

    name: ClassVar[str] = "own attitude"

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        model = self.kernel_model
        return own_attitude_kernels(model.functions, model.shape)


def advance_from_the_mean(model, x, u):
    """One of the model's substeps, of all members at once."""
    return model.f(mean(x), u)


@dataclass(frozen=True, kw_only=True, eq=False)
class MeanPropagatingEnKF(EnsembleKalmanFilter):
    """The stochastic ensemble Kalman filter with a forecast that forgets the members.

        predict: x_j = f(mean, u) + w_j,  w_j ~ N(0, Q)
        update:  that of `EnsembleKalmanFilter`

    The members' covariance before an update is always Q, so the gain is Q H' (H Q H' + R)^-1: correlations that
    the model builds up over steps, such as of heave and pitch, are not used, and states that H does not contain
    are those of the model alone. With Q = R a state that is measured directly is estimated with the variance 2/3
    R; a correct filter has 0.618 R. It should not be used, so it is here and not in `filters`.

    Source: Ngatini, Nurhadi (2019), Jurnal Inovtek Polbeng Seri Informatika 4(1), equation (24), which has no
    index on the state that is moved; probably a misprint, for the authors' slides of 2017 have one.
    """

    name: ClassVar[str] = "mean-propagating enkf"
    page: ClassVar[Page] = EnsembleKalmanFilter.page._replace(propagate=advance_from_the_mean)


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
    velocities = papers_model("velocities", world)
    return [
        Estimator("EKF8", ExtendedKalmanFilter(model=motion)),
        Estimator("UKF8", UnscentedKalmanFilter(model=motion)),
        Estimator("EKF6 level", ExtendedKalmanFilter(model=level)),
        Estimator("EKF6 own attitude", OwnAttitudeKalmanFilter(model=velocities)),
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


def planar_kinematics(nu, psi):
    """The papers' rates of x, y, z [m/s] and psi [rad/s], which turn by yaw alone.

        x' = u cos psi - v sin psi,  y' = u sin psi + v cos psi,  z' = w,  psi' = r

    True for phi = theta = 0 only: a vehicle that dives by pitching stays at its depth here. Source: Ngatini,
    Nurhadi (2019), equations 1 to 4.
    """
    u, v, w, _, _, r = nu
    c_psi, s_psi = cosine_and_sine(psi)
    return u * c_psi - v * s_psi, u * s_psi + v * c_psi, w, r
