"""The baselines of a tuned filter: the factor on Q that makes the mean NIS right, and where there is none."""

import re

import numpy as np
import pytest

from tuning.evaluation.baselines import NOISE, ORACLE, RULE, SCALED, TUNED, baselines, scaled, scaled_default
from tuning.evaluation.compare import contender
from tuning.evaluation.evaluate import evaluate, score_ratio
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.worth import scaling_sentence, tuning_effect
from tuning.plants.thruster import find_scenario
from tuning.problems.data import held_out_seeds, training_seeds
from tuning.problems.excitation import Steps
from tuning.problems.model_problem import ModelProblem
from tuning.search.plan import TRAINING_SEEDS, nis_ratio
from tuning.search.space import oracle_choice, untuned_choice

MISMATCH, OUTLIERS = find_scenario("mismatch"), find_scenario("outliers")


@pytest.mark.parametrize(("name", "scenario"), [("ekf", MISMATCH), ("enkf", MISMATCH), ("ekf", OUTLIERS)])
def test_the_factor_brings_the_mean_nis_of_the_training_runs_to_one_and_leaves_r(name, scenario):
    found, rule = scaled_default(name, scenario, 3), untuned_choice(name, scenario)
    data = scenario.data(training_seeds(3, TRAINING_SEEDS))
    before, after = (evaluate(c.filter(scenario), data, scenario.scale) for c in (rule, found.choice))
    assert nis_ratio(after) == found.nis == pytest.approx(1.0, abs=2e-3)
    assert (found.factor < 1) == (nis_ratio(before) < 1)  # a larger Q lowers the NIS
    q = np.array(found.choice.model["process_noise_cov"])
    np.testing.assert_allclose(q, found.factor * np.array(rule.model["process_noise_cov"]), rtol=1e-15)
    assert found.choice._replace(model=rule.model) == rule
    assert found.choice.model["measurement_noise_cov"] == scenario.measurement_noise_cov


def test_it_depends_on_the_seed_of_the_study_and_on_nothing_else():
    found = [scaled_default.__wrapped__("ekf", MISMATCH, seed).factor for seed in (0, 0, 1)]
    assert found[0] == found[1] != found[2] == pytest.approx(found[0], rel=0.1)


def test_where_there_is_no_scaled_default_it_says_why():
    assert scaled_default("open-loop", MISMATCH) == (
        None, None, None, "open-loop has no NIS by which its Q could be scaled"
    )  # fmt: skip
    startup = find_scenario("startup")
    found = scaled_default("ekf", startup)
    assert found.choice is None and found.reason.startswith(
        "no factor on Q from 0.0001 to 10000 brings the mean NIS of ekf to 1: it is 4."
    )
    comparison = evaluate_held_out(untuned_choice("ekf", startup), startup, 0, 4)
    assert comparison.scaled is None and list(comparison.evaluations) == [RULE, NOISE, TUNED, ORACLE]
    assert scaling_sentence(comparison).startswith(
        "There is no scaled default, so the rule of thumb comes first: no factor"
    )
    assert tuning_effect(comparison) == (
        "makes no significant difference on 4 seeds against the rule of thumb and against the noise estimation"
    )
    with pytest.raises(ValueError, match="ekf must have a scaled default on startup, but no factor on Q from"):
        contender("ekf", "scaled").filter(startup)


def test_a_baseline_beyond_reason_is_left_out():
    tiny = {"process_noise_cov": (1e-9, 1e-11)}
    loose = ModelProblem(MISMATCH.model(), steps=60, inputs=Steps(12.0), untuned=tiny, scale=[1.0, 1.0])
    found = scaled_default("ekf", loose)
    assert found.choice is None and "from 0.0001 to 10000 brings" in found.reason and "with 10000" in found.reason
    assert SCALED not in baselines("ekf", loose)


def test_a_nis_that_jumps_over_one_has_no_factor_either(monkeypatch):
    import tuning.evaluation.baselines as module

    def jumps(filter_, data, scale, evaluate=module.values_of):
        nis = 2.0 if filter_.model.process_noise_cov[0, 0] > 1.0 else 8.0
        found = evaluate(filter_, data, scale)
        return found._replace(nis=found.nis._replace(value=nis), expected_nis=4.0)  # as of four channels

    monkeypatch.setattr(module, "values_of", jumps)
    reason = scaled_default.__wrapped__("ekf", MISMATCH, 0).reason
    assert re.match(r"no factor on Q brings the mean NIS of ekf to 4: it jumps to [28] with", reason)


def test_a_proof_holds_all_baselines_on_the_same_seeds_and_names_the_one_that_counts_first():
    choice = oracle_choice("ekf", MISMATCH)
    comparison = evaluate_held_out(choice, MISMATCH, 0, 40)
    assert list(comparison.evaluations) == [RULE, SCALED, NOISE, TUNED, ORACLE]
    assert list(comparison.ratios) == [SCALED, RULE, NOISE, ORACLE]
    data = MISMATCH.data(held_out_seeds(0, 40))
    default = evaluate(scaled_default("ekf", MISMATCH, 0).choice.filter(MISMATCH), data, MISMATCH.scale)
    assert comparison.ratios[SCALED] == score_ratio(comparison.tuned, default) and comparison.ratios[ORACLE] == (
        1.0,
        1.0,
        1.0,
    )
    assert (
        comparison.ratios[RULE].high < comparison.ratios[SCALED].low
    )  # the rule of thumb is the easier one to beat
    said = tuning_effect(comparison, "the error")
    assert said.startswith("lowers the error by ") and " against the scaled default, by " in said
    assert " against the rule of thumb and raises the error by " in said and said.endswith("noise estimation")
    assert f"its Q times {comparison.default.factor:.4g}" in scaling_sentence(comparison)


def test_a_filter_of_a_comparison_may_know_the_scaled_default():
    choices = baselines("ekf", MISMATCH, 2)
    assert contender("ekf", "scaled", seed=2).choose(MISMATCH) == choices[SCALED]
    assert scaled(choices[RULE], scaled_default("ekf", MISMATCH, 2).factor) == choices[SCALED]
