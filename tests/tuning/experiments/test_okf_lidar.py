"""OKF's lidar: the same filter as the package's, and the table in a quick form."""

import numpy as np
import pytest

from tuning.evaluation.baselines import with_covariances
from tuning.experiments.lidar import (
    BEARING,
    GRADIENT,
    IN_A_FIFTH,
    METHODS,
    NOISE,
    OKF,
    RANGE,
    compared,
    drawn,
    is_installed,
    lidar_problem,
    markdown,
    okf_itself,
    row_of,
)
from tuning.search.space import untuned_choice

with_okf = pytest.mark.skipif(not is_installed(), reason="the package Optimized-Kalman-Filter is not installed")


def test_targets_turn_and_are_seen_in_range_and_bearing():
    runs = drawn(300, seed=3)
    assert {len(one.states) for one in runs} <= set(range(1 + 4 * 5, 2 + 6 * 8))
    noise = []
    for states, seen in runs:
        velocity, moved = states[:-1, 2:], np.diff(states, axis=0)
        np.testing.assert_allclose(moved[:, :2], velocity + 0.5 * moved[:, 2:], atol=1e-9)
        ranges = np.hypot(*states[:, :2].T) - np.hypot(*seen.T)
        turned = np.arctan2(*seen.T[::-1]) - np.arctan2(*states[:, 1::-1].T)
        noise.append(np.column_stack([ranges, (turned + np.pi) % (2 * np.pi) - np.pi]))
    deviations = np.median(abs(np.concatenate(noise)), axis=0) / 0.6745
    np.testing.assert_allclose(deviations, [RANGE, BEARING], rtol=0.05)
    np.testing.assert_array_equal(drawn(5, seed=1)[4].states, drawn(5, seed=1)[4].states)


@pytest.mark.slow
@with_okf
def test_our_filter_is_the_packages():
    from okf import OKF as OptimizedFilter
    from okf import test_model as mean_loss
    from okf.example.simple_lidar_model import model_args

    runs = drawn(24)
    problem = lidar_problem(runs, 8)
    model = OptimizedFilter(**model_args(), optimize=True)
    states, seen = [one.states for one in runs], [one.measurements for one in runs]
    model.estimate_noise(states[:16], seen[:16])
    choice = with_covariances(untuned_choice("kf", problem), model.get_Q(), model.get_R())
    ours = row_of("", choice, 0.0, problem, problem.data(range(16, 24)))
    assert ours.mse == pytest.approx(mean_loss(model, seen[16:], states[16:]), rel=1e-9)


@with_okf
def test_the_package_begins_at_noise_estimation_and_leaves_it():
    q, r = okf_itself(drawn(40))
    for one in (q, r):
        assert (np.linalg.eigvalsh(one) > 0).all()


@pytest.mark.slow
def test_the_table_in_its_quick_form():
    rows = compared(24, 12, 1, methods={name: one for name, one in METHODS.items() if name != "EM"})
    names = [row.name for row in rows]
    assert names[0] == (OKF if is_installed() else NOISE) and len(set(names)) == len(names)
    found = {row.name: row for row in rows}
    assert found[GRADIENT].over(found[NOISE]).value < 1.05
    text = markdown(rows)
    assert text.count("\n") == len(rows) + 1 and (IN_A_FIFTH in text) == is_installed()
