"""The choice at the end: the best trials meet the baselines on seeds of their own, and may give way."""

import dataclasses
import json

import numpy as np
import optuna
import pytest
from optuna.distributions import FloatDistribution, IntDistribution

import tuning
from filters import make_filter
from filters.consistency.nees import Interval
from filters.tuned_file import read_tuned_file
from tests import altitude_problem
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tests.small_problems import pair, thruster
from tests.tuning.test_log_problem import MODEL, logs_of
from tuning.api.study import user_choice
from tuning.evaluation import baselines as rules
from tuning.evaluation.baselines import FULL_Q, GIVEN, NOISE, ORACLE, RULE, SCALED
from tuning.evaluation.tuned import read_tuned
from tuning.problems.excitation import Steps
from tuning.problems.log_problem import LogProblem
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Parameter
from tuning.reporting.choice_words import apart, choice_sentences
from tuning.search import validation
from tuning.search.among_types import BASELINE, MAXIMUM_LIKELIHOOD, is_local
from tuning.search.measures import Measured, measured, over
from tuning.search.parameters import FACTORS, model_parameters
from tuning.search.plan import (
    HELD_OUT_SEEDS,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    Plan,
    at_ends,
    range_warning,
    range_words,
)
from tuning.search.space import untuned_choice
from tuning.search.study import StudyResult, answered_by, finalists_of, open_study, run_study
from tuning.search.trials import near
from tuning.search.validation import Failure, Met, Validation


@pytest.fixture(scope="module")
def altitude(tmp_path_factory):
    """The altitude problem, tuned, and its tuned file."""
    problem = altitude_problem.problem()
    study = tuning.tune(problem, "ekf", trials=30, progress=False)
    return problem, study, study.save(tmp_path_factory.mktemp("tuned") / "altitude.json")


@pytest.mark.slow
def test_four_numbers_of_an_altitude_model_are_no_worse_than_any_baseline_and_twice_as_good_as_given(altitude):
    _, study, _ = altitude
    ratios = study.held_out.ratios
    assert all(ratio.low <= 1.0 for name, ratio in ratios.items() if name != ORACLE), ratios
    assert ratios[GIVEN].high < 0.75 and ratios[ORACLE].value < 1.02
    found = {trial.user_attrs.get(BASELINE) for trial in study.trials}
    assert any(MAXIMUM_LIKELIHOOD in trial.user_attrs for trial in study.trials) and ORACLE not in found


@pytest.mark.slow
def test_a_tuned_file_keeps_the_choice_as_data_and_own_numbers(altitude):
    problem, study, file = altitude
    met, content = study.result.validation, read_tuned_file(file)
    assert content["choice"] == json.loads(json.dumps(validation.as_data(met)))
    assert set(content["choice"]["met"][0]) >= {"name", "value", "over", "proper", "nis", "consistent"}
    assert content["held_out"][problem.name]["given"]["score"] == list(study.held_out.evaluations[GIVEN].score)
    assert set(study.choice.model) == set(altitude_problem.TRUE)
    again = read_tuned(file, [problem])[0].filter(problem).model
    np.testing.assert_allclose(again.process_noise_cov, study.filter.model.process_noise_cov, rtol=1e-9)
    np.testing.assert_allclose(again.measurement_noise_cov, study.filter.model.measurement_noise_cov, rtol=1e-9)
    kept = content["choice"]["met"][-1]["choice"]
    assert validation.choice_from(kept) == validation.choice_from(
        json.loads(json.dumps(met.met[-1].choice._asdict()))
    )


def test_validation_seeds_are_neither_training_nor_held_out_nor_those_of_sizes():
    problem, some = thruster(), []
    for seed in (0, 1, 3):
        some += [problem.training_seeds(seed, TRAINING_SEEDS), problem.held_out_seeds(seed, HELD_OUT_SEEDS)]
        some += [problem.size_seeds(seed, 100), problem.validation_seeds(seed, VALIDATION_SEEDS)]
    assert sum(map(len, some)) == len(set().union(*some))


def test_all_baselines_but_the_oracle_are_trials_and_so_is_the_likeliest_noise():
    plan = Plan("kf", (LinearProblem(),))
    result = run_study(open_study("baselines", plan), plan, 8)
    names = [trial.user_attrs.get(BASELINE) for trial in result.trials]
    assert {SCALED, NOISE} <= set(names) and ORACLE not in names and result.trials[0].number == 0
    assert sum(MAXIMUM_LIKELIHOOD in trial.user_attrs for trial in result.trials) == 1
    assert set(result.validation.met[0].choice.model) == set(untuned_choice("kf", plan.scenarios[0]).model)


