"""A filter that sleeps: results say how long it remembers, warn, and `forget` makes it listen."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

import tuning
from filters import make_filter, run
from filters.augmented import Unknown
from filters.consistency.nees import Interval
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tests.models import affine, state_space
from thruster_env.core.text_tables import plain_text
from tuning.api.report import _plan
from tuning.evaluation.baselines import baselines, rule_of_thumb, same_filter
from tuning.evaluation.evaluate import NOTHING
from tuning.evaluation.tuned import read_tuned
from tuning.evaluation.worth import memory_sentence, slowest_sentence, warnings_of
from tuning.problems.assumed import augmented
from tuning.problems.log_problem import LogProblem
from tuning.problems.model_problem import ModelProblem, log_of
from tuning.reporting.choice_words import choice_sentences
from tuning.reporting.tables import report as leaderboard_report
from tuning.reporting.tuning_report import as_json, report, way_out
from tuning.search.measures import measured, over
from tuning.search.plan import Plan
from tuning.search.space import Choice, forgetting, time_constants_on, untuned_choice, with_oracle_and_advice
from tuning.search.study import open_study, run_study
from tuning.search.validation import as_data as as_data_of_choice
from tuning.search.validation import choice_from

DT, STEPS, FORGET = 0.05, 200, 0.5


class Drag(NamedTuple):
    """The constant of a boat."""

    drag: float = 0.5


def cart(q=0.0):
    """A cart whose position is measured to 20 mm and which nothing disturbs."""
    noise = {"q": [q, q], "r": 4e-4, "mean": [0.0, 0.0], "cov": [1.0, 1.0]}
    return affine([[1.0, DT], [0.0, 1.0]], [[0.0], [DT]], [[1.0, 0.0]], **noise, states=["position", "velocity"])


@pytest.fixture(scope="module")
def problem():
    """The env without process noise; filters assume a Q of their own."""
    push = np.sin(np.arange(STEPS) / 7.0)[:, None]
    return ModelProblem(cart(), assumed=cart(1e-4), inputs=push, scale=[0.01, 0.01], dt=DT, name="cart")


@pytest.fixture(scope="module")
def studies(problem):
    """A study as it was asked for, and one that must forget."""
    spaces = (tuning.SearchSpace(forget=one) for one in (None, FORGET))
    return [tuning.tune(problem, "kf", trials=8, space=space, progress=False) for space in spaces]


def after_a_push(filter_, steps=60):
    """Error and stated deviation of the position some steps after the cart's velocity has jumped by 0.2 m/s."""
    generator, x, truth = np.random.default_rng(1), np.zeros(2), []
    for k in range(STEPS + steps):
        x = np.array([x[0] + DT * x[1], x[1] + 0.2 * (k == STEPS)])
        truth.append(x[0])
    z = np.array([0.0, *truth]) + 0.02 * generator.standard_normal(STEPS + steps + 1)
    found = run(filter_, np.array([[1.0, 2.0]]), np.zeros((1, STEPS + steps, 1)), z[None, :, None])
    return abs(found.means[0, -1, 0] - truth[-1]), np.sqrt(found.covs[0, -1, 0, 0])


def test_a_filter_that_sleeps_as_the_oracle_does_is_a_fact_and_one_that_must_forget_recovers(studies):
    asleep, awake = studies
    error, stated = after_a_push(asleep.filter)
    assert error > 0.1 and stated < 0.005
    constants = asleep.held_out.evaluation.time_constants
    assert constants.is_slow and constants.oracle[0] == pytest.approx(constants.steps[0], rel=0.5)
    assert not any("time constant" in one for one in asleep.warnings)
    text = " ".join(plain_text(report(asleep)).split())
    assert text.count("such a slow filter is right") == text.count("--forget 2 keeps it within 2 s.") == 1
    numbers = as_json(asleep)["memory"]["cart"]
    assert numbers["run"] == 10.0 and numbers["advised"] == 2.0 and not numbers["warns"]
    assert numbers["longest"] == DT * constants.steps[0] and numbers["oracle"] == DT * constants.oracle[0]
    error, stated = after_a_push(awake.filter)
    assert error < 3.0 * stated and 0.005 < stated < 0.02
    (comparison,) = awake.comparisons
    worse = comparison._replace(stored_ratios={"scaled default": Interval(2.0, 1.9, 2.1)})
    (price,) = way_out(replace(awake, comparisons=(worse,)))
    assert price.startswith("That is the price of forgetting within 0.5 s (--forget)")
    numbers = as_json(awake)["memory"]["cart"]
    assert 0.99 * FORGET < numbers["longest"] <= numbers["allowed"] == FORGET and not numbers["warns"]
    assert "Time constants of the gain: 0.5" in memory_sentence(awake.held_out.evaluation, awake.problem)


