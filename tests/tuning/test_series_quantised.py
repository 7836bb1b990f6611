"""Columns of coarse resolution: slow signals whose numbers stay for many rows."""

import numpy as np
import pytest

import tuning
from thruster_env.logs.findings import resolution_of_values, unmeasured

ROWS = np.arange(1000)
RNG = np.random.default_rng(2)
CHARGE = np.round(100.0 - 0.03 * ROWS + np.cumsum(RNG.normal(0.0, 0.02, 1000)))  # per cent
NOISY = np.round(20.0 + np.cumsum(RNG.normal(0.0, 0.1, 1000)) + RNG.normal(0.0, 0.3, 1000), 1)


@pytest.mark.parametrize(
    "values", [CHARGE, np.round(100.0 - 0.01 * ROWS), np.cumsum(RNG.random(1000) < 0.3), 12.3 + 0.1 * (ROWS // 7)]
)
def test_a_channel_that_moves_by_single_steps_is_quantised_and_no_slower_sensor(values):
    left_out, texts = unmeasured(values.astype(float))
    assert not left_out.any() and not texts


@pytest.mark.parametrize("values", [np.repeat(NOISY[:200], 5), np.repeat(np.cumsum(RNG.random(200)), 5)])
def test_a_slower_sensor_is_still_one(values):
    assert unmeasured(values)[0].sum() == 800


@pytest.mark.parametrize(
    ("values", "step"), [(CHARGE, 1.0), (NOISY, 0.1), (0.25 * CHARGE + 1e6, 0.25), (RNG.normal(size=100), 0.0)]
)
def test_resolution_of_values(values, step):
    assert resolution_of_values(values) == pytest.approx(step, rel=1e-6)


def test_rounding_that_looks_like_signal_is_said():
    level = np.round(20.0 + 2.0 * np.sin(ROWS / 700.0), 1)
    fit = tuning.fit(level, dt=1.0, model="local-trend")
    text = " ".join(fit.sentences())
    assert fit.r < 1e-4
    assert "z changes in steps of 0.1, and 9" in text and "R is at least 0.1^2/12 = 0.000833" in text
    assert fit.jumps and "jumps" not in text and fit.as_dict()["jumps"] == []  # by one step of the resolution each


def test_rounding_below_the_noise_is_not():
    fit = tuning.fit(NOISY, dt=1.0, model="constant")
    assert "in steps of" not in " ".join(fit.sentences())
    assert fit.r == pytest.approx(0.09, rel=0.2)


def test_a_state_of_charge_has_all_its_rows():
    fit = tuning.fit(CHARGE, dt=1.0, model="constant-velocity")
    assert len(fit.column.values) == 1000 and "repeats are left out" not in str(fit)
    assert "R is at least 1^2/12 = 0.0833" in " ".join(fit.sentences())
