import json
import os
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from filters.augmented import Unknown
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from thruster_env.core.compiled import interpreted
from thruster_env.core.parallel import IN_PROCESS, task_map
from thruster_env.model.affine import affine_model
from tuning.evaluation.compare import Leaderboard, Row, compare, contender, sized, winners
from tuning.evaluation.evaluate import Evaluation, evaluate, score_ratio
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.tuned import write_tuned
from tuning.plants.thruster import find_scenario
from tuning.problems.assumed import default_belief
from tuning.problems.data import held_out_seeds
from tuning.problems.model_problem import ModelProblem
from tuning.search.plan import Plan
from tuning.search.space import oracle_choice, untuned_choice
from tuning.search.study import StudyResult

EVALUATION = Evaluation(*[None] * len(Evaluation._fields))
NOMINAL, SEEDS = find_scenario("nominal"), held_out_seeds(0, 12)


def test_a_row_is_the_filter_s_evaluation_beside_the_first_one_s():
    contenders = [contender("ekf"), contender("ukf", "untuned")]
    (board,), interrupted = compare(contenders, [NOMINAL], SEEDS)
    assert not interrupted and [row.label for row in board.rows] == ["ekf", "ukf"]
    data = NOMINAL.data(SEEDS)
    ekf = evaluate(oracle_choice("ekf", NOMINAL).filter(NOMINAL), data, NOMINAL.scale)
    ukf = evaluate(untuned_choice("ukf", NOMINAL).filter(NOMINAL), data, NOMINAL.scale)
    first, second = board.rows
    assert first.evaluation.rmse == ekf.rmse and second.evaluation.rmse == ukf.rmse
    assert first.score_ratio == (1.0, 1.0, 1.0) and first.verdict == "tie"
    assert second.score_ratio == score_ratio(ukf, ekf) and second.verdict == "worse"
    np.testing.assert_allclose(board.bound, NOMINAL.bound(data))
    expected = [e.value / b - 1 for e, b in zip(ekf.rmse, board.bound, strict=True)]
    np.testing.assert_allclose(first.above_bound, expected)
    assert first.microseconds > 0 and first.nees == ekf.nees.value and not first.nees_is_median


def test_particle_filters_have_a_thousand_particles_and_are_judged_by_the_median():
    contenders = [contender("ekf"), contender("pf"), contender("enkf", ensemble_size=7)]
    (board,), _ = compare(contenders, [NOMINAL], SEEDS)
    ekf, pf, enkf = board.rows
    assert (pf.label, enkf.label) == ("pf 1000", "enkf 7")
    assert pf.nees_is_median and pf.nees == pf.evaluation.median_nees
    assert 1.2 < pf.nees < 1.7 and 1.2 < ekf.evaluation.median_nees < 1.6  # chi-square's is 1.386
    assert enkf.evaluation.score.value > ekf.evaluation.score.value


def test_an_augmented_filter_is_judged_by_the_plant_s_states():
    ambient = find_scenario("ambient")
    plain, joint = contender("ekf"), contender("ekf", unknown={"ambient_velocity": Unknown(0.5, 0.02)})
    assert joint.label == "ekf + U_0" and contender("enkf", inflation=1.1).label == "enkf 30 inflation 1.1"
    assert contender("rbpf", sampled=(0, 1)).label == "rbpf 100 sampled 0, 1"
    assert contender("pf", ensemble_size=9, proposal="optimal").label == "pf 9 proposal optimal"
    model = joint.filter(ambient).model
    assert model.n == 3 and model.prior_cov[2, 2] == 0.25 and model.process_noise_cov[2, 2] == pytest.approx(4e-4)
    (board,), _ = compare([plain, joint], [ambient], SEEDS)
    assert board.rows[1].verdict == "better" and len(board.rows[1].ratios) == 2
    assert board.rows[1].evaluation.nees.value < board.rows[0].evaluation.nees.value


def test_what_is_believed_by_default_and_sizes_are_of_ensembles():
    assert default_belief("ambient_velocity", 0.0) == Unknown(0.5, 0.01)
    assert default_belief("load_gain", -20.0) == Unknown(4.0, pytest.approx(0.08))
    refused("the assumed asymmetry, .* must be positive, but got 0.0", default_belief, "asymmetry", 0.0)
    assert sized(oracle_choice("ekf", NOMINAL), 50) == oracle_choice("ekf", NOMINAL)
    assert sized(oracle_choice("enkf", NOMINAL), 50).numbers["ensemble_size"] == 50
    assert sized(oracle_choice("enkf", NOMINAL), None).numbers["ensemble_size"] == 30


