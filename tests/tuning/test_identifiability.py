"""What the innovations determine: intervals that hold, and an honest "no" where they tell nothing."""

import numpy as np
import pytest
from rich.console import Console

from filters import KalmanFilter, affine_model, run
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate
from tuning.api.tune import run_tuning
from tuning.likelihood import identifiability
from tuning.likelihood.gradient import tune_by_gradient
from tuning.likelihood.identifiability import (
    Identifiability,
    as_data,
    covariance,
    curvatures,
    identify,
    is_identified,
    maximum,
    sentences,
    too_many,
)
from tuning.plants.thruster import find_scenario
from tuning.reporting.tuning_report import as_json, report
from tuning.search.plan import Plan
from tuning.search.space import choice_of, oracle_choice, parameters_of, untuned_choice

BOUNDS = np.log([(1e-4, 1e4)] * 3)
TRUE = np.log([0.3, 0.2, 0.5])  # Q11, Q22, R


def likelihood_of(c, seed=0, count=24, steps=100):
    """Log-likelihoods of runs of a linear plant measured by `c`, as a function of log Q11, Q22, R."""

    def model(logarithms):
        q11, q22, r = np.exp(logarithms)
        noise = {"Q": [[q11, 0.0], [0.0, q22]], "R": r * np.eye(len(c)), "P0": [1.0, 1.0]}
        return affine_model(A=[[0.9, 0.0], [0.0, 0.6]], B=[[0.5], [1.0]], C=c, **noise)

    keys = episode_keys(range(seed, seed + count))
    inputs = np.random.default_rng(seed).normal(size=(count, steps, 1))
    measurements = simulate.simulate(model(TRUE), keys, inputs).measurements

    def log_likelihoods(logarithms):
        filter_ = KalmanFilter(model=model(logarithms))
        return run(filter_, keys, inputs, measurements).log_likelihoods.sum(axis=1)

    return log_likelihoods


def known(log_likelihoods, starts=(TRUE,)):
    at = maximum(log_likelihoods, starts, BOUNDS)
    cov = covariance(curvatures(log_likelihoods, at))
    return at, np.sqrt(np.diag(cov)), is_identified(log_likelihoods, at, cov, BOUNDS)


def test_standard_errors_on_a_linear_plant_are_the_size_of_the_errors():
    ratios = []
    for seed in range(0, 8000, 1000):
        at, errors, identified = known(likelihood_of(np.eye(2), seed))
        assert identified.all()
        ratios.append((at - TRUE) / errors)
    size = np.sqrt(np.mean(np.square(ratios), axis=0))  # of 8 errors: within these with 99.9 % probability
    assert (size > 0.3).all() and (size < 1.85).all()


def test_a_state_that_nothing_measures_keeps_its_variance_and_noise_is_no_information():
    log_likelihoods = likelihood_of([[0.0, 1.0]])
    at, errors, identified = known(log_likelihoods, [TRUE, TRUE + 1.0])
    assert identified.tolist() == [False, True, True]
    assert errors[0] == pytest.approx(np.log(10.0), rel=1e-3)  # no more than what is known before
    assert (abs(at - TRUE)[1:] < 3 * errors[1:]).all()
    chance = np.random.default_rng(0)
    cov = covariance(curvatures(lambda logarithms: chance.normal(size=40), np.zeros(2)))
    assert (np.sqrt(np.diag(cov)) > 0.3).all()


def test_two_variances_of_which_only_the_sum_shows_make_up_for_one_another():
    def log_likelihoods(logarithms):
        variance = np.exp(logarithms).sum()
        squares = np.random.default_rng(0).chisquare(200, size=40) * 2.0
        return -0.5 * (200 * np.log(variance) + squares / variance)

    start, bounds = np.zeros(2), np.log([(1e-3, 1e3)] * 2)
    at = maximum(log_likelihoods, [start], bounds)
    assert np.exp(at).sum() == pytest.approx(2.0, rel=0.1)
    cov = covariance(curvatures(log_likelihoods, at))
    assert not is_identified(log_likelihoods, at, cov, bounds).any()
    found = Identifiability(("a", "b"), np.ones(2), np.exp(at), cov, np.zeros(2, bool))
    assert min(found.least_determined.values()) < 1 and max(found.least_determined.values()) == pytest.approx(10.0)
    assert "do not determine a and b" in sentences(found)[1] and " x 10 and " in sentences(found)[1]


def test_a_number_without_a_limit_below_is_not_determined_though_the_likelihood_bends():
    def log_likelihoods(logarithms):  # any small number does: there is a plateau below
        return np.full(30, -0.004) * np.exp(2 * logarithms[0]) + 0.001 * np.arange(30)

    at, bounds = np.zeros(1), np.log([(1e-3, 1e3)])
    cov = covariance(curvatures(log_likelihoods, at))
    assert np.exp(1.96 * np.sqrt(cov[0, 0])) < 100
    assert not is_identified(log_likelihoods, at, np.array([[0.25]]), bounds).any()


