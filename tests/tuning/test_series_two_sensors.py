"""Columns that measure one quantity, which a fit of axes takes for two."""

import numpy as np

import tuning

RNG = np.random.default_rng(4)
LEVEL, OTHER = (np.cumsum(RNG.normal(0.0, 0.3, 300)) for _ in range(2))
A, B = RNG.normal(0.0, 0.5, (2, 300))


def sentences(*columns):
    fit = tuning.fit(np.stack(columns, axis=1), dt=0.1, model="constant")
    return " ".join(fit.sentences())


def test_two_sensors_of_one_quantity_are_said():
    text = sentences(LEVEL + A, LEVEL + B)
    assert "z_1 and z_2 differ by their noise alone" in text and "filter both with one state" in text
    assert "by their noise" in sentences(LEVEL + A, LEVEL + B + 7.0)  # with a bias


def test_axes_with_signals_of_their_own_have_not():
    missing = np.where(np.arange(300) % 2 == 0, np.nan, OTHER + B)
    assert "by their noise" not in sentences(LEVEL + A, OTHER + B)
    assert "by their noise" not in sentences(LEVEL + A, missing)
    assert "by their noise" not in sentences(A, B)  # no signal
    never = np.where(np.arange(300) % 2 == 1, np.nan, LEVEL + A)
    assert "by their noise" not in sentences(never, missing)