def _met(name, value, low, high, consistent=True, proper=0.0):
    choice, over_baseline = untuned_choice("kf", LinearProblem()), Interval(value, low, high)
    return Met(name, choice, value, over_baseline, proper, 1.0, consistent)


def test_what_is_not_significantly_better_gives_way_unless_it_is_equal_and_alone_consistent():
    plan = Plan("kf", (LinearProblem(),))
    assert validation._wins(_met("trial 1", 0.9, 0.8, 0.99), _met(RULE, 1.0, 1.0, 1.0), plan, True)
    assert not validation._wins(_met("trial 1", 0.9, 0.8, 1.01), _met(RULE, 1.0, 1.0, 1.0), plan, True)
    even, wrong = _met("trial 1", 1.00001, 0.99998, 1.00004), _met(RULE, 1.0, 1.0, 1.0, consistent=False)
    assert validation._wins(even, wrong, plan, True) and not validation._wins(
        even, _met(RULE, 1.0, 1.0, 1.0), plan, True
    )
    assert not validation._wins(_met("trial 1", 1.00001, 0.999, 1.001), wrong, plan, True)
    assert not validation._wins(_met("trial 1", 1.00001, 0.99998, 1.00004, consistent=False), wrong, plan, True)
    assert not validation._wins(even, wrong, plan._replace(consistent=False), True)
    assert validation._wins(_met("trial 1", -5.0, -9.0, -1.0), _met(RULE, 0.0, 0.0, 0.0), plan, False)


def test_consistency_is_wanted_up_to_five_per_cent_and_then_the_proper_score_decides():
    plan, none = Plan("kf", (LinearProblem(),)), (np.ones(3),)
    good, costly = Measured(1.0, none, -3.0, (2.0,)), Measured(2.74, none, -9.0, (1.0,))
    close, fair = Measured(1.04, none, -1.0, (1.5,)), Measured(1.04, none, -9.0, (1.0,))
    assert validation._best_of(plan, {"a": good, "b": fair}, True) == ("b", pytest.approx(0.04))
    assert validation._best_of(plan, {"a": good, "b": costly, "c": close}, True) == ("c", pytest.approx(1.74))
    assert validation._best_of(plan._replace(consistent=False), {"a": good, "b": fair}, True) == ("a", None)
    assert validation._best_of(plan, {"a": good}, True) == ("a", None) and validation._best_of(plan, {}, True) == (
        None,
        None,
    )


def _with_truth(value, proper, nees=1.0, scatter=0.001):
    """A filter on 50 runs whose objective and log score scatter by so much when a run is left out."""
    apart = scatter * np.random.default_rng(0).standard_normal(50)
    return Measured(value, (value * (1 + apart),), proper, (1.0,), (proper + apart,), nees, nees)


def test_of_filters_within_five_per_cent_the_best_log_score_wins_and_none_is_worse_than_the_best_baseline():
    plan = Plan("kf", (LinearProblem(),))
    singular, right = _with_truth(0.956, -1e5, 5e4), _with_truth(1.0, -3.0, 9.4)
    assert validation._by_log_score({"trial 1": singular, GIVEN: right}, "trial 1", GIVEN) == GIVEN
    better, slower = _with_truth(0.94, -1e5, 5e4), _with_truth(1.004, -2.0, scatter=0.0)
    assert (
        validation._by_log_score({"trial 1": better, GIVEN: right}, "trial 1", GIVEN) == "trial 1"
    )  # 6.4 % is too much
    assert (
        validation._by_log_score({GIVEN: right, NOISE: slower}, GIVEN, GIVEN) == NOISE
    )  # 0.4 % is practically nothing
    worse = _with_truth(1.03, -2.0, scatter=0.0)
    assert validation._by_log_score({GIVEN: right, NOISE: worse}, GIVEN, GIVEN) == GIVEN
    apart = (-3.01 + 0.02 * np.random.default_rng(1).standard_normal(50),)
    unsure, close = _with_truth(0.99, -3.01)._replace(log_scores=apart), _with_truth(1.0, -3.0)
    assert validation._by_log_score({"trial 1": unsure, GIVEN: close}, "trial 1", GIVEN) == "trial 1"
    wrong = unsure._replace(state_nees=0.2)
    assert validation._by_log_score({"trial 1": wrong, GIVEN: close}, "trial 1", GIVEN) == GIVEN
    trials = {"a": singular, "b": _with_truth(0.96, -4.0), "c": _with_truth(1.2, -1.0)}
    assert (
        validation._best_of(plan, trials, True, right)[0] == "b"
        and validation._best_of(plan, trials, True, right)[1] == 0.0
    )
    # Of trials that are better than the best baseline: "d" has the best log score, but does not differ from it.
    assert validation._best_of(plan, {**trials, "d": _with_truth(1.0, -2.0)}, True, right)[0] == "b"


