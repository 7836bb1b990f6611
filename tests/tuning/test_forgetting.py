"""A filter that sleeps: results say how long it remembers, warn, and `forget` makes it listen."""

import numpy as np
import pytest

import tuning
from filters import affine_model, run
from filters.consistency.intervals import Interval
from tests.linear_problem import LinearProblem
from tuning.cli.tuning_report import as_json, report, way_out
from tuning.evaluation.tuned import read_tuned
from tuning.evaluation.worth import memory_sentence, slowest_sentence
from tuning.problems.model_problem import ModelProblem
from tuning.reporting.leaderboard import report as leaderboard_report
from tuning.reporting.subject import _plan
from tuning.search.plan import Plan
from tuning.search.validation import choice_from

DT, STEPS, FORGET = 0.05, 200, 0.5


def cart(q=0.0):
    """A cart whose position is measured to 20 mm and which nothing disturbs."""
    return affine_model(
        a=[[1.0, DT], [0.0, 1.0]],
        b=[[0.0], [DT]],
        c=[[1.0, 0.0]],
        process_noise_cov=[q, q],
        measurement_noise_cov=4e-4,
        prior_mean=[0.0, 0.0],
        prior_cov=[1.0, 1.0],
        states=["position", "velocity"],
    )


@pytest.fixture(scope="module")
def problem():
    """The env without process noise; filters assume a Q of their own."""
    push = np.sin(np.arange(STEPS) / 7.0)[:, None]
    return ModelProblem(cart(), assumed=cart(1e-4), inputs=push, scale=[0.01, 0.01], dt=DT, name="cart")


@pytest.fixture(scope="module")
def studies(problem):
    """A study as it was asked for, and one that must forget."""
    return [tuning.tune(problem, "kf", trials=8, forget=one, progress=False) for one in (None, FORGET)]


def after_a_push(filter_, steps=60):
    """Error and stated deviation of the position some steps after the cart's velocity has jumped by 0.2 m/s."""
    generator, x, truth = np.random.default_rng(1), np.zeros(2), []
    for k in range(STEPS + steps):
        x = np.array([x[0] + DT * x[1], x[1] + 0.2 * (k == STEPS)])
        truth.append(x[0])
    z = np.array([0.0, *truth]) + 0.02 * generator.standard_normal(STEPS + steps + 1)
    found = run(filter_, np.array([[1.0, 2.0]]), np.zeros((1, STEPS + steps, 1)), z[None, :, None])
    return abs(found.means[0, -1, 0] - truth[-1]), np.sqrt(found.covs[0, -1, 0, 0])


def test_a_filter_that_sleeps_is_warned_of_and_one_that_must_forget_recovers_from_a_push(studies):
    asleep, awake = studies
    error, stated = after_a_push(asleep.filter)
    assert error > 0.1 and stated < 0.005
    (said,) = [one for one in asleep.tuning.warnings if "hardly forgets" in one]
    assert "longer than a fifth of a run (10 s): --forget 2 raises Q so that it is not" in said
    assert said in report(asleep.tuning) and said in as_json(asleep.tuning)["warnings"]
    error, stated = after_a_push(awake.filter)
    assert error < 3.0 * stated and 0.005 < stated < 0.02
    assert not any("hardly forgets" in one for one in awake.tuning.warnings)
    (comparison,) = awake.tuning.comparisons
    worse = comparison._replace(stored_ratios={"scaled default": Interval(2.0, 1.9, 2.1)})
    (price,) = way_out(awake.tuning._replace(comparisons=(worse,)))
    assert price.startswith("That is the price of forgetting within 0.5 s (--forget)")
    (entry,) = as_json(awake.tuning)["held_out"].values()
    assert DT * entry["tuned"]["time_constants"]["steps"][0] == pytest.approx(FORGET, rel=0.01)
    assert "Time constants of the gain: 0.5" in memory_sentence(awake.held_out.evaluation, awake.problem)


def test_all_that_is_chosen_among_forgets_in_time_and_the_plan_is_kept(studies, problem, tmp_path):
    awake = studies[1]
    plan = awake.tuning.plan
    for one in awake.tuning.result.validation.met:
        assert plan.forgetting(one.choice) == one.choice
    assert plan.identity["forget"] == FORGET and "forget0.5" in awake.name
    assert "forget" not in Plan("kf", (problem,)).identity
    choice, *_ = read_tuned(awake.save(tmp_path / "awake.json"), [problem])
    np.testing.assert_allclose(
        choice.filter(problem).model.process_noise_cov, awake.filter.model.process_noise_cov, rtol=1e-12
    )
    assert _plan(plan.identity, "x", lambda name: problem).forget == FORGET
    assert choice_from(awake.tuning.result.choice._asdict()) == awake.choice


@pytest.mark.parametrize("options", ({"way": "likelihood"}, {"method": "gradient"}, {"way": "noise-estimation"}))
def test_it_holds_on_other_ways_of_tuning(options, problem):
    found = tuning.tune(problem, "kf", trials=2, forget=FORGET, progress=False, **options)
    assert DT * found.held_out.evaluation.time_constants.steps[0] < 1.01 * FORGET


def test_what_cannot_forget_is_refused_in_one_line(problem):
    timeless = LinearProblem()
    with pytest.raises(ValueError, match="needs a sample time, but linear-3 has none"):
        Plan("kf", (timeless,), forget=1.0).checked()
    with pytest.raises(ValueError, match=r"forget must be at least the sample time, 0.05 s, but got 0.01"):
        Plan("kf", (problem,), forget=0.01).checked()
    with pytest.raises(ValueError, match="needs a filter with a Q, but got 'low-pass'"):
        Plan("low-pass", (problem,), forget=1.0).checked()


def test_a_table_of_filters_has_their_time_constants_and_none_of_those_without_a_gain(problem):
    found = tuning.compare(["kf", "open-loop"], problem, seeds=4, knows="untuned", progress=False).boards[0]
    evaluations = {row.label: row.evaluation for row in found.rows}
    said = slowest_sentence(evaluations, problem)
    assert said.startswith("Longest time constant of the gain: kf 6.") and said.endswith(" s, open-loop -.")
    assert said in leaderboard_report(found)
    assert memory_sentence(evaluations["open-loop"], problem) == "Time constants of the gain: -."
