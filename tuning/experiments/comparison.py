"""The published experiment repeated with many runs: Kalman filter, ensemble Kalman filter and the optimum.

Truth and filter share the model x' = A_d x + w, z = H x + v with Q = R = q I and zero input. The input has no
effect: it is known to truth and filters, and the errors of a linear filter do not depend on it.

The start. The papers print neither x_0 nor P_0. Here x_0 and the filter's prior are N(0, P_inf), P_inf being
the steady-state covariance of the *predicted* state. Our filters are updated with z_0 before they first
predict, so with this prior the Kalman filter's posterior covariance is the steady state's at every step, and
its mean square error has the Riccati optimum as expectation. Were P_inf the posterior covariance, the update
with z_0 would make the first steps better than the steady state. A second start, N(0, I), shows how little
this matters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from filters import EnsembleKalmanFilter, KalmanFilter, affine_model
from filters.bounds import riccati_covariances
from filters.engine.batch import run
from filters.ensembles.ensemble import LARGEST_ENSEMBLE
from filters.filter import Filter
from thruster_env.core.checks import at_least, one_of, positive
from thruster_env.core.matrices import zero_order_hold
from thruster_env.core.streams import COMPARISON_STUDY, derived_generator
from thruster_env.model.affine import AffineModel
from thruster_env.model.simulate import Truth, simulate
from thruster_env.thruster.linear.published import SAMPLE_TIME
from tuning.experiments.published import NOISE_LEVELS, STEPS, SYSTEMS, H
from tuning.experiments.unupdated_ensemble import unupdated_ensemble_means

RUNS = 200
MOST_RUNS = 100_000  # which take a gigabyte
MEMBERS = 200  # the RMSE is about 0.6 % above the Kalman filter's; with 100 members it is 1.2 %
RESAMPLES = 2000


class Score(NamedTuple):
    """RMSE of an estimator, one entry for each state: (omega_m [rad/s], U_a [m/s])."""

    rmse: np.ndarray  # (2,), pooled over runs and over steps 1 ... 100
    low: np.ndarray  # (2,), 95 % interval of rmse, by bootstrap over runs ...
    high: np.ndarray  # (2,)
    run_std: np.ndarray  # (2,), standard deviation of the RMSE of a single run
    run_ratio: np.ndarray  # (2,), omega_m's RMSE over U_a's in a single run [rad/m]: mean, standard deviation


class Comparison(NamedTuple):
    """All estimators on one case at one noise level."""

    case: str
    q: float
    optimum: np.ndarray  # (2,), root of the diagonal of the steady-state posterior covariance
    kf: Score
    enkf: Score
    kf_identity: Score  # from x_0 ~ N(0, I), P_0 = I
    enkf_identity: Score
    unupdated: Score  # the wrong filter of `unupdated_ensemble`

    @property
    def enkf_over_kf(self) -> np.ndarray:
        """RMSE of the ensemble Kalman filter over that of the Kalman filter on the same runs, (2,)."""
        return self.enkf.rmse / self.kf.rmse


def discrete_model(case: str, q: float, prior_cov=None) -> AffineModel:
    """The published system by name, discretised, with Q = R = q I and the papers' H.

    Args:
        case: "tunnel" or "open-bladed".
        q: variance, positive.
        prior_cov: P_0, (2, 2) or two variances; the steady-state predicted covariance if None.

    Raises:
        ValueError: for an unknown case or a q that is not positive.
    """
    system, q = SYSTEMS[one_of("case", case, tuple(SYSTEMS))], positive("q", q)
    a, b = zero_order_hold(np.array(system.a), np.array(system.b), SAMPLE_TIME)
    model = affine_model(
        a=a,
        b=b,
        c=H,
        process_noise_cov=[q, q],
        measurement_noise_cov=[q],
        prior_mean=[0.0, 0.0],
        prior_cov=[1.0, 1.0] if prior_cov is None else prior_cov,
    )
    return model.replace(prior_cov=riccati_covariances(model)[0]) if prior_cov is None else model


def optimum(case: str, q: float) -> np.ndarray:
    """Least RMSE (2,) of any estimator in the steady state, from the Riccati equation."""
    return np.sqrt(np.diag(riccati_covariances(discrete_model(case, q))[1]))


def compare(case: str, q: float, *, runs: int = RUNS, members: int = MEMBERS, seed: int = 0) -> Comparison:
    """Run every estimator on the same runs of one case at one noise level.

    Args:
        case: "tunnel" or "open-bladed".
        q: noise variance, Q = R = q I.
        runs: independent runs of 100 steps, at least 2: the intervals come from their scatter.
        members: ensemble size N, at least 2.
        seed: seed of all random numbers; cases and noise levels have independent draws.

    Raises:
        ValueError: if an argument breaks its rule.
    """
    runs, members = at_least("runs", runs, 2, MOST_RUNS), at_least("members", members, 2, LARGEST_ENSEMBLE)
    seed = at_least("seed", seed, 0)
    stationary, identity = discrete_model(case, q), discrete_model(case, q, prior_cov=[1.0, 1.0])
    keys, generator = keys_of(case, q, runs, seed)
    inputs = np.zeros((runs, STEPS, stationary.inputs))

    errors = []
    for model in (stationary, identity):
        truth = simulate(model, keys, inputs)
        for filter_ in (KalmanFilter(model=model), EnsembleKalmanFilter(model=model, ensemble_size=members)):
            errors.append(_errors(filter_, truth, keys, inputs))
        if model is stationary:
            free = unupdated_ensemble_means(model, truth.states, members, generator) - truth.states
    kf, enkf, kf_identity, enkf_identity, unupdated = scores([*errors, free], generator)
    return Comparison(case, q, optimum(case, q), kf, enkf, kf_identity, enkf_identity, unupdated)


def keys_of(case: str, q: float, runs: int, seed: int) -> tuple[np.ndarray, np.random.Generator]:
    """The keys (runs, 2) of the runs of one case at one noise level, and the generator of all other draws."""
    generator = derived_generator(seed, COMPARISON_STUDY, tuple(SYSTEMS).index(case), round(1000 * q))
    return generator.integers(0, 2**32, size=(runs, 2)).astype(np.float64), generator


def _errors(filter_: Filter, truth: Truth, keys: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    return run(filter_, keys, inputs, truth.measurements).means - truth.states


def scores(errors: list[np.ndarray], generator: np.random.Generator) -> list[Score]:
    """Scores of estimators from their errors (runs, steps + 1, 2) on the same runs; index 0 is not scored."""
    runs = len(errors[0])
    # (runs, estimators, 2)
    mean_squares = np.stack([np.square(e[:, 1:]).mean(axis=1) for e in errors], axis=1)
    columns, share = mean_squares.reshape(runs, -1), np.full(runs, 1.0 / runs)
    resampled = np.sqrt([generator.multinomial(runs, share) @ columns / runs for _ in range(RESAMPLES)])
    low, high = np.percentile(resampled, (2.5, 97.5), axis=0).reshape(2, len(errors), -1)
    single = np.sqrt(mean_squares)
    ratio = single[..., 0] / single[..., 1]  # (runs, estimators)
    run_ratio = np.stack([ratio.mean(axis=0), ratio.std(axis=0, ddof=1)], axis=1)
    rmse, run_std = np.sqrt(mean_squares.mean(axis=0)), single.std(axis=0, ddof=1)
    return [Score(*parts) for parts in zip(rmse, low, high, run_std, run_ratio, strict=True)]


def compare_all(
    *,
    runs: int = RUNS,
    members: int = MEMBERS,
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Comparison]:
    """`compare` for every case and noise level; on_progress(done, total) is called after each."""
    grid = [(case, q) for case in SYSTEMS for q in NOISE_LEVELS]
    comparisons = []
    for case, q in grid:
        comparisons.append(compare(case, q, runs=runs, members=members, seed=seed))
        on_progress(len(comparisons), len(grid))
    return comparisons
