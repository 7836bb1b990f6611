"""Evaluation, tables, reports and figures of any number of states and channels, of odd names, without truth."""

import io

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

import tuning
from filters import make_filter
from filters.consistency.nees import normalized_squares
from filters.consistency.report import NO_TRUTH, sentences
from filters.engine.batch import run
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tests.models import affine
from thruster_env.core.files import save_figure
from thruster_env.core.text_tables import verbatim
from thruster_env.model.quantities import Quantity
from tuning.api.held_out import CovarianceCheck, HeldOut
from tuning.api.progress import working
from tuning.evaluation.compare import compare, contender
from tuning.evaluation.evaluate import check_consistency, evaluate, likelihood_gain
from tuning.evaluation.held_out import Comparison, summary
from tuning.evaluation.sizes import ensemble_sizes
from tuning.evaluation.worth import tuning_effect
from tuning.plants.thruster import find_scenario
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import score_label
from tuning.reporting import tables as leaderboard
from tuning.reporting.choice_words import gains, number_rows
from tuning.reporting.page import Table, markdown_page
from tuning.reporting.search_figures import draw_consistency
from tuning.reporting.sections import Subject, advice, held_out_section
from tuning.reporting.tables import ABOVE, choice_table, comparison_table
from tuning.search.parameters import index_pairs
from tuning.search.plan import Plan, check_objectives, find_objective, nis_ratio
from tuning.search.space import Choice, oracle_choice, untuned_choice

SEEDS = range(8)


def comparison_on(problem):
    """Rule of thumb, oracle in the tuned filter's place, and oracle on a problem, none of them compiled."""
    choices = [untuned_choice("kf", problem), oracle_choice("kf", problem), oracle_choice("kf", problem)]
    data = problem.data(SEEDS)
    found = [evaluate(choice.filter(problem), data, problem.scale) for choice in choices]
    bound = np.full(problem.n, 0.1 if problem.truth else np.nan)
    return Comparison(*found, bound=bound, seeds=SEEDS)


@pytest.fixture(scope="module")
def comparisons():
    """By number of states and whether there is truth."""
    problems = [LinearProblem(), LinearProblem(truth=False), LinearProblem(1, 1), LinearProblem(8)]
    return {(one.n, one.truth): (one, comparison_on(one)) for one in problems}


def printed(*parts, width=80):
    """What a terminal shows."""
    console = Console(file=io.StringIO(), width=width, markup=False, highlight=False)
    for part in parts:
        console.print(part)
    return console.file.getvalue()


def test_an_evaluation_has_one_of_everything_for_each_state_channel_and_output(comparisons):
    problem, comparison = comparisons[3, True]
    found, data = comparison.true, problem.data(SEEDS)
    estimates = run(oracle_choice("kf", problem).filter(problem), data.filter_keys, data.inputs, data.measurements)
    late, errors = slice(10, None), estimates.means - data.states
    np.testing.assert_allclose([part.value for part in found.rmse], np.sqrt((errors[:, late] ** 2).mean((0, 1))))
    assert [state.symbol for state in found.states] == ["p", "v", "b"] and found.channels == 2
    energies = 0.5 * estimates.means[..., 1] ** 2 - data.outputs["E"]
    assert found.output_rmse["E"].value == pytest.approx(np.sqrt((energies[:, late] ** 2).mean()), rel=1e-12)
    assert summary(found)["energy_rmse"] == list(found.output_rmse["E"])
    model = problem.model()
    phase = Quantity("phase", "E", "rad", angle=True)
    turning = model.replace(outputs={"E": (phase, model.outputs["E"].function)})
    turned = data._replace(outputs={"E": data.outputs["E"] + 2.0 * np.pi})  # a whole turn is no error of an angle
    of_angle = evaluate(make_filter("kf", turning), turned, problem.scale).output_rmse["E"]
    assert of_angle.value == pytest.approx(found.output_rmse["E"].value, rel=1e-9)
    # Of two channels one measurement in ten is missing: the mean NIS of a filter that is right is less than two.
    there = (~np.isnan(data.measurements[:, late])).sum(-1)
    assert found.expected_nis == there[there > 0].mean() and 1.7 < found.expected_nis < 1.9
    squares = normalized_squares(estimates.innovations[:, late], estimates.innovation_covs[:, late])
    assert found.nis.value == pytest.approx(squares[there > 0].mean()) and found.nis.covers(found.expected_nis)
    assert found.nees.covers(3) and nis_ratio(found) == found.nis.value / found.expected_nis


def test_a_scale_has_a_number_for_each_state_and_is_finite_in_some():
    problem = LinearProblem()
    filter_, data = oracle_choice("kf", problem).filter(problem), problem.data(SEEDS)
    for scale, rule in (((0.5, 0.5), "one number per state, 3"), ((np.inf,) * 3, "finite in some state")):
        refused(f"scale must be {rule}", evaluate, filter_, data, scale)