def test_a_constant_without_a_random_walk_is_not_asked_to_forget():

    def move(x, u, c):
        return (x[0] + DT * (u[0] - c.drag * x[0]),)

    noise = {"q": [1e-5], "r": [1e-4], "mean": [0.0], "cov": [0.1]}
    model = state_space(move, lambda x, c: (x[0],), **noise, constants=Drag(), states=["speed"])
    push = np.sin(np.arange(STEPS) / 7.0)[:, None]
    inner = ModelProblem(model, inputs=push, scale=[0.01], dt=DT, name="drag")
    for walk, sleeps in ((0.0, False), (1e-5, True)):
        constant = augmented(inner, {"drag": Unknown(std=0.1, walk_std=walk)})
        choice = untuned_choice("ekf", constant)
        assert time_constants_on(choice.filter(constant), constant).is_slow == sleeps
        cov = np.array(forgetting(choice, [constant], 0, 1.0).model["process_noise_cov"])
        assert (cov.T[-1] > walk**2).any() == sleeps


def test_a_filter_that_sleeps_more_than_the_oracle_is_warned_of_with_an_advice_that_holds(studies, problem):
    push, scale = problem.inputs, [0.01, 0.01]
    moved = ModelProblem(cart(1e-4), assumed=cart(1e-4), inputs=push, scale=scale, dt=DT, name="moved")
    sleepy = Choice("kf", {"process_noise_cov": (1e-13, 1e-13), "measurement_noise_cov": (4e-4,)}, {})
    found = with_oracle_and_advice(time_constants_on(sleepy.filter(moved), moved), sleepy, moved, 0)
    assert found.steps[0] > 3.0 * found.oracle[0]
    evaluation = studies[0].held_out.evaluation._replace(time_constants=found, state_nees=None, nees=NOTHING)
    (said,) = warnings_of(evaluation, moved)
    assert "is 4.13 s, more than a fifth of a run (10 s)" in said
    assert said.endswith("--forget 2 keeps it within 2 s.")
    assert "With the plant's own Q and R it is 0." in said
    Plan("kf", (moved,), forget=found.advised).checked()
    raised = forgetting(sleepy, [moved], 0, found.advised, exact=True)
    again = time_constants_on(raised.filter(moved), moved)
    assert 0.99 * found.advised < DT * again.steps[0] <= found.advised and not again.is_slow
    assert warnings_of(evaluation, moved, forget=20.0) == []
    (said,) = warnings_of(evaluation, moved, forget=1.0)
    assert said.startswith("The longest time constant of the gain is 4.13 s and misses --forget 1:")


def test_of_logs_a_run_is_the_shortest_log_however_they_are_cut_into_blocks():
    generator, logs = np.random.default_rng(0), []
    for i, steps in enumerate((900, 700)):
        z = 0.02 * generator.standard_normal((steps + 1, 1))
        logs.append(log_of((np.zeros((steps, 1)), z), cart(), DT, f"log {i}"))
    problems = (LogProblem(logs, cart(1e-4), blocks=blocks) for blocks in (3, 8))
    found = [time_constants_on(make_filter("kf", cart(1e-8)), problem) for problem in problems]
    assert found[0] == found[1] and found[0].length == 700 and not found[0].is_slow
    assert found[0].steps[0] > 0.2 * 700 / 8  # a block would have been called short


def spring(observe, r=1e-4):
    """A softening spring of which a function of the position is measured, seen for 1.5 s."""

    def move(x, u, c):
        return (x[0] + DT * x[1], x[1] + DT * (u[0] - 9.0 * x[0] + x[0] ** 3))

    model = state_space(move, observe, q=[1e-8, 1e-8], r=r, mean=[0.5, 0.0], cov=[0.01, 0.01])
    push = np.sin(np.arange(30) / 9.0)[:, None]
    return ModelProblem(model, inputs=push, scale=[0.1, 0.1], dt=DT, name="spring", first_scored_step=5)


def test_the_floor_holds_for_the_gain_that_a_nonlinear_filter_has():
    problem = spring(lambda x, c: (x[0] ** 2,))
    choice = rule_of_thumb("ekf", problem)
    choices = (forgetting(choice, [problem], 0, 0.1, exact=exact) for exact in (False, True))
    roughly, exactly = (time_constants_on(one.filter(problem), problem) for one in choices)
    assert DT * roughly.steps[0] > 0.101 and 0.099 < DT * exactly.steps[0] <= 0.1


