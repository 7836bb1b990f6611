"""A target at nearly constant velocity, seen in range and bearing: our filters beside Stone Soup's.

    x = (x, v_x, y, v_y),   x_{k+1} = F x_k + w,   bearing = atan2(y, x) + v_1,   range = |(x, y)| + v_2

with white acceleration: Q = sigma_a^2 [[T^3/3, T^2/2], [T^2/2, T]] in either direction. Tuned is sigma_a, one
number. The target passes behind the sensor, where the bearing jumps from pi to -pi.

    thruster tune --problem tuning.experiments.range_bearing:problem --filter ekf --trials 20
    thruster reproduce range-bearing

Sources: Y. Bar-Shalom, X.-R. Li, T. Kirubarajan (2001), Estimation with Applications to Tracking and Navigation,
section 6.2.2; P. Thomas, J. Barr, B. Balaji, K. White (2017), "An open source framework for tracking and state
estimation ('Stone Soup')", Proc. SPIE 10200.
"""

from __future__ import annotations

import datetime
import importlib.util
import math
from collections.abc import Mapping, Sequence

import numpy as np

from filters import StateSpaceModel, make_filter
from filters.consistency.nees import rmse_intervals
from filters.engine.batch import run
from thruster_env.model.quantities import Quantity
from tuning.experiments.benchmark import Benchmark, OnRow, Row, run_in_memory
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Parameter
from tuning.search.plan import Plan
from tuning.search.trials import best_trial

START = datetime.datetime(2024, 1, 1)
DT, STEPS = 1.0, 100  # [s]
TRUE_SIGMA = 0.2  # [m/s^1.5]
DEVIATIONS = 0.005, 2.0  # of bearing [rad] and range [m]
PRIOR_MEAN, PRIOR_COV = (-800.0, -3.0, 45.0, -4.0), (25.0, 1.0, 25.0, 1.0)
POSITION = [0, 2]
POINTS = {"alpha": 0.5, "beta": 2.0, "kappa": -1.0}  # of the unscented filters
TRIALS = 20
SIGMA = Parameter("sigma_a", 0.01, 10.0, unit="m/s^1.5", default=2.0)  # the default is a guess, as users make one
SCALE = (2.0, 0.5, 2.0, 0.5)  # what errors are measured in: about those of a good filter [m, m/s]


def check_installed() -> None:
    """Raise ValueError if Stone Soup is not installed."""
    if importlib.util.find_spec("stonesoup") is None:
        raise ValueError("Stone Soup must be installed to compare with: pip install stonesoup")


def stone_soup_means(
    name: str,
    measurements: np.ndarray,
    sigma_a: float,
    dt: float,
    deviations: Sequence[float],
    prior_mean: Sequence[float],
    prior_cov: Sequence[float],
    numbers: Mapping[str, float],
) -> np.ndarray:
    """Its estimates (B, K + 1, 4) of (x, v_x, y, v_y) from bearings [rad] and ranges [m], (B, K + 1, 2).

    Args:
        name: "ekf" or "ukf".
        measurements: the first one has the time of the prior.
        sigma_a: root of the acceleration's spectral density [m/s^1.5].
        dt: sample time [s].
        deviations: of bearing [rad] and range [m].
        prior_mean: of the state, (4,).
        prior_cov: variances, (4,).
        numbers: alpha, beta and kappa of the unscented filter.

    Raises:
        ValueError: if Stone Soup is not installed.
    """
    check_installed()
    from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor, UnscentedKalmanPredictor
    from stonesoup.types.angle import Bearing
    from stonesoup.types.array import StateVector
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import ExtendedKalmanUpdater, UnscentedKalmanUpdater

    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(sigma_a**2)] * 2)
    sensor = CartesianToBearingRange(ndim_state=4, mapping=(0, 2), noise_covar=np.diag(np.square(deviations)))
    if name == "ekf":
        predictor, updater = ExtendedKalmanPredictor(motion), ExtendedKalmanUpdater(sensor)
    else:
        predictor, updater = UnscentedKalmanPredictor(motion, **numbers), UnscentedKalmanUpdater(sensor, **numbers)
    means = np.empty((*measurements.shape[:2], 4))
    for track, track_means in zip(measurements, means, strict=True):
        state = GaussianState(prior_mean, np.diag(prior_cov), timestamp=START)
        for k, (bearing, distance) in enumerate(track):
            moment = START + datetime.timedelta(seconds=k * dt)
            state = predictor.predict(state, timestamp=moment) if k else state
            detection = Detection(StateVector([[Bearing(bearing)], [distance]]), timestamp=moment)
            state = updater.update(SingleHypothesis(state, detection))
            track_means[k] = np.ravel(state.mean).astype(float)
    return means