def test_a_rescaled_trial_has_the_estimates_of_the_trial_and_the_right_nees():
    plan, data = Plan("kf", (LinearProblem(),)), [LinearProblem().data(range(20))]
    noise = {"process_noise_cov": (2e-5,) * 3, "measurement_noise_cov": (1e-4,) * 2}
    trial = untuned_choice("kf", LinearProblem())._replace(model=noise)
    found = validation._rescaled({"trial 1": trial}, plan, data)
    before, after = (measured(one, plan, data) for one in (trial, found["trial 1 rescaled"]))
    assert before.nees > 100.0 and after.nees == pytest.approx(1.0, rel=0.1)
    assert after.value == pytest.approx(before.value, rel=0.02) and after.proper > before.proper + 100.0
    assert validation._rescaled({"trial 1": trial}, plan._replace(hold_r=True), data) == {}


def test_trials_are_rescaled_and_validated_with_the_size_that_they_end_with_and_so_are_baselines(monkeypatch):
    problem, size = LinearProblem(2, 1, steps=30), 60
    plan, data = Plan("enkf", (problem,)), [problem.data(range(16))]
    values = {"Q11": 1e-3, "Q22": 1e-3, "R": 1e-2, "N": 6, "inflation": 1.2, "relaxation": 0.0}
    given = [{**values, "N": 6 + i} for i in range(2)]
    trials = [
        optuna.trial.create_trial(values=[1.0 + i], params=given[i], distributions=plan.space()) for i in (0, 1)
    ]
    asked = []
    finalists = finalists_of(plan, trials, lambda one, _: asked.append(one) or one.with_size(size))
    assert {one.numbers["ensemble_size"] for one in finalists.values()} == {size} and len(asked) == 1
    first, rescaled = next(iter(finalists.values())), validation._rescaled(finalists, plan, data)
    assert measured(next(iter(rescaled.values())), plan, data).nees == pytest.approx(1.0, rel=0.3)
    assert measured(first, plan, data).nees > 3.0
    found = validation._baselines_of(plan, first, data)
    assert {one.numbers["ensemble_size"] for one in found.values()} == {size}
    of_size = rules.scaled_default("enkf", problem, 0, size).choice
    assert found[SCALED] == of_size != rules.scaled_default("enkf", problem).choice
    assert (rules.baseline_size(first), rules.baseline_size(first.with_size(6))) == (size, 30)
    monkeypatch.setattr(validation, "cost_of", lambda one, *_: one.numbers["ensemble_size"])
    for budget, member in ((60.0, 60), (59.0, 30)):
        dear = validation._baselines_of(plan._replace(budget=budget), first, data)
        assert dear.keys() == found.keys() and {one.numbers["ensemble_size"] for one in dear.values()} == {member}
    assert validation._baselines_of(plan._replace(budget=29.0), first, data) == {}
    assert rules.baseline_size(untuned_choice("kf", problem)) is None


def test_the_answer_of_a_gradient_gives_way_to_a_baseline_as_trials_do(monkeypatch):
    problem = LinearProblem(2, 1, steps=30)
    plan, result = Plan("kf", (problem,)), StudyResult(untuned_choice("kf", problem), 1.0, [], [], 0.0, False)
    bad = rules.scaled(rules.oracle("kf", problem), 1e4)
    found = answered_by(result, plan, "optimum of the likelihood", bad)
    met = found.validation
    assert met.gave_way and found.choice == met.named(met.baseline).choice != bad
    (said, *_) = choice_sentences(validation.as_data(met), plan)
    assert said.startswith("The study returns the noise estimation: on 100 validation seeds the optimum of the ")
    assert "is not significantly better (its score is " in said
    assert found.best_value < measured(bad, plan, plan.training_data()).value
    monkeypatch.setattr(validation, "competing_baselines", lambda *_: {GIVEN: bad})
    found = answered_by(result, plan, "optimum of the likelihood", rules.oracle("kf", problem))
    assert found.choice == rules.oracle("kf", problem) and found.validation.chosen == "optimum of the likelihood"
    assert [one.name for one in found.validation.met] == [GIVEN, "optimum of the likelihood"]  # none is rescaled


