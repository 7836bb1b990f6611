"""Attainable accuracy: Riccati covariances, steady-state and along a path; `filters.posterior` has the bound."""

from __future__ import annotations

import numpy as np

from filters.engine.batch import run
from filters.gaussian.extended import ExtendedKalmanFilter
from thruster_env.core.checks import as_floats, correlations
from thruster_env.model.affine import AffineModel
from thruster_env.model.simulate import simulate
from thruster_env.model.state_space import StateSpaceModel

STIFF = 1e8  # S over R, from which an update of covariances loses half of their digits: roots keep them


def riccati_covariances(model: AffineModel) -> tuple[np.ndarray, np.ndarray]:
    """Steady-state covariances of the Kalman filter, predicted (before) and posterior (after the update).

    P solves the discrete algebraic Riccati equation P = A P A' - A P C' (C P C' + R)^-1 C P A' + Q; the
    posterior is P - P C' (C P C' + R)^-1 C P. Source: Anderson and Moore (1979), Optimal Filtering, ch. 4.
    """
    a, _, _, c, _ = model.matrices()
    predicted, gain = steady_state(a, c, model.process_noise_cov, model.measurement_noise_cov)
    posterior = predicted - gain @ (c @ predicted @ c.T + model.measurement_noise_cov) @ gain.T
    return predicted, (posterior + posterior.T) / 2


def steady_state(a: np.ndarray, c: np.ndarray, q: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The predicted covariance (n, n) that solves Riccati's equation, and the gain (n, m), in any units.

    It is solved in units of R's deviations and of those that Q gives the states in n steps.

    Raises numpy.linalg.LinAlgError if there is no stabilising solution.
    """
    from scipy.linalg import solve_discrete_are

    reached, power = np.zeros_like(q), np.eye(len(a))
    for _ in range(len(a)):
        reached, power = reached + power @ q @ power.T, a @ power
    states, channels = correlations(reached)[1], correlations(r)[1]
    a, c = a / states[:, None] * states, c / channels[:, None] * states
    q, r = q / states[:, None] / states, r / channels[:, None] / channels
    predicted = solve_discrete_are(a.T, c.T, q, r)
    predicted = (predicted + predicted.T) / 2
    gain = np.linalg.solve(c @ predicted @ c.T + r, c @ predicted).T
    return predicted * states[:, None] * states, gain * states[:, None] / channels


def path_bound(model: StateSpaceModel, inputs: np.ndarray, missing: np.ndarray | None = None) -> np.ndarray:
    """Riccati covariance along the noise-free path of each input sequence, a reference for small noise.

    With F and H at the states that follow from the prior mean without any noise,

        P = F P F' + Q,  K = P H' (H P H' + R)^-1,  P = (I - K H) P

    It is the covariance of an extended Kalman filter on the path, and optimal for a linear model. It is not a
    bound where noise moves the state so far that F or H differ. But it can be used where `posterior_bound` cannot:
    for a singular Q, and for a state with hardly any process noise, for which E[F' Q^-1 F] mistakes the smallest
    differences of F between simulated states for information.

    Args:
        model: the model that draws the truth.
        inputs: (B, K, p), one sequence a row.
        missing: whether each measurement is missing, (B, K + 1, m); none if None.

    Returns:
        P_k for every sequence and step, (B, K + 1, n, n); index 0 is after the first measurement. NaN for a
        sequence along which it is too large for float64.
    """
    inputs = np.ascontiguousarray(as_floats(inputs))
    keys, nothing = np.zeros((len(inputs), 2)), np.zeros((model.n, model.n))
    rounding = 1e-30 * model.measurement_noise_cov  # none at all is no covariance of a measurement
    calm = model.replace(process_noise_cov=nothing, prior_cov=nothing, measurement_noise_cov=rounding)
    measured = simulate(calm, keys, inputs).measurements
    if missing is not None:
        measured = np.where(missing, np.nan, measured)
    # Measurements that are right leave the estimate on the path.
    estimates = run(ExtendedKalmanFilter(model=model), keys, inputs, measured)
    expected = np.einsum("bkii->bki", estimates.innovation_covs) / np.diag(model.measurement_noise_cov)
    if (expected < STIFF).all() and not estimates.divergences.any():
        return estimates.covs
    estimates = run(ExtendedKalmanFilter(model=model, form="square-root"), keys, inputs, measured)
    return np.where((estimates.divergences > 0)[:, None, None, None], np.nan, estimates.covs)
