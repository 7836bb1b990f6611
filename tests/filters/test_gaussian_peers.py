"""Extended and unscented filters against other people's, step by step on the thruster: dynamax, Stone Soup."""

import json
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from filters import ExtendedKalmanFilter, UnscentedKalmanFilter, run, thruster_model
from filters.bounds import posterior_bound

# The thruster of `data/dynamax_thruster.py`: written a second time, from the print.
THRUSTER = json.loads((Path(__file__).parents[1] / "data" / "dynamax_thruster.json").read_text())
INPUTS = np.array(THRUSTER["voltages"])[None, :, None]
every_case = pytest.mark.parametrize("case", THRUSTER["cases"], ids=lambda case: case["channels"])
both_kinds = pytest.mark.parametrize("kind", ["ekf", "ukf"])


def model_of(case):
    channels = case["channels"].split(" and ")
    model = thruster_model(sensors=channels, measurement_noise_cov=case["r"], process_noise_cov=[1.0, 4e-4])
    return model.replace(prior_mean=[20.0, 0.3], prior_cov=[1.0, 0.01])


def filter_of(kind, case):
    if kind == "ekf":
        return ExtendedKalmanFilter(model=model_of(case))
    return UnscentedKalmanFilter(model=model_of(case), **numbers_of(case))


def numbers_of(case):
    return dict(zip(("alpha", "beta", "kappa"), case["points"], strict=True))


def assert_same(found, means, covs):
    """Means and covariances of every step agree, to 1e-6 of the standard deviations."""
    spread = np.sqrt(np.einsum("kii->ki", covs))
    assert np.abs((found.means[0] - means) / spread).max() < 1e-6
    assert np.abs((found.covs[0] - covs) / (spread[:, :, None] * spread[:, None, :])).max() < 1e-6


@pytest.mark.usefixtures("as_python")
@both_kinds
@every_case
def test_every_step_is_that_of_dynamax(case, kind):
    rows = np.array(case[kind])
    means, covs = rows[:, :2], rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    estimates = run(filter_of(kind, case), np.zeros((1, 2)), INPUTS, np.array([case["z"]]))
    assert_same(estimates, means, covs)  # dynamax adds 1e-9 to the diagonal of S before it solves: 4e-9 of S
    np.testing.assert_allclose(np.cumsum(estimates.log_likelihoods[0]), rows[:, 5], rtol=1e-6)


def stone_soup_models(model):
    """The model's functions in Stone Soup's classes; the input is set before every step."""
    from stonesoup.models.base import GaussianModel
    from stonesoup.models.measurement import MeasurementModel
    from stonesoup.models.transition import TransitionModel
    from stonesoup.types.array import StateVectors

    def of_columns(function, state):
        return StateVectors(
            np.transpose([function(tuple(x)) for x in np.array(state.state_vector, dtype=float).T])
        )

    def moved(x, u):
        for _ in range(model.substeps):
            x = model.transition(x, u, model.constants)
        return x

    class Motion(TransitionModel, GaussianModel):
        ndim_state, input = model.n, None

        def function(self, state, noise=False, **kwargs):
            return of_columns(lambda x: moved(x, self.input), state)

        def jacobian(self, state, **kwargs):
            x, chain = tuple(state.state_vector.ravel()), np.eye(model.n)
            for _ in range(model.substeps):
                chain = np.array(model.transition_jacobian(x, self.input, model.constants)) @ chain
                x = model.transition(x, self.input, model.constants)
            return chain

        def covar(self, **kwargs):
            return model.process_noise_cov

    class Sensors(MeasurementModel, GaussianModel):
        ndim_meas = model.m

        def function(self, state, noise=False, **kwargs):
            return of_columns(lambda x: model.observe(x, model.constants), state)

        def jacobian(self, state, **kwargs):
            return np.array(model.observe_jacobian(tuple(state.state_vector.ravel()), model.constants))

        def covar(self, **kwargs):
            return model.measurement_noise_cov

    return Motion(), Sensors(ndim_state=model.n, mapping=tuple(range(model.n)))


@pytest.mark.usefixtures("as_python")
@both_kinds
@every_case
def test_every_step_is_that_of_stone_soup(case, kind):
    pytest.importorskip("stonesoup")
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor, UnscentedKalmanPredictor
    from stonesoup.types.array import CovarianceMatrix, StateVector
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.prediction import GaussianStatePrediction
    from stonesoup.updater.kalman import ExtendedKalmanUpdater, UnscentedKalmanUpdater

    model = model_of(case)
    estimates = run(filter_of(kind, case), np.zeros((1, 2)), INPUTS, np.array([case["z"]]))
    motion, sensors = stone_soup_models(model)
    if kind == "ekf":
        predictor, updater = ExtendedKalmanPredictor(motion), ExtendedKalmanUpdater(sensors)
    else:
        predictor = UnscentedKalmanPredictor(motion, **numbers_of(case))
        updater = UnscentedKalmanUpdater(sensors, **numbers_of(case))

    start, states = datetime(2026, 1, 1), []
    for k, z in enumerate(case["z"]):
        now = start + timedelta(seconds=k)
        if k == 0:
            mean, cov = StateVector(model.prior_mean), CovarianceMatrix(model.prior_cov)
            predicted = GaussianStatePrediction(mean, cov, timestamp=now)
        else:
            motion.input = tuple(INPUTS[0, k - 1])
            predicted = predictor.predict(states[-1], timestamp=now)
        states.append(updater.update(SingleHypothesis(predicted, Detection(StateVector(z), timestamp=now))))
        expected = states[-1].hypothesis.measurement_prediction
        np.testing.assert_allclose(estimates.innovation_covs[0, k], expected.covar, rtol=1e-6)
        innovation = np.array(z) - expected.state_vector.ravel()
        np.testing.assert_allclose(estimates.innovations[0, k], innovation, rtol=1e-6, atol=1e-6)
    assert_same(estimates, np.array([s.state_vector.ravel() for s in states]), np.array([s.covar for s in states]))


def test_the_bound_is_that_of_another_implementation_with_truths_of_its_own():
    rows = np.array(THRUSTER["bound"])
    bound = posterior_bound(model_of(THRUSTER["cases"][0]), INPUTS, truths=20_000, seed=3)[0]
    found = np.stack([bound[:, 0, 0], bound[:, 1, 1]])
    expected = rows[:, [0, 2]].T
    # The scored average of variances, as standard errors; and no step strays, start-up included.
    scored = np.sqrt(found[:, 50:].mean(axis=1)), np.sqrt(expected[:, 50:].mean(axis=1))
    np.testing.assert_allclose(*scored, rtol=1e-3)
    np.testing.assert_allclose(found, expected, rtol=1e-2)