def test_a_paired_ratio_has_the_interval_of_the_jackknife_and_covers_as_it_says():
    generator, covered = np.random.default_rng(0), 0
    for _ in range(400):
        a, b = generator.exponential(size=(2, 30)) + generator.exponential(size=30)
        found = [Measured(x.mean(), ((x.sum() - x) / 29,), 0.0, (1.0,)) for x in (a, b)]
        ratio = over(*found, ratio=True)
        assert ratio.value == pytest.approx(a.mean() / b.mean())
        covered += ratio.low <= 1.0 <= ratio.high
    assert 361 <= covered <= 397  # 380 expected; level 1e-4
    assert over(found[0], found[0], ratio=True) == (1.0, 1.0, 1.0)


def test_an_objective_without_a_run_is_that_of_the_other_runs():
    problem = LinearProblem()
    plan, choice = Plan("kf", (problem,)), untuned_choice("kf", problem)
    data = problem.data(range(6))
    whole, without = (measured(choice, plan, [data.slice(0, count)]) for count in (6, 5))
    assert whole.left_out[0][5] == pytest.approx(without.value, rel=1e-12)
    likely = Plan("kf", (problem,), objectives=("likelihood",))
    one, rest = (measured(choice, likely, [data.slice(0, count)]) for count in (6, 5))
    assert one.left_out[0][5] == pytest.approx(rest.value, rel=1e-12) and np.isfinite(one.proper)


def test_no_trial_no_meeting_and_none_for_objectives_that_runs_have_not_each():
    plan = Plan("kf", (LinearProblem(),), objectives=("nis",))
    result = run_study(open_study("nis", plan), plan, 2)
    assert result.validation is None and validation.validate(plan, {}, plan.training_data()) is None


def test_a_choice_outside_the_nis_band_is_in_the_headline_whatever_chose_it():
    plan, baseline = Plan("kf", (LinearProblem(),)), _met(GIVEN, 1.0, 1.0, 1.0, True)
    rescaled = _met("trial 3 rescaled", 0.5, 0.4, 0.6, False)._replace(nis=0.09)
    met = Validation((7, 8), True, (baseline, rescaled), GIVEN, "trial 3 rescaled", "trial 3 rescaled", 0.0)
    _, said = choice_sentences(validation.as_data(met), plan)
    assert said == (
        "On 2 validation seeds the mean NIS of trial 3 rescaled is 0.18, outside its band, 1.6 to 2.5, where 2 is "
        "right: do not rely on its innovation covariance."
    )
    inside = met._replace(met=(baseline, rescaled._replace(consistent=True)))
    assert len(choice_sentences(validation.as_data(inside), plan)) == 1
    assert len(choice_sentences(validation.as_data(met), plan._replace(consistent=False))) == 1


def of_one_number(q=1.0):
    """A model whose Q is q times the unit matrix."""
    return pair().model(process_noise_cov=[q] * 3)


@pytest.mark.parametrize("full", (False, True))
def test_candidates_stay_within_own_parameters_and_a_full_q_is_an_option_that_the_report_prices(full):
    truth, given = pair().model(process_noise_cov=[0.003, 0.2, 12.0]), {"steps": 60, "scale": (0.5, np.inf, 1.0)}
    parameters = [Parameter("q", 1e-6, 1e6)]
    problem = ModelProblem(truth, of_one_number, Steps((1.0, 2.0), hold=5), parameters=parameters, **given)
    plan = Plan("kf", (problem,), full_q=full)
    result = run_study(open_study("own", plan), plan, 4)
    met, said = result.validation, " ".join(choice_sentences(validation.as_data(result.validation), plan))
    if full:
        assert met.chosen == FULL_Q and len(result.choice.model["process_noise_cov"]) == 3 and met.full is None
        assert said.startswith("The study returns the noise estimation with a full Q")
    else:
        assert all(set(one.choice.model) == {"q"} for one in met.met) and set(result.choice.model) == {"q"}
        tried = {trial.user_attrs.get(BASELINE) for trial in result.trials}
        assert {SCALED, NOISE} <= {one.name for one in met.met} & tried
        assert met.full.name == FULL_Q and met.full.over.high < 1.0
        assert f"it would be {100 * (1 - met.full.over.value):.1f} % [" in said
        assert "] better on 100 validation seeds (--full-q)." in said


