import math
import pickle

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import make_filter, run, thruster_model
from filters.bounds import posterior_bound
from filters.consistency.nees import normalized_squares
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from thruster_env.core.compiled import interpreted
from thruster_env.model import simulate
from tuning.evaluation.evaluate import check_consistency, evaluate, score_ratio
from tuning.evaluation.held_out import summary
from tuning.evaluation.runs import _means_over_steps, log_scores_of
from tuning.plants.thruster import find_scenario
from tuning.problems import data as in_parts
from tuning.problems.data import held_out_seeds
from tuning.search.plan import LARGEST
from tuning.search.space import oracle_choice, untuned_choice


@pytest.fixture(scope="module")
def nominal():
    return find_scenario("nominal")


@pytest.fixture(scope="module")
def data(nominal):
    return nominal.data(held_out_seeds(5, 200))


@pytest.fixture(scope="module")
def ekf(nominal, data):
    return evaluate(oracle_choice("ekf", nominal).filter(nominal), data, nominal.scale)


@pytest.fixture(scope="module")
def untuned_ekf(nominal, data):
    return evaluate(untuned_choice("ekf", nominal).filter(nominal), data, nominal.scale)


@pytest.mark.parametrize("name", ["ekf", "enkf"])
def test_runs_may_be_evaluated_some_at_a_time(nominal, data, name, monkeypatch):
    filter_, some = oracle_choice(name, nominal).filter(nominal), data.slice(0, 21)
    whole = evaluate(filter_, some, nominal.scale), check_consistency(filter_, some)
    monkeypatch.setattr(in_parts, "MOST_BYTES", 1)
    monkeypatch.setattr(in_parts, "cores", lambda: 4)
    assert in_parts.parts_of(filter_, some)[-2:] == [(16, 20), (20, 21)]
    parts = evaluate(filter_, some, nominal.scale), check_consistency(filter_, some)
    assert pickle.dumps(parts) == pickle.dumps(whole)


def test_the_true_ekf_sits_on_the_bound_and_the_untuned_one_is_worse_as_pairs_say(nominal, data, ekf, untuned_ekf):
    bound = nominal.bound(data)
    for rmse, limit in zip(ekf.rmse, bound, strict=True):
        assert 0.98 * limit < rmse.value < 1.05 * limit
    assert ekf.nees.low < 2.0 < ekf.nees.high
    assert ekf.nis.low < 1.0 < ekf.nis.high
    assert ekf.divergences == 0
    ratio = score_ratio(untuned_ekf, ekf)
    assert 1.0 < ratio.low < ratio.value < ratio.high
    assert score_ratio(ekf, ekf) == (1.0, 1.0, 1.0)
    # pairing makes the interval of the ratio narrower than the two intervals side by side
    unpaired = untuned_ekf.score.high / ekf.score.low - untuned_ekf.score.low / ekf.score.high
    assert ratio.high - ratio.low < unpaired


def test_a_filter_without_covariance_is_judged_by_its_errors_only(nominal, data):
    few = data.slice(0, 3)
    with interpreted():
        evaluation = evaluate(make_filter("low-pass", nominal.model()), few, nominal.scale)
    assert np.isnan([evaluation.nees, evaluation.nis]).all() and np.isnan(evaluation.log_likelihood)
    assert np.isfinite(evaluation.rmse).all() and np.isfinite(evaluation.output_rmse["T"]).all()
    said = summary(evaluation)
    assert said["nees"] is said["nis"] is said["log_likelihood"] is None


def test_bad_scales_and_unequal_seeds_are_refused(nominal, data, ekf):
    with pytest.raises(ValueError, match="scale must be positive in every state, but got"):
        evaluate(oracle_choice("ekf", nominal).filter(nominal), data, [1.0, 0.0])
    refused("same seeds, but got 200 and 199", score_ratio, ekf, ekf._replace(mean_squares=ekf.mean_squares[1:]))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("shape", [(50, 3), (3, 4, 15)])
def test_normalized_squares_against_inverses_and_skip_singular_covariances(shape):
    rng, n = np.random.default_rng(0), shape[-1]
    roots, errors = rng.normal(size=(*shape, n + 5)), rng.normal(size=shape)
    covs = roots @ np.swapaxes(roots, -1, -2)
    pairs = zip(errors.reshape(-1, n), covs.reshape(-1, n, n), strict=True)
    expected = np.reshape([e @ np.linalg.inv(p) @ e for e, p in pairs], shape[:-1])
    np.testing.assert_allclose(normalized_squares(errors, covs), expected, rtol=1e-9)
    rows, of_rows = errors.reshape(-1, n), covs.reshape(-1, n, n)  # views
    of_rows[3], of_rows[4] = 0.0, np.outer(np.arange(n), np.arange(n))
    rows[5], of_rows[5] = 1e200, 1e300 * of_rows[5]
    found = normalized_squares(errors, covs).ravel()
    assert np.isnan(found[[3, 4]]).all() and np.isfinite(found[[0, 1, 2, *range(6, len(found))]]).all()


