"""Stone Soup's Kalman filters for a target at nearly constant velocity, seen in range and bearing."""

from __future__ import annotations

import datetime
import importlib.util
from collections.abc import Mapping, Sequence

import numpy as np

START = datetime.datetime(2024, 1, 1)


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
    for run, found in zip(measurements, means, strict=True):
        state = GaussianState(prior_mean, np.diag(prior_cov), timestamp=START)
        for k, (bearing, distance) in enumerate(run):
            moment = START + datetime.timedelta(seconds=k * dt)
            state = predictor.predict(state, timestamp=moment) if k else state
            seen = Detection(StateVector([[Bearing(bearing)], [distance]]), timestamp=moment)
            state = updater.update(SingleHypothesis(state, seen))
            found[k] = np.ravel(state.mean).astype(float)
    return means