def test_the_report_says_where_what_was_given_fails_and_why_a_trial_is_taken_or_not():
    plan = Plan("kf", (LinearProblem(truth=False),), objectives=("likelihood",))
    trial = _met("trial 3", -610.0, -1740.0, 523.0)._replace(chance=0.004)
    failure = Failure("run2.csv from 12 to 13.5 s", 8.9, 1.4)
    given = _met(GIVEN, 0.0, 0.0, 0.0)
    meeting = Validation((7, 8), True, (given, trial), GIVEN, "trial 3", "trial 3", None)
    meeting = meeting._replace(tested=GIVEN, failures=(failure,), failed=1, runs=48)
    assert choice_sentences(validation.as_data(meeting), plan) == [
        "The study returns trial 3: on 2 validation seeds its log-likelihood of a run is 610 [-523, 1740] above "
        "that of the best baseline, the given filter, and it is better in most of them (Wilcoxon's signed ranks, "
        "p = 0.004).",
        "The given filter fails in 1 of 48 seeds, in run2.csv from 12 to 13.5 s (mean NIS 17.8; trial 3: 2.8); a "
        "mean NIS of 2 is right.",
    ]
    lost = trial._replace(worse_in=("run1.csv",))
    said = choice_sentences(validation.as_data(meeting._replace(met=(meeting.met[0], lost), chosen=GIVEN)), plan)
    assert (
        "no trial is significantly better without being worse in a log (trial 3's log-likelihood of a" in said[0]
    )
    assert said[0].endswith("of a run is 610 [-523, 1740] higher, but it is worse in run1.csv).")
    lost = lost._replace(over=Interval(8.9, -51.6, 69.4))
    said = choice_sentences(validation.as_data(meeting._replace(met=(meeting.met[0], lost), chosen=GIVEN)), plan)
    ends = "trial 3's log-likelihood of a run is 8.9 [-51.6, 69.4] lower, and it is worse in run1.csv)."
    assert said[0].endswith(f"no trial is significantly better ({ends}")


def test_blocks_of_a_log_that_the_given_filter_cannot_follow_are_named():
    logs = logs_of(900, 900, 900)
    disturbed = logs[1].measurements.copy()
    disturbed[600:640, 0] += 9.0 * np.sign(np.sin(np.arange(40)))
    logs[1] = dataclasses.replace(logs[1], measurements=disturbed, start=100.0)
    problem = LogProblem(logs, MODEL.replace(process_noise_cov=[0.3]))
    study = tuning.tune(problem, "kf", trials=6, progress=False)
    met, first = study.result.validation, 100.0 + 0.1 * 600
    assert met.tested == GIVEN and 1 <= met.failed <= 3 and met.runs == len(problem.parts.blocks) * 2 // 3
    for one in met.failures:
        name, _, start, _, end, _ = one.run.split()
        assert name == "run1" and float(start) <= first + 4.0 and float(end) >= first and one.nis > 2.0
    likely = {f"trial {one.number + 1}" for one in study.trials if MAXIMUM_LIKELIHOOD in one.user_attrs}
    assert likely and likely <= {*finalists_of(study.plan, study.trials, lambda one, _: one)}
    assert any("The given filter fails in" in sentence for sentence in study.chosen)
    assert met.met[0].name == GIVEN


def test_where_own_numbers_give_way_to_a_noise_that_they_cannot_give_they_are_said():
    plan, own = Plan("ekf", (altitude_problem.problem(),)), untuned_choice("ekf", altitude_problem.problem())
    trial = _met("trial 3", 1.01, 0.99, 1.02)._replace(choice=own._replace(model={**own.model, "sigma_a": 0.25}))
    of_q = own._replace(model={"process_noise_cov": (1.0, 1.0, 1.0)})
    noise = _met(FULL_Q, 1.0, 1.0, 1.0)._replace(choice=of_q)
    given = _met(GIVEN, 1.0, 1.0, 1.0)._replace(choice=own)
    meeting = Validation((7, 8), True, (noise, trial), FULL_Q, "trial 3", FULL_Q, None)
    said = choice_sentences(validation.as_data(meeting), plan)
    begins = "Your own parameters cannot express the Q and R of the noise estimation with a full Q; those of "
    assert said[1].startswith(f"{begins}trial 3 are sigma_a = 0.25, ")
    meeting = Validation((7, 8), True, (given, trial), GIVEN, "trial 3", GIVEN, None)
    assert len(choice_sentences(validation.as_data(meeting), plan)) == 1


