"""Baselines: what was given, the rule of thumb, the scaled default, noise estimation and the oracle."""

import json
import re

import numpy as np
import pytest

from filters import make_filter, run
from filters.consistency.nees import Interval
from tests import altitude_problem
from tests.linear_problem import LinearProblem
from tests.models import wide_model
from tests.small_problems import UNITS, pair, thruster
from thruster_env.core.compiled import interpreted
from tuning.evaluation import baselines as rules
from tuning.evaluation.baselines import GIVEN, NOISE, ORACLE, RULE, SCALED, TUNED
from tuning.evaluation.compare import contender
from tuning.evaluation.evaluate import evaluate, score_ratio
from tuning.evaluation.held_out import Comparison, evaluate_held_out, summarised, summary
from tuning.evaluation.residuals import noise_estimation, residuals
from tuning.evaluation.worth import gain, scaling_sentence, tuning_effect, warnings_of
from tuning.experiments import lorenz63
from tuning.experiments.benchmark import noise_free_problem
from tuning.plants.thruster import find_scenario
from tuning.problems.data import held_out_seeds, training_seeds
from tuning.problems.excitation import Steps
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Parameter
from tuning.reporting.choice_words import gains
from tuning.reporting.tuning_report import consistency_sentence
from tuning.search.plan import TRAINING_SEEDS, nis_ratio
from tuning.search.space import oracle_choice, untuned_choice


def test_what_the_model_of_a_user_came_with_is_a_baseline_and_comes_first():
    own = wide_model(**UNITS).replace(process_noise_cov=[0.5, 0.5, 0.5])
    problem = pair(assumed=own)
    assert problem.given["process_noise_cov"] == (0.5, 0.5, 0.5)
    found = rules.baselines("kf", problem)
    assert list(found) == [GIVEN, SCALED, RULE, NOISE, ORACLE]
    np.testing.assert_array_equal(found[GIVEN].filter(problem).model.process_noise_cov, np.diag([0.5] * 3))
    comparison = evaluate_held_out(rules.rule_of_thumb("kf", problem), problem, 0, 20)
    assert list(comparison.evaluations) == [GIVEN, RULE, SCALED, NOISE, TUNED, ORACLE]
    assert list(comparison.ratios)[0] == GIVEN and comparison.ratios[RULE] == (1.0, 1.0, 1.0)
    assert " against the given filter" in tuning_effect(comparison).partition(" and ")[0]
    assert " times that of the given filter, " in gains(comparison, "seeds")[0]


def test_a_model_with_the_noise_of_its_plant_is_given_and_the_oracle_and_competes_with_no_trial():
    problem = pair()
    assert rules.given_noise("kf", problem) == rules.oracle("kf", problem) == rules.baselines("kf", problem)[GIVEN]
    assert list(rules.competing_baselines("kf", problem)) == [SCALED, RULE, NOISE]
    comparison = evaluate_held_out(rules.rule_of_thumb("kf", problem), problem, 0, 4)
    assert list(comparison.evaluations) == [GIVEN, RULE, SCALED, NOISE, TUNED, ORACLE]
    assert list(comparison.ratios)[-2:] == [GIVEN, ORACLE] and "given" not in tuning_effect(comparison)
    assert gains(comparison, "seeds")[-1].startswith("The given Q and R are the plant's own")
    assert contender("kf", "given").choose(problem) == rules.oracle("kf", problem)
    assert thruster().given is None


def test_the_default_of_the_user_s_function_is_the_rule_of_thumb_and_given():
    problem = altitude_problem.problem()
    assert problem.untuned == problem.given == altitude_problem.GIVEN
    assert list(rules.baselines("ekf", problem)) == [GIVEN, SCALED, NOISE, ORACLE]
    comparison = evaluate_held_out(rules.given_noise("ekf", problem), problem, 0, 4)
    assert list(comparison.evaluations) == [GIVEN, SCALED, NOISE, TUNED, ORACLE]