def scored(mean_squares, first=None):
    """A row and the first one, with these mean square errors by run."""
    one = EVALUATION._replace(mean_squares=np.array(mean_squares)[:, None], scale=np.ones(1), states=())
    ratio = score_ratio(one, first.evaluation if first else one)
    return Row("b" if first else "a", "ekf", one, None, 0.0, False, 0.0, (), ratio, ratio)


@pytest.mark.parametrize(
    ("squares", "said"),
    [
        (np.full(30, 1.0004), "b (by 0.02 %: practically equal) is worse than a."),
        (np.full(30, 0.9), "b is better than a."),
        ([1e4, *np.full(29, 0.5)], "b (undecided: few runs dominate; the median ratio of a run is 0.71) is not "),
    ],
)
def test_a_verdict_says_how_much_it_is_worth(squares, said):
    first = scored(np.ones(30))
    board = Leaderboard(NOMINAL, range(30), np.ones(1), [first, scored(squares, first)])
    assert winners(board).startswith(f"By the score on nominal, {said}")


@pytest.mark.parametrize(
    ("call", "rule"),
    [
        (lambda: compare([], [NOMINAL], SEEDS), "a comparison must be of different filters, but got none"),
        (lambda: contender("enkf", ensemble_size=1).filter(NOMINAL), "ensemble_size must be"),
        (
            lambda: contender("ekf", unknown={"colour": None}).filter(NOMINAL),
            "a constant to estimate must be one of motor_damping, .*, but got 'colour'",
        ),
        (
            lambda: contender("ekf", unknown={"ambient_velocity": None}).filter(find_scenario("published_tunnel")),
            "a constant to estimate must be one of ",
        ),
        (
            lambda: contender("kf", unknown={"k": None}).filter(LinearProblem()),
            "one of the model's, but it has none, and got 'k': give the StateSpaceModel a NamedTuple as constants",
        ),
    ],
)
def test_wrong_arguments_are_refused_with_the_rule_and_the_value(call, rule):
    refused(rule, call)


def interrupt_at(label):
    def on_row(scenario, shown):
        if shown == label:
            os.kill(os.getpid(), signal.SIGINT)

    return on_row


def test_ctrl_c_keeps_the_rows_that_are_done():
    contenders = [contender(name) for name in ("ekf", "ukf", "ckf")]
    with ThreadPoolExecutor(1) as pool, task_map(pool) as elsewhere:
        for tasks, most in ((IN_PROCESS, 1), (elsewhere, 2)):  # which may have begun the next
            (board,), interrupted = compare(contenders, [NOMINAL] * 2, SEEDS, interrupt_at("ukf"), tasks)
            assert interrupted and [row.label for row in board.rows] in (["ekf"], ["ekf", "ukf"][:most])


@pytest.fixture
def command(thruster):
    return lambda *arguments: thruster("compare", *arguments)


def test_the_command_ranks_filters_on_scenarios(command, tmp_path):
    options = ("--filter", "ekf", "--filter", "ekf-robust", "--seeds", 8, "--knows", "true")
    code, out, _ = command(*options, "--scenario", "outliers", "--scenario", "nominal", "--json", "board.json")
    assert code == 0
    for word in ("one measured thrust in twenty", "RMSE on held-out seeds 500000 to 500007", "rad/s", "bound"):
        assert word in out
    assert "By the score on outliers, ekf-robust is better than ekf." in out
    assert "Q and R: the plant's own (oracle; --knows true)." in out
    content = json.loads((tmp_path / "board.json").read_text())
    assert content["seeds"] == [500000, 500008] and set(content["scenarios"]) == {"outliers", "nominal"}
    row = content["scenarios"]["outliers"]["filters"]["ekf-robust"]
    assert row["verdict"] == "better" and row["score_over_first"][2] < 1 and row["divergences"] == 0
    assert len(row["rmse_over_first"]) == 2 and row["microseconds_a_step"] > 0