def test_an_advice_is_accepted_where_a_fifth_of_a_run_is_more_than_a_larger_q_reaches():
    problem = spring(lambda x, c: (x[0] ** 3,))
    with pytest.raises(ValueError, match=r"on spring none reaches 0\.1 s: allow .*, such as 0\.2\d s"):
        Plan("ekf", (problem,), forget=0.1).checked()
    choice = rule_of_thumb("ekf", problem)
    found = time_constants_on(choice.filter(problem), problem)._replace(length=10)
    found = with_oracle_and_advice(found, choice, problem, 0)
    assert 0.2 < found.advised < 0.3 and Plan("ekf", (problem,), forget=found.advised).checked()
    raised = forgetting(choice, [problem], 0, found.advised, exact=True)
    assert DT * time_constants_on(raised.filter(problem), problem).steps[0] <= found.advised


def test_all_that_is_chosen_among_forgets_in_time_and_the_plan_is_kept(studies, problem, tmp_path):
    awake = studies[1]
    plan = awake.plan
    for one in awake.result.validation.met:
        assert plan.forgetting(one.choice) == one.choice
    assert plan.identity["forget"] == FORGET and "forget0.5" in awake.name
    assert "forget" not in Plan("kf", (problem,)).identity
    choice, *_ = read_tuned(awake.save(tmp_path / "awake.json"), [problem])
    covs = [one.model.process_noise_cov for one in (choice.filter(problem), awake.filter)]
    np.testing.assert_allclose(*covs, rtol=1e-12)
    assert _plan(plan.identity, "x", lambda name: problem).forget == FORGET
    assert choice_from(awake.result.choice._asdict()) == awake.choice


def test_the_numbers_on_validation_seeds_are_those_of_the_filter_that_is_handed_out():
    problem = spring(lambda x, c: (x[0] ** 2,))
    plan = Plan("ekf", (problem,), full_q=True, forget=0.1)
    result = run_study(open_study("forgets", plan), plan, 3)
    met, data = result.validation, plan.validation_data()
    chosen, baseline = met.named(met.chosen), met.named(met.baseline)
    assert chosen.choice == result.choice
    exact = {entry.name: measured(entry.choice, plan, data) for entry in (chosen, baseline)}
    for entry in (chosen, baseline):
        assert DT * time_constants_on(entry.choice.filter(problem), problem).steps[0] <= 0.1
        assert entry.value == exact[entry.name].value
    assert chosen.over == over(exact[chosen.name], exact[baseline.name], ratio=True)
    assert baseline.raised and not same_filter(baseline.choice, baselines("ekf", problem)[baseline.name])
    said = " ".join(choice_sentences(as_data_of_choice(met), plan))
    names = " and ".join(dict.fromkeys((baseline.name, chosen.name)))
    assert f"Here the {names} have a larger Q, to forget within 0.1 s (--forget); those of the tables may " in said


@pytest.mark.parametrize("options", [{"method": name} for name in ("likelihood", "gradient", "noise-estimation")])
def test_it_holds_on_other_methods_of_tuning(options, problem):
    space = tuning.SearchSpace(forget=FORGET)
    found = tuning.tune(problem, "kf", trials=2, space=space, progress=False, **options)
    assert DT * found.held_out.evaluation.time_constants.steps[0] <= FORGET


def test_what_cannot_forget_is_refused_in_one_line(problem):
    timeless = LinearProblem()
    refused("needs a sample time, but linear-3 has none", Plan("kf", (timeless,), forget=1.0).checked)
    with pytest.raises(ValueError, match=r"forget must be at least the sample time, 0.05 s, but got 0.01"):
        Plan("kf", (problem,), forget=0.01).checked()
    refused("needs a filter with a Q, but got 'low-pass'", Plan("low-pass", (problem,), forget=1.0).checked)


def test_a_table_of_filters_has_their_time_constants_and_none_of_those_without_a_gain(problem):
    found = tuning.compare(["kf", "open-loop"], problem, seeds=4, knows="untuned", progress=False).boards[0]
    evaluations = {row.label: row.evaluation for row in found.rows}
    said = slowest_sentence(evaluations, problem)
    assert said.startswith("Longest time constant of the gain: kf 6.") and said.endswith(" s, open-loop -.")
    assert said in leaderboard_report(found)
    assert memory_sentence(evaluations["open-loop"], problem) == "Time constants of the gain: -."