def test_own_numbers_are_nearest_to_noise_estimation_from_any_start():
    true, far = altitude_problem.model(**altitude_problem.TRUE), {"sigma_a": 1e2, "sigma_b": 1e-6, "r_range": 1e4}
    for start in ({}, far):  # Q is singular: of two noises for three states
        problem = altitude_problem.problem(untuned=start)
        found = rules.nearest(problem, true.process_noise_cov, true.measurement_noise_cov)
        assert found == pytest.approx(altitude_problem.TRUE, rel=1e-3)
    found = rules.noise_estimated("ekf", altitude_problem.problem()).model
    assert found == pytest.approx(altitude_problem.TRUE, rel=0.05)
    full = rules.full_noise("ekf", altitude_problem.problem()).model
    assert full.keys() - found.keys() == {"process_noise_cov", "measurement_noise_cov"}


def test_own_numbers_are_within_their_ranges_always():
    names = "sigma_a", "sigma_b", "r_baro", "r_range"
    far = altitude_problem.problem(parameters=[Parameter(name, 10.0, 20.0) for name in names])
    assert far.untuned == altitude_problem.GIVEN and [one.low for one in far.parameters] == [1.0, 0.01, 0.2, 3e-4]
    told = altitude_problem.problem(untuned={"sigma_a": 500.0})
    assert told.given["sigma_a"] == 500.0 == told.parameters[0].high
    free, assumed = [Parameter("x", 0.1, 10.0)], (lambda x: altitude_problem.model(sigma_a=x))
    none = altitude_problem.problem(parameters=free, assumed=assumed)
    assert none.given is None and none.untuned == {"x": pytest.approx(1.0)} and rules.rule_label(none) == RULE


def test_noise_estimation_finds_the_noise_of_a_simulation_and_what_a_model_lacks_in_the_mean():
    problem = LinearProblem()
    q, r = (rules.noise_estimated("kf", problem).model[f"{name}_noise_cov"] for name in ("process", "measurement"))
    np.testing.assert_allclose(q, 0.02 * np.eye(3), atol=0.003)
    np.testing.assert_allclose(r, 0.1 * np.eye(2), atol=0.015)
    biased = thruster(parameter_factors={"voltage_gain": 0.5})
    assert abs(noise_estimation(biased).measurement_mean[0]) < 0.1
    assert rules.noise_estimated("open-loop", problem) is None
    assert noise_estimation(LinearProblem(truth=False)).reason == "there is no truth"


def test_a_headline_warns_of_a_nees_that_is_more_than_a_factor_of_three_off():
    problem = LinearProblem(2, 2, scale=(0.3, np.inf))
    data = problem.data(range(8))
    noise = {"process_noise_cov": (2e-4, 2e-4), "measurement_noise_cov": (1e-3, 1e-3)}
    with interpreted():
        filters = [make_filter("kf", problem.model(**one)) for one in ({}, noise)]
        good, bad = (evaluate(one, data, problem.scale) for one in filters)
        found = run(filters[1], data.filter_keys, data.inputs, data.measurements)
    errors, variances = (found.means - data.states)[:, 10:], np.einsum("btii->bti", found.covs)[:, 10:]
    np.testing.assert_allclose(bad.state_nees, (errors**2 / variances).mean((0, 1)), rtol=1e-12)
    assert warnings_of(good, problem) == [] and list(bad.scored_nees) == ["p [m]"]
    (said,) = warnings_of(bad, problem)
    assert said.startswith("Do not rely on the covariance, it is too small for p [m] (mean NEES ")
    assert " where 1 is right) and too small jointly (" in said and said.endswith(" where 2 is right).")
    singular = bad._replace(nees=Interval(219381.0, 0.0, 0.0), state_nees=np.array([1.2, 0.9]))
    assert warnings_of(singular, problem) == [
        "Do not rely on the covariance, it is too small jointly (219381 where 2 is right): each variance is about "
        "right, but P is nearly singular, or its correlations are wrong."
    ]
    mixed = bad._replace(nees=Interval(4.9, 4.7, 5.1), state_nees=np.array([0.2, 0.9]))
    assert warnings_of(mixed, problem) == [
        "Do not rely on the covariance, it is too large for p [m] (mean NEES 0.2 where 1 is right) and too small "
        "jointly (4.9 where 2 is right): its correlations are wrong, too."
    ]
    wide = bad._replace(nees=Interval(2.0, 1.8, 2.2), state_nees=np.array([0.2, 3.5]), scale=np.ones(2))
    (said,) = warnings_of(wide, problem)
    assert "(mean NEES 3.5 where 1 is right) and too large for p [m] (mean NEES 0.2 where 1 is right)." in said
    comparison = Comparison(wide, wide, None, np.ones(2), range(8))
    assert consistency_sentence(comparison).startswith("Consistent jointly, but not in each state: mean NEES 2 [")
    again = summarised(json.loads(json.dumps(summary(bad))), problem)
    assert warnings_of(again, problem) == warnings_of(bad, problem)
    old = {name: value for name, value in summary(bad).items() if name != "state_nees"}
    assert "of p" not in warnings_of(summarised(old, problem), problem)[0]


