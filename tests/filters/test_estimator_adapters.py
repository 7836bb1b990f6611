"""FilterPy's and Stone Soup's filters and a network in torch as estimators."""

import numpy as np
import pytest

from filters import EstimateState, make_filter, run
from filters.estimators.libraries import FilterPyEstimator, StoneSoupEstimator
from tests.filters.test_gaussian_peers import stone_soup_models
from tests.models import random_affine, simulated
from tuning.evaluation.compare import compare, contender
from tuning.plants.thruster import find_scenario
from tuning.problems.data import held_out_seeds

UNSCENTED = "filters.estimators.libraries:unscented"


def assert_equal(one, other, rtol):
    for name, mine, theirs in zip(one._fields, one, other, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=rtol, atol=rtol, err_msg=name)


def short(name, seeds=2, steps=60):
    data = find_scenario(name).data(held_out_seeds(0, seeds))
    z = data.measurements[:, : steps + 1].copy()
    z[0, 7] = np.nan
    return data.filter_keys, data.inputs[:, :steps], z


@pytest.mark.parametrize("name", ["nominal", "mismatch"])
def test_filterpy_s_unscented_filter_gives_what_ours_gives(name):
    pytest.importorskip("filterpy")
    problem = find_scenario(name)
    filters = [make_filter(kind, problem.model(**problem.true)) for kind in ("ukf", UNSCENTED)]
    ours, theirs = (run(one, *short(name)) for one in filters)
    assert_equal(ours, theirs, 1e-6)
    assert filters[1].name == "filterpy ukf" and filters[1].has_covariance


def test_it_stands_in_a_comparison_and_beside_an_env():
    pytest.importorskip("filterpy")
    import gymnasium as gym

    problem = find_scenario("nominal").replace(steps=60)
    (board,), _ = compare([contender("ukf"), contender(UNSCENTED)], [problem], held_out_seeds(0, 2))
    assert [row.label for row in board.rows] == ["ukf", UNSCENTED]
    assert board.rows[1].score_ratio.value == pytest.approx(1.0, abs=1e-9)
    assert board.rows[1].nees == pytest.approx(board.rows[0].nees, rel=1e-6)
    envs = [EstimateState(gym.make("BowThruster-v0"), filter=kind, observation="belief", alpha=0.5)
            for kind in ("ukf", UNSCENTED)]  # fmt: skip
    for seen in zip(
        *([env.reset(seed=1)[0]] + [env.step([9.0])[0] for _ in range(9)] for env in envs), strict=True
    ):
        np.testing.assert_allclose(*seen, rtol=1e-6, atol=1e-6)


def linear(columns):
    """FilterPy's linear filter of an affine model without offset, x (n, 1) or (n,)."""
    peer = pytest.importorskip("filterpy.kalman")
    model = random_affine(n=3, m=2, p=2, seed=2)
    zero, still = (0.0,) * 3, (0.0, 0.0)
    f, h = (np.array(part) for part in (model.transition(zero, still, model.constants),
                                        model.observe(zero, model.constants)))  # fmt: skip
    own = peer.KalmanFilter(3, 2, 2)
    own.F = np.array([np.array(model.transition(tuple(e), still, model.constants)) - f for e in np.eye(3)]).T
    own.B = np.array([np.array(model.transition(zero, tuple(e), model.constants)) - f for e in np.eye(2)]).T
    own.H = np.array([np.array(model.observe(tuple(e), model.constants)) - h for e in np.eye(3)]).T
    own.x = model.prior_mean[:, None] if columns else model.prior_mean
    own.P, own.Q, own.R = model.prior_cov, model.process_noise_cov, model.measurement_noise_cov
    return model, own, f, h


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("columns", [True, False])
def test_its_linear_filter_leaves_out_missing_channels_as_ours(columns):
    model, own, f, h = linear(columns)
    inputs, z = simulated(model)
    z[0, 4, 1] = z[0, 6] = np.nan

    def predict(filter, u):
        filter.predict(u=u)
        filter.x = filter.x + (f[:, None] if columns else f)  # the offset of the affine model

    theirs = make_filter(FilterPyEstimator(own, predict), model)
    ours = run(make_filter("kf", model), np.zeros((1, 2)), inputs, z)
    found = run(theirs, np.zeros((1, 2)), inputs, z - h)
    assert_equal(ours, found, 1e-9)
    assert theirs.name == "filterpy KalmanFilter"


def test_stone_soup_s_extended_filter_gives_what_ours_gives():
    pytest.importorskip("stonesoup")
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import ExtendedKalmanUpdater

    problem = find_scenario("mismatch")

    def extended(model):
        motion, sensors = stone_soup_models(model)
        predictor, updater = ExtendedKalmanPredictor(motion), ExtendedKalmanUpdater(sensors)
        prior = GaussianState(model.prior_mean, model.prior_cov)
        return StoneSoupEstimator(predictor, updater, prior, 0.01, lambda own, u: setattr(own, "input", tuple(u)))

    model = problem.model(**problem.true)
    ours, theirs = (run(make_filter(kind, model), *short("mismatch", 2, 30)) for kind in ("ekf", extended))
    assert_equal(ours, theirs, 1e-6)