def test_an_ekf_has_the_intervals_of_the_gradient_method_from_a_bad_choice():
    scenario = find_scenario("nominal")
    plan = Plan("ekf", (scenario,))
    data = plan.training_data()
    own = parameters_of(oracle_choice("ekf", scenario))
    bad = choice_of("ekf", {**own, "Q22": own["Q22"] / 100, "R": own["R"] * 100}, scenario)
    found = identify(bad, plan.scenarios, data, plan.space())
    right = tune_by_gradient("ekf", scenario, data[0], starts=[(1.0, 1.0, 1.0)])
    assert found.names == right.names == ("Q11", "Q22", "R") and found.identified.all()
    errors = np.log(found.factors) / 1.96
    assert (abs(np.log(found.most_likely / right.best.parameters)) < 0.5 * errors).all()
    np.testing.assert_allclose(errors, right.standard_errors, rtol=0.6)
    assert found.tuned.tolist() == [bad.model["process_noise_cov"][0], own["Q22"] / 100, own["R"] * 100]
    assert all(number["determined"] for number in as_data(found).values())
    said = sentences(found)[0]
    assert said.startswith("The innovations of the training runs determine Q11 within a factor of 1.")


def test_the_published_tunnel_tells_nothing_of_its_small_r():
    scenario = find_scenario("published_tunnel")
    plan = Plan("kf", (scenario,))
    found = identify(oracle_choice("kf", scenario), plan.scenarios, plan.training_data(), plan.space())
    assert found.identified.tolist() == [False, True, False]
    assert "do not determine Q11 and R" in sentences(found)[1]


@pytest.mark.parametrize(("name", "kind"), [("nominal", "ekf"), ("published_tunnel", "kf")])
def test_fishers_information_gives_the_judgement_of_differences(name, kind, monkeypatch):
    scenario = find_scenario(name)
    plan = Plan(kind, (scenario,))
    given = oracle_choice(kind, scenario), plan.scenarios, plan.training_data(), plan.space()
    differences = identify(*given)
    monkeypatch.setattr(identifiability, "LEAST_NUMBERS", 0)
    information = identify(*given)
    assert information.identified.tolist() == differences.identified.tolist()
    widths = [np.log(found.factors) for found in (information, differences)]
    np.testing.assert_allclose(widths[0][differences.identified], widths[1][differences.identified], rtol=0.3)


def test_numbers_that_are_held_are_not_told_and_baselines_have_none():
    scenario = find_scenario("nominal")
    plan = Plan("ekf", (scenario,), hold_r=True)
    data = [one.slice(0, 4) for one in plan.training_data()]
    assert identify(untuned_choice("ekf", scenario), plan.scenarios, data, plan.space()).names == ("Q11", "Q22")
    plan = Plan("low-pass", (scenario,))
    assert identify(untuned_choice("low-pass", scenario), plan.scenarios, data, plan.space()) is None


def test_thruster_tune_says_what_the_innovations_determine(tmp_path):
    plan = Plan("ekf", (find_scenario("nominal"),))
    tuning = run_tuning(plan, 3, Console(quiet=True), str(tmp_path / "j"), out=tmp_path / "tuned.json")
    assert sentences(tuning.known)[0] in report(tuning)
    assert set(as_data(tuning.known)) == set(as_json(tuning)["innovations_alone"]) == {"Q11", "Q22", "R"}


def test_a_number_that_is_hardly_known_goes_along_no_further_than_ten_times_its_range():
    asked, bounds = [], np.log([(1e-3, 1e3), (1e-3, 1e3)])
    cov = np.array([[1e-4, 1e-2 * 2.0 * 0.9], [1e-2 * 2.0 * 0.9, 4.0]])  # the second would move by e^414

    def log_likelihoods(at):
        asked.append(at)
        return np.array([-at @ np.linalg.solve(cov, at)])

    known = is_identified(log_likelihoods, np.zeros(2), cov, bounds)
    assert known.tolist() == [True, False]
    assert np.abs(asked).max() <= np.log(1e4) + 1e-12


def test_of_more_numbers_than_can_be_paired_off_it_says_so():
    nominal = find_scenario("nominal")
    choice, plan = oracle_choice("ekf", nominal), Plan("ekf", (nominal,))
    assert too_many(choice, plan.space()) == [] and identifiability.MOST_NUMBERS > len(plan.space())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(identifiability, "MOST_NUMBERS", 2)
        assert identify(choice, plan.scenarios, [], plan.space()) is None
        (said,) = too_many(choice, plan.space())
        assert "at most 2 parameters" in said and "here are 3" in said
        assert too_many(oracle_choice("open-loop", nominal), plan.space()) == []