def test_a_score_that_falls_to_a_small_part_is_a_factor_and_no_percentage():
    small = Interval(0.004, 0.003, 0.005)
    assert gain(small, 8) == "lowers the score by a factor of 250 [200, 333]"
    assert gain(Interval(40.0, 30.0, 50.0), 8) == "raises the score by a factor of 40 [30, 50]"
    assert gain(Interval(0.4, 0.3, 0.5), 8) == "lowers the score by 60 % [50, 70]"
    comparison = evaluate_held_out(rules.rule_of_thumb("kf", LinearProblem()), LinearProblem(), 0, 4)
    ratios = dict.fromkeys(comparison.ratios, small)
    said = gains(comparison._replace(stored_ratios=ratios), "seeds")[0]
    assert "Tuning lowers the error by a factor of 250 [200, 333] against the " in said


def test_noise_estimation_gives_no_noise_to_a_model_whose_residuals_are_rounding():
    quiet = noise_free_problem(lorenz63.model(), steps=40, first_scored_step=10, scale=[1.0] * 3)
    assert rules.noise_estimated("ekf", quiet).model["process_noise_cov"] == (0.0, 0.0, 0.0)


def test_residuals_are_those_of_the_model_step_by_step():
    problem = thruster()
    model, data = problem.model(), problem.data([1, 2])
    found = residuals(model, data)
    k, late = 3, data.late.start
    x, u = tuple(data.states[0, late + k]), tuple(data.inputs[0, late + k])
    for _ in range(model.substeps):
        x = model.transition(x, u, model.constants)
    np.testing.assert_allclose(found.process[k], data.states[0, late + k + 1] - x, rtol=1e-9, atol=1e-12)
    seen = model.observe(tuple(data.states[0, late + k]), model.constants)
    np.testing.assert_allclose(found.measurement[k], data.measurements[0, late + k] - seen, rtol=1e-9)


def test_equal_filters_are_known_as_equal_and_a_contender_may_know_the_scaled_default():
    one = rules.rule_of_thumb("kf", LinearProblem())
    assert rules.same_filter(one, rules.rule_of_thumb("kf", LinearProblem()))
    assert not rules.same_filter(one, one._replace(name="ekf"))
    choices = rules.baselines("ekf", MISMATCH, 2)
    assert contender("ekf", "scaled", seed=2).choose(MISMATCH) == choices[SCALED]
    assert rules.scaled(choices[RULE], rules.scaled_default("ekf", MISMATCH, 2).factor) == choices[SCALED]


MISMATCH, OUTLIERS = find_scenario("mismatch"), find_scenario("outliers")


@pytest.mark.parametrize(("name", "scenario"), [("ekf", MISMATCH), ("enkf", MISMATCH), ("ekf", OUTLIERS)])
def test_the_factor_brings_the_mean_nis_of_the_training_runs_to_one_and_leaves_r(name, scenario):
    found, rule = rules.scaled_default(name, scenario, 3), untuned_choice(name, scenario)
    data = scenario.data(training_seeds(3, TRAINING_SEEDS))
    before, after = (evaluate(c.filter(scenario), data, scenario.scale) for c in (rule, found.choice))
    assert nis_ratio(after) == found.nis == pytest.approx(1.0, abs=2e-3)
    assert (found.factor < 1) == (nis_ratio(before) < 1)  # a larger Q lowers the NIS
    q = np.array(found.choice.model["process_noise_cov"])
    np.testing.assert_allclose(q, found.factor * np.array(rule.model["process_noise_cov"]), rtol=1e-15)
    assert found.choice._replace(model=rule.model) == rule
    assert found.choice.model["measurement_noise_cov"] == scenario.measurement_noise_cov


