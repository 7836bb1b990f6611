"""What a study can minimise: each objective against its definition, written once more, and what it is for."""

import numpy as np
import pytest
from optuna.trial import create_trial
from scipy.stats import chi2, multivariate_normal

from filters import run
from tests.linear_problem import LinearProblem
from tuning.evaluation.evaluate import evaluate, variance_ratios
from tuning.evaluation.runs import RunMetrics
from tuning.experiments.benchmark import run_in_memory
from tuning.plants.thruster import find_scenario
from tuning.reporting.search_figures import draw_history
from tuning.reporting.sections import of_front, of_history, reported_about
from tuning.reporting.tuning_report import _band_sentence
from tuning.search.among_types import TypeResult
from tuning.search.measures import measured
from tuning.search.plan import HELD_OUT_SEEDS, Plan, find_objective, nees_ratio, reported, reported_name
from tuning.search.space import oracle_choice, untuned_choice
from tuning.search.study import open_study, run_study
from tuning.search.trials import measure

PROBLEM = LinearProblem(scale=(0.2, np.inf, 0.4))
DATA = PROBLEM.data(range(8))
CHOICE = untuned_choice("kf", PROBLEM)


@pytest.mark.parametrize(
    ("objective", "name", "said"),
    [
        (
            "likelihood",
            "log L",
            "costs 3 of log L on the training blocks: the best trial of all has -56, the best",
        ),
        ("log-score", "log score", "costs 3 of log score on the training blocks: the best trial of all has -56, "),
        (
            "score",
            "score",
            "costs 5.4 % of score on the training blocks: the best trial of all has 56, the best in",
        ),
    ],
)
def test_reports_have_log_l_and_not_its_negative(objective, name, said):
    assert reported_name(objective) == name and "negative" not in reported_about(objective)
    assert reported(objective, 59.0) == (59.0 if objective == "score" else -59.0)
    (cost,) = _band_sentence(objective, 56.0, 59.0, "blocks")  # 59 = -log L is worse than 56
    assert said in cost and _band_sentence(objective, 56.0, 56.0, "blocks") == []
    trials = [create_trial(value=value) for value in (70.0, 56.0)]
    assert f"{name} of 2 trials" in of_history(trials, objective)
    axis = draw_history(trials, "a study", name, objective).axes[0]
    (best,) = [line for line in axis.lines if line.get_label() == "best so far"]
    values = [70.0, 56.0] if objective == "score" else [-70.0, -56.0]
    assert best.get_ydata().tolist() == values and f"has {values[1]:g}." in of_history(trials, objective)
    low, high = axis.get_ylim()
    assert low < min(values) < max(values) < high
    front = of_front([create_trial(values=[56.0, 2.0])], (objective, "nis"))
    assert front.endswith(f"to {name} {values[1]:g} and nis 2.")
    assert TypeResult("ekf", 2, 0, 0, 56.0, True, None).best(objective) == f"{values[1]:g}"


@pytest.fixture(scope="module")
def expected():
    """The objectives of the untuned filter, step by step."""
    estimates = run(CHOICE.filter(PROBLEM), DATA.filter_keys, DATA.inputs, DATA.measurements)
    errors, nees, nis, log_scores, channels = [], [], [], [], []
    for b in range(8):
        for k in range(10, 71):
            e, p = DATA.states[b, k] - estimates.means[b, k], estimates.covs[b, k]
            seen = ~np.isnan(DATA.measurements[b, k])
            v, s = estimates.innovations[b, k][seen], estimates.innovation_covs[b, k][np.ix_(seen, seen)]
            errors.append(e**2)
            nees.append(e @ np.linalg.solve(p, e))
            nis.append(v @ np.linalg.solve(s, v) if seen.any() else np.nan)
            channels.append(seen.sum() if seen.any() else np.nan)
            some = np.ix_([0, 2], [0, 2])
            log_scores.append(multivariate_normal(cov=p[some]).logpdf(e[[0, 2]]))
    squares = np.mean(errors, axis=0)
    nees, nis, channels = (np.reshape(part, (8, 61)) for part in (nees, nis, channels))
    of_nees, of_nis = (abs(np.log(mean)) for mean in (nees.mean() / 3, np.nanmean(nis) / np.nanmean(channels)))
    wide = np.mean([np.nanvar(run, ddof=1) for run in nis]) / (2 * np.nanmean(channels) + np.nanvar(channels))
    return {
        "score": (np.sqrt(squares[0]) / 0.2 + np.sqrt(squares[2]) / 0.4) / 2,
        "mse": squares[0] / 0.2**2 + squares[2] / 0.4**2,
        "log-score": -np.mean(log_scores),
        "nees": of_nees,
        "nis": of_nis,
        "c-nees": of_nees + abs(np.log(np.mean([one.var(ddof=1) for one in nees]) / 6)),
        "c-nis": of_nis + abs(np.log(wide)),
        "consistency": of_nees + of_nis,
    }


@pytest.mark.parametrize("name", ["score", "mse", "log-score", "nees", "nis", "c-nees", "c-nis", "consistency"])
def test_an_objective_is_what_its_definition_says_in_a_trial_and_held_out(name, expected):
    objective = find_objective(name)
    (found,) = measure(CHOICE, Plan("kf", (PROBLEM,), objectives=(name,)), [DATA])
    for one in (found, evaluate(CHOICE.filter(PROBLEM), DATA, PROBLEM.scale)):
        assert objective.value(one, 0.0) == pytest.approx(expected[name], rel=1e-9)