def test_the_command_takes_tuned_files(command, tmp_path):
    scenario = find_scenario("mismatch")
    choice = untuned_choice("enkf", scenario)
    evaluation = evaluate(choice.filter(scenario), scenario.data([1, 2]), scenario.scale)
    comparison = Comparison(evaluation, evaluation, evaluation, np.array(scenario.scale), range(2))
    result = StudyResult(choice, 1.0, [], [], 0.0, False)
    write_tuned(tmp_path / "mine.json", Plan("enkf", (scenario,)), result, [comparison], "s")
    code, out, _ = command("mine.json", "--filter", "ekf", "--seeds", 4, "--ensemble-size", 20, "--knows", "true")
    assert code == 0 and "mismatch:" in out and "Over mine, paired" in out
    assert "Q and R: of mine the tuned ones; of ekf the plant's own (oracle; --knows true)." in out
    code, out, _ = command("mine.json", "--seeds", 4, "--scenario", "nominal")
    assert code == 0 and "On nominal no other filter can be compared with mine." in out


def small_unknown(r=1.0):
    """A walk that drifts, and a model that knows nothing of the drift: its Q is not the plant's."""
    noise = {"measurement_noise_cov": [1.0], "c": [[1.0, 0.0]]}
    start = {"prior_mean": [0.0, 0.1], "prior_cov": [1.0, 0.01], "process_noise_cov": [0.1, 1e-4]}
    truth = affine_model(a=[[0.9, 1.0], [0.0, 0.9]], b=np.zeros((2, 0)), states=["x", "y"], **noise, **start)
    one = {"prior_mean": [0.0], "prior_cov": [1.0], "process_noise_cov": [0.1], "measurement_noise_cov": [r]}
    assumed = affine_model(a=[[0.9]], b=np.zeros((1, 0)), c=[[1.0]], states=["x"], **one)
    return ModelProblem(truth, assumed, steps=60, scale=(1.0,))


def test_where_nobody_knows_the_plants_noise_filters_have_the_scaled_default_or_what_the_model_came_with(
    command, monkeypatch
):
    options = "--filter", "ekf", "--problem", "of_their_own:problem", "--seeds", 2
    given = "those that the model came with (--knows given). There is no scaled default: no factor on Q"
    for r, noise in ((1.0, "the scaled default (--knows scaled)."), (1e12, given)):
        monkeypatch.setitem(sys.modules, "of_their_own", SimpleNamespace(problem=small_unknown(r)))
        with interpreted():
            code, out, errors = command(*options)
        assert code == 0, errors
        assert f"Q and R: {noise}" in " ".join(out.split())
    with interpreted():
        refused, _, rule = command(*options, "--knows", "scaled")
    assert refused == 2 and "ekf must have a scaled default on of_their_own:problem, but no factor on Q" in rule


def ranked(name, contenders, seeds=24):
    """Rows of a leaderboard by label."""
    (board,), _ = compare(contenders, [find_scenario(name)], held_out_seeds(0, seeds))
    return {row.label: row for row in board.rows}


@pytest.mark.slow
def test_with_a_tachometer_without_a_sign_the_particle_filter_beats_the_ekf():
    rows = ranked("speed_magnitude", [contender("ekf"), contender("pf", ensemble_size=2000)], 12)
    assert rows["pf 2000"].ratios[0].high < 0.9  # omega_m, whose sign is in question
    assert rows["pf 2000"].evaluation.log_likelihood > rows["ekf"].evaluation.log_likelihood + 10


def test_a_robust_update_beats_the_ekf_among_outliers():
    rows = ranked("outliers", [contender("ekf"), contender("ekf-robust")])
    assert max(ratio.high for ratio in rows["ekf-robust"].ratios) < 0.8
    assert np.max(rows["ekf-robust"].above_bound) < 0.1
    assert rows["ekf-robust"].evaluation.nees.value < 3 < rows["ekf"].evaluation.nees.value


@pytest.fixture(scope="module")
def published_noise():
    contenders = [contender(name) for name in ("ekf", "iekf", "gsf", "pf")]
    contenders += [contender(name, ensemble_size=100) for name in ("enkf", "ienkf")]
    return ranked("published_noise", contenders)


def test_with_the_published_noise_members_modes_and_iteration_beat_the_overconfident_ekf(published_noise):
    ekf, iekf, ensemble = (published_noise[label] for label in ("ekf", "iekf", "enkf 100"))
    assert ekf.evaluation.nees.low > 15 and ekf.above_bound[1] > 5
    assert ensemble.ratios[1].high < 0.7 and 2 < ensemble.evaluation.nees.value < 3
    assert iekf.ratios[1].high < 0.55 and iekf.evaluation.nees.value < 3
    for label in ("pf 1000", "gsf", "ienkf 100"):
        assert published_noise[label].ratios[1].high < min(0.5, ensemble.ratios[1].low), label