def test_on_the_thruster_the_bound_is_the_naive_recursion_on_the_same_truths():
    model, truths = thruster_model(), 30
    inputs = np.repeat(np.random.default_rng(8).uniform(-12, 12, size=(2, 3, 1)), 10, axis=1)
    bound = posterior_bound(model, inputs, truths=truths, seed=5)
    keys = np.random.default_rng(5).integers(0, 2**32, size=(2, truths, 2))
    q, r, c = np.linalg.inv(model.process_noise_cov), np.linalg.inv(model.measurement_noise_cov), model.constants

    def information_of(states):
        slopes = [np.array(model.observe_jacobian(tuple(x), c)) for x in states]
        return np.mean([h.T @ r @ h for h in slopes], axis=0)

    def slopes_of(x, u):
        chain, x = np.eye(2), tuple(x)
        for _ in range(model.substeps):
            chain = np.array(model.transition_jacobian(x, u, c)) @ chain
            x = model.transition(x, u, c)
        return chain

    for b in range(2):
        drawn = simulate.simulate(model, keys[b], np.repeat(inputs[b : b + 1], truths, axis=0)).states
        j = np.linalg.inv(model.prior_cov) + information_of(drawn[:, 0])  # equation 21 with no motion yet
        np.testing.assert_allclose(bound[b, 0], np.linalg.inv(j), rtol=1e-9)
        for k in range(30):
            f = np.array([slopes_of(x, tuple(inputs[b, k])) for x in drawn[:, k]])
            d11 = np.mean(np.swapaxes(f, 1, 2) @ q @ f, axis=0)
            d12 = -f.mean(axis=0).T @ q
            d22 = q + information_of(drawn[:, k + 1])
            j = d22 - d12.T @ np.linalg.inv(j + d11) @ d12
            np.testing.assert_allclose(bound[b, k + 1], np.linalg.inv(j), rtol=1e-8)


def test_the_bound_starts_from_a_prior_without_spread():
    model = PROBLEM.model().replace(prior_cov=np.zeros((3, 3)))
    bound = posterior_bound(model, np.zeros((1, 3, 1)), truths=2)[0]
    assert (bound[0] == 0).all() and np.linalg.eigvalsh(bound[1])[0] > 0


@pytest.mark.parametrize("shape", [(5, 7, 1), (5, 451, 2), (3, 40, 12), (1, 9, 2)])
def test_means_over_steps_are_numpys_to_the_last_bit(shape):
    values = np.random.default_rng(0).lognormal(sigma=3.0, size=shape)
    assert np.array_equal(_means_over_steps(values), values.mean(axis=1))


PROBLEM = LinearProblem()
DATA = PROBLEM.data(range(3))
FILTER = make_filter("kf", PROBLEM.model())
with interpreted():  # each worker of pytest imports this file
    ESTIMATES = run(FILTER, DATA.filter_keys, DATA.inputs, DATA.measurements)


def scores(scale, covs=ESTIMATES.covs, data=DATA):
    steps = log_scores_of(FILTER, ESTIMATES._replace(covs=covs), data, scale)
    assert steps.shape == (3, 61)
    return np.nanmean(steps, axis=1)


def by_hand(places, counted=None):
    found = []
    for b in range(3):
        steps = [k for k in range(DATA.first_scored, 71) if counted is None or counted[b, k]]
        means, covs = ESTIMATES.means[b][:, places], ESTIMATES.covs[b][:, places][:, :, places]
        densities = [multivariate_normal(means[k], covs[k]).logpdf(DATA.states[b, k, places]) for k in steps]
        found.append(np.mean(densities))
    return found


@pytest.mark.parametrize(
    ("scale", "places"),
    [((0.3, 0.3, 0.3), [0, 1, 2]), ((0.3, math.inf, 0.1), [0, 2]), ((math.inf, 1.0, math.inf), [1])],
)
def test_the_log_score_is_the_density_of_the_states_that_count(scale, places):
    np.testing.assert_allclose(scores(scale), by_hand(places), rtol=1e-9)


def test_a_state_that_does_not_count_earns_nothing_and_a_singular_covariance_has_the_least_score():
    sure = ESTIMATES.covs.copy()
    sure[..., 1, :] = sure[..., :, 1] = 0.0
    sure[..., 1, 1] = 1e-300
    scale = (0.3, math.inf, 0.3)
    np.testing.assert_allclose(scores(scale, sure), by_hand([0, 2]), rtol=1e-9)
    singular = ESTIMATES.covs.copy()
    singular[1, 40:, 1, :] = singular[1, 40:, :, 1] = 0.0
    singular[2] = np.nan
    first, some, none = scores(PROBLEM.scale, singular)
    assert first == pytest.approx(by_hand([0, 1, 2])[0]) and none == -LARGEST
    assert some == pytest.approx(-LARGEST * 31 / 61, rel=1e-3)


def test_only_scored_steps_count_and_without_truth_there_is_no_score():
    counted = np.ones((3, 71), dtype=bool)
    counted[0, 30:] = counted[2, ::2] = False
    found = scores(PROBLEM.scale, data=DATA._replace(counted=counted))
    np.testing.assert_allclose(found, by_hand([0, 1, 2], counted), rtol=1e-9)
    assert np.isnan(log_scores_of(FILTER, ESTIMATES, DATA._replace(states=None), None)).all()