def test_without_truth_the_innovations_stay(comparisons):
    (_, known), (_, blind) = comparisons[3, True], comparisons[3, False]
    with_truth, without = known.true, blind.true
    assert with_truth.has_truth and not without.has_truth
    assert (without.nis, without.log_likelihood) == (with_truth.nis, with_truth.log_likelihood)
    assert np.isnan(without.rmse).all() and len(without.rmse) == 3 and np.isnan(without.score).all()
    said = summary(without)
    assert said["rmse"] == [None] * 3 and said["score"] is said["nees"] is None and said["nis"] is not None
    gain = likelihood_gain(blind.true, blind.untuned)
    assert 0 < gain.low < gain.value == pytest.approx(without.log_likelihood - blind.untuned.log_likelihood)
    assert tuning_effect(blind).startswith("changes the log-likelihood of a run by +")
    worse = blind._replace(tuned=blind.untuned, untuned=blind.tuned)
    loss = worse.likelihood_gains["rule of thumb"]
    assert loss.low < loss.high < 0
    size = f"{-loss.value:.2f} [{-loss.high:.2f}, {-loss.low:.2f}]"
    signed = f"{loss.value:.2f} [{loss.low:.2f}, {loss.high:.2f}]"
    begins = f"changes the log-likelihood of a run by {signed} against the rule of thumb"
    assert tuning_effect(worse).startswith(begins)
    assert f"{size} below that of the rule of thumb" in " ".join(gains(worse, "runs"))


def test_without_a_bound_nothing_is_said_to_be_above_it(comparisons):
    problem, comparison = comparisons[3, True]
    without = comparison._replace(bound=np.full(3, np.nan))
    shown = printed(comparison_table(without.evaluations, without.bound, "here", problem.scale_about))
    assert "above" not in shown and "bound " not in shown and "expected" in shown
    assert "No bound; the score is RMSE over the scale given with the problem." in " ".join(shown.split())
    table = comparison_table(comparison.evaluations, comparison.bound, "here", problem.scale_about)
    assert "above" in printed(table)
    assert score_label([problem]) == "score: mean RMSE over scale [-]"
    assert score_label([find_scenario("outliers")]) == "score: mean RMSE over bound [-]"
    assert score_label([find_scenario("outliers"), problem]) == "score: mean RMSE over scale [-]"


def test_one_zero_in_the_true_q_is_said_to_change_the_scale():
    model = LinearProblem(1, 1).model()
    singular = "the RMSE of the open loop, for the true Q is singular"
    for variance, words in ((0.1, "the posterior Cramér-Rao bound"), (0.0, singular)):
        problem = ModelProblem(model.replace(process_noise_cov=[variance]), model, np.zeros((60, 1)), steps=60)
        assert problem.scale_about == words


def test_the_tables_of_errors_grow_downwards_with_the_states(comparisons):
    cases = (1, True), (3, True), (8, True), (3, False)
    results = [comparisons[case][1] for case in cases]
    few, three, many, blind = (comparison_table(part.evaluations, part.bound, "here") for part in results)
    assert list(few.columns[:3]) == ["filter", "p\n[m]", ABOVE] and list(three.columns[:2]) == ["filter", "state"]
    assert [row[1] for row in three.rows][:4] == ["p [m]", "v [m/s]", "b [m]", "E [J]"]
    assert 'class="fold"' in few.html() and 'data-head="p\n[m]"' in few.html()
    for table in (few, three, many, blind):
        assert {len(row) for row in table.rows} == {len(table.columns)}
    assert "log L" in blind.columns and "nan" not in blind.markdown()


def test_a_leaderboard_ranks_without_truth_by_the_likelihood():
    filters = [contender("kf", "untuned"), contender("ekf"), contender("low-pass")]
    (blind,), _ = compare(filters, [LinearProblem(truth=False)], SEEDS)
    (many,), _ = compare(filters, [LinearProblem(8, steps=20)], range(2))
    assert [row.verdict for row in blind.rows] == ["tie", "better", "unknown"]
    said = printed(*leaderboard.report(blind))
    assert "has no true states, so filters are compared by" in said and "nan" not in said
    assert "By the log-likelihood on " in (words := " ".join(said.split()))
    assert ", ekf is better than kf; low-pass is without a likelihood to compare with that of kf." in words
    said = printed(*leaderboard.report(many))
    assert "q_8 [K]" in said and "start-up" in said and max(map(len, said.splitlines())) <= 80
    content = leaderboard.as_json((blind, many))
    assert content["states"] == ["p [m]", "v [m/s]", "b [m]"]
    assert content["scenarios"]["linear-8"]["states"][-1] == "q_8 [K]"