def test_chi_squares_have_the_variance_that_is_expected_of_a_consistent_filter():
    rng = np.random.default_rng(4)
    present = rng.integers(0, 4, (200, 500))
    nis = np.where(present > 0, chi2.rvs(np.maximum(present, 1), random_state=rng), np.nan)
    nees = chi2.rvs(5, size=(200, 500), random_state=rng)
    runs = RunMetrics(nis, present, None, None, np.ones((200, 5)), None, nees, {}, None)
    assert variance_ratios(runs) == pytest.approx((1.0, 1.0), abs=0.03)  # five standard errors


def test_the_log_score_alone_is_least_at_the_truth_in_every_direction():
    """A factor on Q, R and P moves no estimate, so no error notices it; NEES and NIS notice nothing else."""
    problem = LinearProblem()
    data = problem.data(range(40))
    oracle = oracle_choice("kf", problem)

    def scaled(q, r, p=1.0):
        noise = {"process_noise_cov": (0.02 * q,) * 3, "measurement_noise_cov": (0.1 * r,) * 2}
        choice = oracle._replace(model={**noise, "prior_cov_factor": p})
        return evaluate(choice.filter(problem), data, problem.scale)

    def minimised(name):
        objective = find_objective(name)
        return [objective.value(scaled(*factors), 0.0) - objective.value(scaled(1, 1), 0.0) for factors in FACTORS]

    assert min(minimised("log-score")) > 0.01
    assert minimised("score")[0] == pytest.approx(0.0, abs=1e-9) == minimised("mse")[0]


FACTORS = [(3, 3, 3), (1 / 3, 1 / 3, 1 / 3), (4, 1), (1 / 4, 1), (1, 4), (1, 1 / 4)]


def test_runs_of_unequal_length_are_pooled_by_their_steps():
    counted = np.ones((8, 71), dtype=bool)
    counted[0, 20:] = counted[5, ::3] = False
    data = DATA._replace(counted=counted)
    plan = Plan("kf", (PROBLEM,), objectives=("log-score",))
    parts = [measured(CHOICE, plan, [data.slice(b, b + 1)]).value for b in range(8)]
    counts = counted[:, 10:].sum(axis=1)
    found = measured(CHOICE, plan, [data])
    assert found.value == pytest.approx(np.average(parts, weights=counts), rel=1e-12)
    assert found.left_out[0][0] == pytest.approx(np.average(parts[1:], weights=counts[1:]), rel=1e-12)
    assert -evaluate(CHOICE.filter(PROBLEM), data, PROBLEM.scale).log_score.value == pytest.approx(found.value)


@pytest.mark.parametrize("name", ["mse", "log-score"])
def test_runs_are_left_out_one_by_one_also_of_the_worst_problem(name):
    plan = Plan("kf", (PROBLEM,), objectives=(name,))
    one, rest = (measured(CHOICE, plan, [DATA.slice(0, count)]) for count in (8, 7))
    assert one.left_out[0][7] == pytest.approx(rest.value, rel=1e-12)
    both = Plan("kf", (PROBLEM, LinearProblem(n=3, m=2, scale=(0.1,) * 3)), objectives=(name,), worst=True)
    parts = [measured(CHOICE, Plan("kf", (p,), objectives=(name,)), [DATA]) for p in both.scenarios]
    worst = measured(CHOICE, both, [DATA, DATA])
    assert worst.value == max(part.value for part in parts) != min(part.value for part in parts)
    for left_out, part, other in zip(worst.left_out, parts, parts[::-1], strict=True):
        np.testing.assert_allclose(left_out, np.maximum(part.left_out[0], other.value), rtol=1e-12)


@pytest.mark.slow
def test_where_the_model_is_wrong_a_study_of_the_score_has_a_covariance_as_good_as_that_of_the_log_score():
    scenario = find_scenario("mismatch")
    plans = [Plan("ekf", (scenario,), 1, (objective,)) for objective in ("score", "log-score")]
    data = scenario.data(scenario.held_out_seeds(1, HELD_OUT_SEEDS))
    choices = [run_in_memory(plan, 16).choice for plan in plans]
    by_score, by_log_score = (evaluate(choice.filter(scenario), data, scenario.scale) for choice in choices)
    # At the end the log score decides among filters of the least error.
    assert by_score.log_score.value == pytest.approx(by_log_score.log_score.value, abs=0.1)
    assert max(nees_ratio(by_log_score), nees_ratio(by_score)) < 3.0


@pytest.mark.slow
def test_a_study_of_the_log_score_needs_no_band_and_is_validated():
    plan = Plan("kf", (PROBLEM,), objectives=("log-score",)).checked()
    assert not plan.is_constrained and Plan("kf", (PROBLEM,)).is_constrained
    result = run_study(open_study("proper", plan), plan, 12)
    oracle = oracle_choice("kf", PROBLEM).filter(PROBLEM)
    known = -evaluate(oracle, plan.training_data()[0], PROBLEM.scale).log_score.value
    assert result.best_value < known + 0.02 and result.validation is not None
    assert plan.identity == plan._replace(worst=False).identity != plan._replace(worst=True).identity