def move(x, u, c):
    """One step at constant velocity."""
    return (x[0] + DT * x[1], x[1], x[2] + DT * x[3], x[3])


def see(x, c):
    """Bearing and range."""
    return (math.atan2(x[2], x[0]), math.hypot(x[0], x[2]))


def model(sigma_a: float = TRUE_SIGMA) -> StateSpaceModel:
    """The target with another sigma_a [m/s^1.5]."""
    block = sigma_a**2 * np.array([[DT**3 / 3.0, DT**2 / 2.0], [DT**2 / 2.0, DT]])
    return StateSpaceModel(
        transition=move,
        observe=see,
        process_noise_cov=np.kron(np.eye(2), block),
        measurement_noise_cov=np.square(DEVIATIONS),
        prior_mean=PRIOR_MEAN,
        prior_cov=PRIOR_COV,
        inputs=0,
        states=[("position", "x", "m"), ("speed", "v_x", "m/s"), ("position", "y", "m"), ("speed", "v_y", "m/s")],
        measurements=[Quantity("bearing", "b", "rad", True), ("range", "r", "m")],
    )


problem = ModelProblem(model(), model, steps=STEPS, dt=DT, parameters=[SIGMA], scale=SCALE)


def tuned_sigma(trials: int = TRIALS, seed: int = 0) -> float:
    """The sigma_a [m/s^1.5] of the best trial of a study of an extended Kalman filter.

    Whether that trial wins does not count: a baseline may have its own Q, and no sigma_a.
    """
    best = best_trial(run_in_memory(Plan("ekf", (problem,), seed), trials).trials)
    assert best is not None
    return best.params["sigma_a"]


def rows(seeds: Sequence[int], on_row: OnRow) -> list[Row]:
    """Both filters before and after tuning, beside Stone Soup's with the same numbers."""
    check_installed()  # before anything is compiled
    data, table = problem.data(seeds), []
    for word, sigma in (("untuned", SIGMA.start), ("tuned", tuned_sigma())):
        for name, numbers in (("ekf", {}), ("ukf", POINTS)):
            filter_, prior = make_filter(name, model(sigma), **numbers), (PRIOR_MEAN, PRIOR_COV)
            estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
            other = stone_soup_means(name, data.measurements, sigma, DT, DEVIATIONS, *prior, numbers)
            squares, theirs = (_squares(means, data) for means in (estimates.means, other))
            (ours,) = rmse_intervals(squares[:, None])
            label, runs = f"{name}, {word}, sigma_a {sigma:.3g}", np.sqrt(squares)
            lost = estimates.divergences.sum()
            spread = float(np.median(runs)), float(runs.std(ddof=1))
            table.append(Row(label, float(np.sqrt(theirs.mean())), ours, ours.value, int(lost), *spread, ""))
            on_row(table[-1])
    return table


def _squares(means: np.ndarray, data) -> np.ndarray:
    """Mean square distance from the true position of each run [m^2], (B,)."""
    errors = (means - data.states)[:, data.late][..., POSITION]
    return np.square(errors).sum(axis=2).mean(axis=1)


BENCHMARK = Benchmark(
    name="range-bearing",
    about="a target at nearly constant velocity, seen in range and bearing across the cut at pi",
    theirs="Stone Soup",
    score="the RMSE of position [m]",
    source="Stone Soup 1 on the same measurements, with the same parameters",
    remarks=(
        f"The truth has sigma_a = {TRUE_SIGMA} m/s^1.5. A study of {TRIALS} trials tunes only this parameter.",
        "Stone Soup computes the sensor's Jacobian by one-sided differences, ours are central.",
    ),
    rows=rows,
)
TABLES = {"range_bearing": BENCHMARK.markdown}