def test_consistency_without_truth_is_that_of_the_innovations(tmp_path):
    problem = LinearProblem(truth=False)
    data = problem.data(range(30))
    report = check_consistency(oracle_choice("enkf", problem).with_size(5).filter(problem), data)
    known = check_consistency(oracle_choice("kf", problem).filter(problem), LinearProblem().data(range(30)))
    said = sentences(report)
    assert said[0] == NO_TRUTH and not any("NEES" in one or "CRPS" in one for one in said)
    start = "The 95 % interval of the expected range [m] contains the measurement"
    assert any(one.startswith(start) for one in said)
    assert report.channels == ("range [m]", "speed [m/s]") and report.ensemble is None
    for coverage in known.innovation_coverage:
        assert coverage.covers(0.95)
    states = CovarianceCheck("oracle", report, None, "").as_dict()["states"]
    assert np.isnan(report.coverage).all() and states == ("p [m]", "v [m/s]", "b [m]")
    assert known.coverage[0].value == pytest.approx(0.95, abs=0.03) and len(sentences(known)) >= 5 + 6
    for name, one in (("without", report), ("with", known)):
        assert save_figure(draw_consistency(one, "title"), tmp_path / f"{name}.png").stat().st_size > 10_000


def test_objectives_say_what_they_need(comparisons):
    (problem, comparison), blind = comparisons[3, True], comparisons[3, False][0]
    assert find_objective("output:E").value(comparison.true, 0.0) == comparison.true.output_rmse["E"].value
    assert find_objective("nis").value(comparison.true, 0.0) == abs(np.log(nis_ratio(comparison.true)))
    assert find_objective("thrust").output == "T" == find_objective("output:T").output
    check_objectives(("likelihood", "nis", "c-nis", "cost"), blind)
    for objective in ("score", "mse", "log-score", "nees", "c-nees", "consistency", "output:E"):
        with pytest.raises(ValueError, match="no truth, must be one of likelihood, nis, c-nis, cost, but got"):
            Plan("kf", (blind,), objectives=(objective,)).checked()
    with pytest.raises(ValueError, match="derived output of linear-3 must be one of output:E, but got 'thrust'"):
        Plan("kf", (problem,), objectives=("thrust",)).checked()
    refused("objective must be one of score, mse, .*output:SYMBOL, but got 'output:'", find_objective, "output:")


def test_a_report_without_truth_says_so_and_has_no_errors(comparisons):
    problem, comparison = comparisons[3, False]
    plan, choice = Plan("kf", (problem,), objectives=("likelihood",)), oracle_choice("kf", problem)
    said = advice(choice, plan, [comparison])
    assert said.endswith("the covariance is consistent (mean NIS 1.76, expected 1.81).")
    tables = HeldOut(choice, problem, comparison).tables()
    subject = Subject("s", plan, choice, None, 8, True)
    numbers, errors, words = held_out_section(None, subject, [comparison], [tables]).parts
    assert [numbers, errors] == tables[:2] and errors.title.startswith("Innovations on ")
    said = " ".join(words.sentences)
    assert "Time constants of the gain: " in said and "has no true states, so filters are compared by" in said
    assert ensemble_sizes(oracle_choice("enkf", problem), plan, []) == []


def test_numbers_of_a_filter_have_the_units_of_their_states(comparisons):
    problem, _ = comparisons[3, False]
    table = choice_table({"rule of thumb": untuned_choice("kf", problem)}, problem)
    heads = ["Q11 [m^2]", "Q22 [(m/s)^2]", "Q33 [m^2]", "R11 [m^2]", "R22 [(m/s)^2]"]
    assert [row[0] for row in table.rows] == heads
    assert "R22 [(m/s)²]" in table.html()


ODD = [r"$\frac$", "[/]", "[bold]x[/bold]", "a|b", "<b>x</b>", "[x](http://y)", r"$\alpha$ $", "&lt;", "n" * 400]


def model(name, unit="N"):
    inputs, sensors = [(name, "u", unit)], [(f"{name} read", "z", unit)]
    quantities = {"states": [(name, "x", unit)], "input_quantities": inputs, "measurements": sensors}
    return affine([[0.9]], [[0.5]], [[1.0]], q=[0.01], r=[0.04], mean=[0.0], cov=[1.0], **quantities)


@pytest.mark.parametrize("name", ODD)
def test_labels_of_figures_show_a_name_as_it_is(name):
    figure = Figure()
    axis = figure.subplots()
    axis.set_title(verbatim(name, most=90))
    axis.set_ylabel(Quantity(name, "omega_m", name[:20]).plot_label)
    figure.savefig(io.BytesIO(), format="svg")
    assert verbatim(name).replace(r"\$", "$") == name and len(verbatim(name, most=90)) < 100
    assert verbatim("log L of the\ninnovations\a") == "log L of the\ninnovations?"


