"""Outliers of a column are left out of its fit and of the lines to paste; jumps and equal sensors are named."""

import math

import numpy as np
import pytest

import tuning
from tests.tuning.test_series_lines import in_c, with_cc

ROWS = 600


def walk(seed=3):
    rng = np.random.default_rng(seed)
    return np.cumsum(0.1 * rng.normal(size=ROWS)) + 0.3 * rng.normal(size=ROWS)


def with_outliers(z, share=0.03, size=50.0):
    rng = np.random.default_rng(0)
    off = np.where(rng.random(len(z)) < share, size * rng.normal(size=len(z)), 0.0)
    return z + off, np.abs(off) > 2.0


def rows_left_out(fit):
    return [] if fit.left_out is None else np.flatnonzero((~np.isnan(fit.left_out)).any(axis=1)).tolist()


@pytest.fixture(scope="module")
def fit():
    return tuning.fit(with_outliers(walk())[0], dt=0.1, model="constant")


def test_q_and_r_are_those_of_the_record_with_its_outliers_missing(fit):
    z, outliers = with_outliers(walk())
    assert rows_left_out(fit) == np.flatnonzero(outliers).tolist() and fit.gate == 4.4
    missing = tuning.fit(np.where(outliers, np.nan, z), dt=0.1, model="constant")
    assert [fit.q, fit.r] == [missing.q, missing.r]
    assert 0.075 < fit.r < 0.1 and not missing.left_out  # 0.09 is true, 80 with the outliers
    text = str(fit)
    assert f"{ROWS - outliers.sum()} numbers, one each 0.1 s, {outliers.sum()} outliers left out" in text
    assert "gate=4.4" in text and "missing" not in text


@pytest.mark.parametrize("model", ["constant", "constant-velocity"])
def test_a_record_of_normal_noise_has_no_outliers(model):
    """One record in a hundred has a number beyond the gate: of 20, more than 2 have a probability of 1e-3."""
    fits = [tuning.fit(walk(seed)[:200], dt=0.1, model=model) for seed in range(20 if model == "constant" else 5)]
    assert sum(fit.left_out is not None for fit in fits) <= 2
    assert not any(fit.jumps or fit.peaks for fit in fits)


def test_bursts_and_outliers_among_the_first_numbers_are_left_out():
    z = walk()
    z[0] += 30.0
    z[2] -= 9.0
    z[100:106] += 20.0
    z[300:304] -= 5.0
    fit = tuning.fit(z, dt=0.1, model="constant")
    assert rows_left_out(fit) == [0, 2, *range(100, 106), *range(300, 304)] and not fit.jumps


def test_few_outliers_are_left_out_whichever_model_and_numbers_they_come_with():
    """Beside a gap or a jump, many that hide each other, of rounded numbers, and of a model that does not fit."""
    z, times = walk(), np.arange(ROWS)
    gap, jump = z.copy(), z.copy()
    gap[100] += 50.0
    gap[101:125] = np.nan
    jump[300:] += 8.0
    jump[306] += 100.0
    rounded = np.round(60.0 + walk(7))
    sine = 100.0 + 20.0 * np.sin(0.02 * times) + 0.3 * np.random.default_rng(1).normal(size=ROWS)
    doubled = np.random.default_rng(2).random(ROWS) < 0.02
    many = np.random.default_rng(3).random(ROWS) < 0.15
    for numbers, off, most in (
        (gap, times == 100, 0.11),
        (jump, times == 306, 0.12),
        (np.where(doubled, 2.0 * rounded, rounded), doubled, 0.3),
        (np.where(many, 2.0 * rounded, rounded), many, 0.3),
        (np.where(doubled, 2.0 * sine, sine), doubled, 0.11),
    ):
        fit = tuning.fit(numbers, dt=0.1, model="constant")
        rows = set(rows_left_out(fit))
        assert rows >= set(np.flatnonzero(off)) and len(rows) <= off.sum() + 1 and fit.r < most


def test_an_axis_and_unequal_steps_have_outliers_of_their_own():
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.05, 0.15, size=ROWS))
    z = np.column_stack([walk(4), walk(5)])
    z[50, 0], z[400:402, 1] = 40.0, -40.0
    fit = tuning.fit(z, times=times, model="constant")
    assert np.argwhere(~np.isnan(fit.left_out)).tolist() == [[50, 0], [400, 1], [401, 1]]
    assert 0.07 < fit.r < 0.11
    assert "600 numbers" in str(fit) and "3 outliers left out" in str(fit) and "missing" not in str(fit)


