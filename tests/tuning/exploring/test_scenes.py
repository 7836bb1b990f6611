"""What each guided scene says is so."""

import pytest

from tuning.exploring.bench import OWN, SCENES, Bench
from tuning.problems.find import find_problem

every_scene = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)


@every_scene
def test_one_sees_what_a_scene_says(scene):
    before, after = scene.view(0), scene.view(len(scene.steps) - 1)
    for one in scene.seen:
        ratio = after.figures[one.figure].value / before.figures[one.figure].value
        assert one.low <= ratio <= one.high, one.figure


@every_scene
def test_a_scene_moves_knobs_that_there_are(scene):
    knobs = {knob.name for knob in scene.bench().knobs}
    assert set(scene.knobs) <= knobs
    assert scene.state in {state.symbol for state in scene.bench().states}
    first, last = scene.steps[0], scene.steps[-1]
    moved = {name for name in last.values if last.values[name] != first.values.get(name)}
    assert moved <= set(scene.knobs)


def test_there_are_six():
    assert list(SCENES) == ["ridge", "lag", "outliers", "tangent", "ensemble", "constant"]


def test_along_the_ridge_every_estimate_stays():
    before, after = (SCENES["ridge"].view(step) for step in (0, 1))
    assert after.estimate[:, 200:] == pytest.approx(before.estimate[:, 200:], rel=0.05, abs=0.2)
    assert after.deviation[:, 200:] == pytest.approx(30**0.5 * before.deviation[:, 200:], rel=0.1)


def test_a_lag_shows_in_the_autocorrelation():
    before, after = (SCENES["lag"].view(step) for step in (0, 1))
    assert before.autocorrelation[0, 0] > 0.5 > 0.1 > abs(after.autocorrelation[0, 0])


def test_a_robust_filter_does_better_than_any_r():
    problem = find_problem("outliers")
    lowest = Bench(problem).map(OWN, "Q22", "R", 12).score.min()
    robust = Bench(problem, "ekf-robust").view(OWN)
    assert robust.figures["score: mean RMSE over bound"].value < 0.95 * lowest


def test_no_q_makes_up_for_a_wrong_constant():
    wrong, right = Bench(find_problem("mismatch")), Bench(find_problem("nominal"))
    lowest = wrong.map(OWN, "Q11", "Q22", 10, seeds=4).score.min()
    assert lowest > 2.5 * right.map(OWN, "Q11", "Q22", 10, seeds=4).score.min()
    errors = SCENES["constant"].view(0)
    off = (errors.estimate - errors.truth)[..., 0]
    fast = abs(errors.truth[..., 0]) > 100.0
    assert (abs(errors.estimate[..., 0]) < abs(errors.truth[..., 0]))[fast].mean() > 0.95  # too slow, either way
    assert abs(off[fast]).mean() > 5.0
