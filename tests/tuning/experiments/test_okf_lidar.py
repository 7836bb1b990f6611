"""OKF's lidar: the same filter as the package's, and the table in a quick form."""

import numpy as np
import pytest

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
    markdown,
)


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
def test_the_table_in_its_quick_form():
    rows = compared(24, 12, 1, methods={name: one for name, one in METHODS.items() if name != "EM"})
    names = [row.name for row in rows]
    assert names[0] == (OKF if is_installed() else NOISE) and len(set(names)) == len(names)
    found = {row.name: row for row in rows}
    assert found[GRADIENT].over(found[NOISE]).value < 1.05
    text = markdown(rows)
    assert text.count("\n") == len(rows) + 1 and (IN_A_FIFTH in text) == is_installed()