@pytest.mark.parametrize("name", [r"$\frac$", "[/]", "n" * 400])
def test_a_log_of_odd_names_is_drawn(name):
    rng = np.random.default_rng(0)
    table = {"t": 0.1 * np.arange(200), "u": rng.normal(size=200), "z": rng.normal(size=200), "x": np.zeros(200)}
    found = tuning.estimate((model(name, unit=r"$\frac"), table))
    for figure in (found.plot_states(), found.plot_innovations()):
        figure.savefig(io.BytesIO(), format="png")


@pytest.mark.parametrize("name", ODD)
def test_names_are_no_markup_where_work_is_shown(name):
    stream = io.StringIO()
    with working(name, Console(file=stream, force_terminal=True, width=500)):
        pass
    assert name.split()[0] in stream.getvalue()


def test_names_are_text_in_markdown_and_html():
    for name in ODD:
        page = markdown_page(name, [name, Table(name, ["", name], [[name, name]])])
        for raw in ("[x](http", "<b>", "| a|b", "$"):
            at = page.find(raw)
            assert at < 0 or page[at - 1] == "\\" or raw == "| a|b"
        assert "a|b" not in page and "&lt;" not in page and "\n$" not in page
        assert "<b>" not in Table(name, ["", name], [[name, name]]).html()


def halves(n, m):
    """A problem of n states of which m are measured, each half of what it was."""
    of_state, of_sensor = {"q": np.ones(n), "mean": np.zeros(n), "cov": np.ones(n)}, {"r": np.ones(m)}
    model = affine(0.5 * np.eye(n), np.zeros((n, 1)), np.eye(n)[:m], **of_state, **of_sensor)
    return ModelProblem(model, inputs=[0.0] * 60, scale=np.ones(n))


def with_pairs(cov, pairs):
    """Rows of a symmetric matrix, of which pairs of entries are other ones."""
    cov = np.array(cov)
    for (i, j), value in pairs.items():
        cov[i, j] = cov[j, i] = value
    return tuple(map(tuple, cov.tolist()))


def test_variances_that_are_the_same_share_a_row_and_correlations_stand_where_q_does():
    problem = halves(5, 2)
    equal = Choice("ekf", {"process_noise_cov": (2.0,) * 5, "measurement_noise_cov": (1.0, 3.0)}, {})
    silent = Choice("ekf", {}, {})
    rows = number_rows([equal, silent], "ekf", problem, str)
    assert rows == [["Q11 to Q55", "2.0", "None"], ["R11", "1.0", "None"], ["R22", "3.0", "None"]]
    own = equal._replace(model={"process_noise_cov": with_pairs(np.diag([1.0, 2, 2, 2, 2]), {})})
    assert number_rows([own], "ekf", problem, str)[:2] == [["Q11", "1.0"], ["Q22 to Q55", "2.0"]]
    tied = Choice("ekf", {"process_noise_cov": with_pairs(np.eye(5), {(0, 1): 0.5})}, {})
    found = {row[0]: row[1:] for row in number_rows([tied, equal, silent], "ekf", problem, str)}
    assert found["largest of 10 Q correlations"] == ["0.5", "0.0", "None"]


@pytest.mark.parametrize(("m", "labels"), [(3, ["R correlation 12", "R correlation 13", "R correlation 23"]),
                                           (4, ["largest of 6 R correlations"])])  # fmt: skip
def test_correlations_of_r_of_four_channels_are_one_row_like_those_of_q(m, labels):
    choice = Choice("ekf", {"measurement_noise_cov": with_pairs(np.eye(m), {(0, 1): 0.5, (0, 2): -0.6})}, {})
    found = {row[0]: row[1:] for row in number_rows([choice], "ekf", halves(m, m), lambda v: f"{v:.2f}")}
    assert [label for label in found if "correlation" in label] == labels
    assert m == 3 or found[labels[0]] == ["-0.60"]


def test_correlations_of_many_states_are_one_row_and_two_digits_stand_apart():
    problem = halves(11, 1)
    assert repr(problem) == f"ModelProblem({problem.name!r})"
    q = with_pairs(np.diag(1.0 + np.arange(11)), {(0, 1): -0.8 * np.sqrt(2.0)})
    rows = number_rows([Choice("ekf", {"process_noise_cov": q}, {})], "ekf", problem, str)
    assert [row[0] for row in rows if row[0].startswith("Q")][-2:] == ["Q10,10", "Q11,11"]
    (largest,) = [row for row in rows if "correlation" in row[0]]
    assert largest[0] == "largest of 55 Q correlations" and float(largest[1]) == pytest.approx(-0.8)
    assert index_pairs("Q11 and Q1010, R1111") == "Q11 and Q10,10, R11,11"
