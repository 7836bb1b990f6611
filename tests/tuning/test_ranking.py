"""Where filters differ: each claim of docs/ranking.md in a quick form whose paired interval leaves no doubt."""

import numpy as np
import pytest

from tuning.evaluation.compare import compare, contender
from tuning.plants.thruster import find_scenario
from tuning.problems.data import held_out_seeds


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


def test_estimating_an_unknown_flow_beats_the_ekf_that_believes_in_none():
    rows = ranked("ambient", [contender("ekf"), contender("ekf", unknown={"ambient_velocity": None})])
    joint = rows["ekf + U_0"]
    assert max(ratio.high for ratio in joint.ratios) < 0.97 and joint.score_ratio.high < 0.9
    assert joint.evaluation.nees.value < 3 < rows["ekf"].evaluation.nees.value


@pytest.fixture(scope="module")
def published_noise():
    contenders = [contender("ekf"), contender("iekf"), contender("enkf", ensemble_size=100), contender("gsf")]
    contenders += [contender("ienkf", ensemble_size=100), contender("pf")]
    return ranked("published_noise", contenders)


def test_with_the_published_noise_the_ekf_is_overconfident(published_noise):
    assert published_noise["ekf"].evaluation.nees.low > 15
    assert published_noise["ekf"].above_bound[1] > 5


def test_there_an_ensemble_of_100_has_at_most_seven_tenths_of_its_error(published_noise):
    assert published_noise["enkf 100"].ratios[1].high < 0.7
    assert 2 < published_noise["enkf 100"].evaluation.nees.value < 3


@pytest.mark.parametrize("label", ["pf 1000", "gsf", "ienkf 100"])
def test_there_a_filter_that_sees_two_modes_or_iterates_has_at_most_half_of_its_error(label, published_noise):
    assert published_noise[label].ratios[1].high < 0.5
    assert published_noise[label].ratios[1].high < published_noise["enkf 100"].ratios[1].low


def test_there_iteration_brings_the_ekf_to_half_and_an_honest_covariance(published_noise):
    assert published_noise["iekf"].ratios[1].high < 0.55
    assert published_noise["iekf"].evaluation.nees.value < 3