def test_ranges_are_wide_hold_what_was_given_and_flag_what_ends_at_an_end():
    far = pair(assumed=pair().model(process_noise_cov=[1e-30, 0.5, 1e9]))
    plan = Plan("kf", (far,))
    variances = far.untuned["process_noise_cov"]
    first, second, third = model_parameters(far)[:3]
    assert first.low == 1e-30 and third.high >= 1e9 and second.low == pytest.approx(FACTORS[0] * variances[1])
    assert FACTORS == (1e-10, 1e4) and f"Q22 {second.low:.3g} to {second.high:.3g} m^2" in range_words(plan)
    choice = untuned_choice("kf", far)
    assert at_ends(choice, plan) == []
    (said,) = at_ends(second.set(choice, second.low), plan)
    assert said.startswith("Q22 = ") and "ended at the lower end of its range" in said and "zero" in said
    assert range_warning(second.set(choice, second.low), plan) == []
    ended = second.set(choice, second.high)
    (said,) = at_ends(ended, plan)
    assert said.index("widen the range (--where 'Q22 = ") < said.index("the model lacks something")
    (said,) = range_warning(ended, plan)
    option = said.partition("--where '")[2].partition("'")[0]
    assert said.startswith("Q22 ended at the upper end of its range, ") and "Before you doubt the model" in said
    wider = plan._replace(where=(option,))
    assert at_ends(ended, wider) == range_warning(ended, wider) == []
    own = altitude_problem.problem()
    choice = untuned_choice("ekf", own)._replace(model={**altitude_problem.GIVEN, "sigma_a": 100.0})
    (said,) = at_ends(choice, Plan("ekf", (own,)))
    assert "sigma_a = 100 ended at the upper end" in said and "higher high" in said


def test_every_second_trial_is_near_the_best_one_within_its_range_and_the_same_each_time():
    plan = Plan("ekf", (thruster(),))
    space = {"Q": FloatDistribution(1e-6, 1e6, log=True), "N": IntDistribution(5, 200)}
    space["k"] = FloatDistribution(0, 1)
    best = {"Q": 1.0, "N": 20, "k": 0.5}
    found = [near(best, space, plan, number) for number in range(300)]
    assert found[7] == near(best, space, plan, 7) and any(one["N"] != 20 for one in found)
    assert all(5 <= one["N"] <= 200 and 0 <= one["k"] <= 1 and isinstance(one["N"], int) for one in found)
    assert 0.5 < np.mean([abs(np.log10(one["Q"])) < 0.5 for one in found])
    assert sum(one == best for one in found) < 30
    assert is_local(plan, 11) and not is_local(plan, 12) and not is_local(plan._replace(sampler="random"), 11)


def test_own_numbers_are_evaluated_compared_and_written_so_that_they_differ():
    problem = pair()
    model = problem.model(process_noise_cov=[1.0, 1.0, 1.0])
    found = tuning.evaluate(make_filter("kf", model), problem, seeds=10, progress=False)
    assert list(found.evaluations) == [GIVEN, RULE, SCALED, NOISE, "own numbers", ORACLE]  # "given" is the oracle
    assert found.choice.model["process_noise_cov"] == (1.0, 1.0, 1.0) and "own numbers" in str(found)
    assert user_choice(model, problem).name == "ekf"
    compared = tuning.compare([model, "kf"], problem, seeds=10, progress=False)
    assert [row.label for row in compared.boards[0].rows] == ["ekf own numbers", "kf"]
    with pytest.raises(ValueError, match="own numbers must be of the model of"):
        tuning.evaluate(altitude_problem.model(), problem, progress=False)
    refused("a filter or model must come with a problem", tuning.evaluate, model, progress=False)
    assert apart(0.00412341, 0.00412343) == ["0.00412341", "0.00412343"] and apart(1.0, 2.0) == ["1", "2"]
    assert apart(0.5, 0.5) == ["0.5", "0.5"]