def test_a_record_that_does_not_return_jumps():
    z = walk()
    z[250:] += 8.0
    fit = tuning.fit(z, dt=0.1, model="constant")
    (row, height), *further = fit.jumps
    assert row == 250 and not further and fit.left_out is None
    assert height == pytest.approx(8.0 / math.sqrt(fit.estimates.innovation_covs[0, 249, 0, 0]), rel=0.2)
    assert "The record jumps at row 250 (25 s), by " in " ".join(str(fit).split())


@pytest.mark.parametrize(
    ("z", "reason"),
    [
        (walk() + np.where(np.arange(ROWS) % 25 == 0, 8.0, 0.0), "they come each 2.5 s, so they are signal"),
        (np.where(np.random.default_rng(2).random(ROWS) < 0.03, 1.0, 0.0), "without them the others do not vary"),
        (with_outliers(walk(), share=0.35)[0], "there are more than 25 % of them"),
        (
            np.where(np.arange(ROWS) < 500, 0.05, 1.0) * np.random.default_rng(4).normal(size=ROWS),
            "they are most numbers of a stretch, which has another variance",
        ),
    ],
)
def test_peaks_that_are_no_outliers_count(z, reason):
    fit = tuning.fit(z, dt=0.1, model="constant")
    assert fit.left_out is None and fit.gate is None
    assert f"part of the fit: {reason}." in fit.peaks
    assert "session" not in fit.code("python")


def test_lines_for_filterpy_leave_out_what_a_session_with_a_gate_does(fit):
    pytest.importorskip("filterpy.kalman")
    z, _ = with_outliers(walk())
    names = {}
    exec(fit.code("python"), names)
    session = names["session"]
    session.update(z[:1])
    setup, step = fit.code("filterpy").split("# the first")
    exec(setup, names)
    kf = names["kf"]
    kf.update(z[0])
    for k, number in enumerate([*z[1:], *[100.0] * 60]):  # which jumps
        session.step([], [number])
        exec(step.split("\n", 1)[1], names | {"z": number}, names)
        np.testing.assert_allclose(kf.x[:, 0], session.mean, rtol=1e-9, atol=1e-9)
        if k == ROWS - 2:
            np.testing.assert_allclose(session.mean, fit.estimates.means[0, -1], rtol=1e-9)
            assert session.rejected == [len(rows_left_out(fit))]
    assert session.mean == pytest.approx(100.0, rel=1e-3)


@with_cc
def test_lines_for_a_controller_leave_outliers_out_and_follow_a_jump(fit, tmp_path):
    library, states = in_c(fit, tmp_path), []
    for number in with_outliers(walk())[0]:
        library.filter(number)
        states.append(library.state(0))
    off = np.array(states[50:]) - fit.estimates.means[0, 50:, 0]
    assert math.sqrt(float(np.mean(off**2))) < 0.02  # the gain is constant; the deviation of an estimate is 0.16
    for number in [math.nan] * 20 + [100.0] * 60:
        library.filter(number)
    assert library.state(0) == pytest.approx(100.0, rel=1e-3)


RNG = np.random.default_rng(4)
LEVEL, OTHER = (np.cumsum(RNG.normal(0.0, 0.3, 300)) for _ in range(2))
A, B = RNG.normal(0.0, 0.5, (2, 300))


def sentences(*columns):
    fit = tuning.fit(np.stack(columns, axis=1), dt=0.1, model="constant")
    return " ".join(fit.sentences())


def test_two_sensors_of_one_quantity_are_said_and_axes_with_own_signals_are_not():
    text = sentences(LEVEL + A, LEVEL + B)
    assert "z_1 and z_2 differ by their noise alone" in text and "filter both with one state" in text
    assert "by their noise" in sentences(LEVEL + A, LEVEL + B + 7.0)  # with a bias
    missing = np.where(np.arange(300) % 2 == 0, np.nan, OTHER + B)
    assert "by their noise" not in sentences(LEVEL + A, OTHER + B)
    assert "by their noise" not in sentences(LEVEL + A, missing)
    assert "by their noise" not in sentences(A, B)  # no signal
    never = np.where(np.arange(300) % 2 == 1, np.nan, LEVEL + A)
    assert "by their noise" not in sentences(never, missing)