def test_it_depends_on_the_seed_of_the_study_and_on_nothing_else():
    found = [rules.scaled_default.__wrapped__("ekf", MISMATCH, seed).factor for seed in (0, 0, 1)]
    assert found[0] == found[1] != found[2] == pytest.approx(found[0], rel=0.1)


def test_where_there_is_no_scaled_default_it_says_why():
    assert rules.scaled_default("open-loop", MISMATCH) == (
        None, None, None, "open-loop has no NIS by which its Q could be scaled"
    )  # fmt: skip
    startup = find_scenario("startup")
    found = rules.scaled_default("ekf", startup)
    assert found.choice is None
    assert found.reason.startswith("no factor on Q from 0.0001 to 10000 brings the mean NIS of ekf to 1: it is 4.")
    comparison = evaluate_held_out(untuned_choice("ekf", startup), startup, 0, 4)
    assert comparison.scaled is None and list(comparison.evaluations) == [RULE, NOISE, TUNED, ORACLE]
    said = scaling_sentence(comparison)
    assert said.startswith("There is no scaled default, so the rule of thumb comes first: no factor")
    nothing = (
        "makes no significant difference on 4 seeds against the rule of thumb and against the noise estimation"
    )
    assert tuning_effect(comparison) == nothing
    with pytest.raises(ValueError, match="ekf must have a scaled default on startup, but no factor on Q from"):
        contender("ekf", "scaled").filter(startup)


def test_a_baseline_beyond_reason_is_left_out():
    tiny = {"process_noise_cov": (1e-9, 1e-11)}
    loose = ModelProblem(MISMATCH.model(), steps=60, inputs=Steps(12.0), untuned=tiny, scale=[1.0, 1.0])
    found = rules.scaled_default("ekf", loose)
    assert found.choice is None and "from 0.0001 to 10000 brings" in found.reason and "with 10000" in found.reason
    assert SCALED not in rules.baselines("ekf", loose)


def test_a_nis_that_jumps_over_one_has_no_factor_either(monkeypatch):
    import tuning.evaluation.baselines as module

    def jumps(filter_, data, scale, evaluate=module.values_of):
        nis = 2.0 if filter_.model.process_noise_cov[0, 0] > 1.0 else 8.0
        found = evaluate(filter_, data, scale)
        return found._replace(nis=found.nis._replace(value=nis), expected_nis=4.0)  # as of four channels

    monkeypatch.setattr(module, "values_of", jumps)
    reason = rules.scaled_default.__wrapped__("ekf", MISMATCH, 0).reason
    assert re.match(r"no factor on Q brings the mean NIS of ekf to 4: it jumps to [28] with", reason)


def test_a_proof_holds_all_baselines_on_the_same_seeds_and_names_the_one_that_counts_first():
    choice = oracle_choice("ekf", MISMATCH)
    comparison = evaluate_held_out(choice, MISMATCH, 0, 40)
    assert list(comparison.evaluations) == [RULE, SCALED, NOISE, TUNED, ORACLE]
    assert list(comparison.ratios) == [SCALED, RULE, NOISE, ORACLE]
    data = MISMATCH.data(held_out_seeds(0, 40))
    default = evaluate(rules.scaled_default("ekf", MISMATCH, 0).choice.filter(MISMATCH), data, MISMATCH.scale)
    assert comparison.ratios[SCALED] == score_ratio(comparison.tuned, default)
    assert comparison.ratios[ORACLE] == (1.0, 1.0, 1.0)
    assert comparison.ratios[RULE].high < comparison.ratios[SCALED].low  # the rule of thumb is easier to beat
    said = tuning_effect(comparison, "the error")
    assert said.startswith("lowers the error by ") and " against the scaled default, by " in said
    assert " against the rule of thumb and raises the error by " in said and said.endswith("noise estimation")
    assert f"its Q times {comparison.default.factor:.4g}" in scaling_sentence(comparison)
