"""The experiment on BROAD: its three errors in closed form, and its reading of trials, made here."""

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation as Turned

from thruster_env.model import rotations
from tuning.experiments import broad


def scalar_first(turned):
    return turned.as_quat()[:, [3, 0, 1, 2]]


def test_errors_of_heading_and_of_inclination():
    """About up all is heading, about a level axis of the world all is inclination."""
    reference = Turned.random(50, rng=1)
    counts = np.ones(50, bool)
    heading, level = np.radians(12.0), np.radians(5.0)
    about_up, about_east = Turned.from_rotvec([0, 0, -heading]), Turned.from_rotvec([level, 0, 0])
    for turn, expected in (
        (about_up, (12.0, 0.0, 12.0)),
        (about_east, (5.0, 5.0, 0.0)),
        (about_up * about_east, (np.degrees(2 * np.arccos(np.cos(heading / 2) * np.cos(level / 2))), 5.0, 12.0)),
    ):
        q = scalar_first(turn * reference)
        found = broad.errors(-q, scalar_first(reference), counts)  # q and -q are one attitude
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_errors_count_rows_in_motion_with_a_reference():
    reference = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
    reference[3] = np.nan
    estimated = np.array([rotations.exponential((0.0, 0.0, angle)) for angle in (1.0, 0.1, 0.2, 3.0)])
    found = broad.errors(estimated, reference, np.array([False, True, True, True]))
    assert found.total == pytest.approx(np.degrees(np.sqrt((0.1**2 + 0.2**2) / 2)))


@pytest.fixture
def folder(tmp_path):
    """Two trials of 20 s that turn about a moving axis, the last 16 in motion, as BROAD's files have them."""
    rate, draw = 100.0, np.random.default_rng(2).normal
    time = np.arange(2000) / rate
    for name in ("02_made", "03_made"):
        swing = np.where(time > 4.0, 1.0, 0.0)[:, None] * np.column_stack(
            [np.sin(1.3 * time), np.cos(0.7 * time), 0.5 * np.sin(0.4 * time)]
        )
        q = [rotations.exponential((0.05, -0.1, 0.7))]
        for step in swing[1:]:
            q.append(rotations.product(q[-1], rotations.exponential(step / rate)))
        q = np.array(q)
        field = 45.0 * np.array([0.0, np.cos(np.radians(69.0)), -np.sin(np.radians(69.0))])
        arrays = {
            "imu_gyr": swing + 0.01 + 1e-3 * draw(size=(2000, 3)),
            "imu_acc": np.array(rotations.to_body(q.T, (0.0, 0.0, 9.815))).T + 0.02 * draw(size=(2000, 3)),
            "imu_mag": np.array(rotations.to_body(q.T, tuple(field))).T + 0.3 * draw(size=(2000, 3)),
            "opt_quat": q,
            "movement": (time > 4.0)[:, None],
            "sampling_rate": rate,
        }
        savemat(tmp_path / f"{name}.mat", arrays)
    return tmp_path


def test_trials_are_read_and_filtered(folder):
    trials = broad.read_trials(folder)
    assert [*trials] == ["02", "03"]
    assert trials["02"].rate == 100.0
    numbers = {"field": 45.0, "dip": 69.0, "magnetometer": 0.3, "acceleration": 0.02, "gravity": 9.815}
    computed = broad.rows(trials, numbers)
    for row in computed:
        for found in row.by_trial.values():
            assert found.total < 0.4
            assert found.total**2 == pytest.approx(found.heading**2 + found.inclination**2, rel=1e-3)
    assert computed[1].over(broad.TRAINING).total <= computed[0].over(broad.TRAINING).total
    tables = broad.tables_of(computed)
    assert [row[0] for row in tables["broad_trials"].rows] == ["02", "03"]
    assert tables["broad"].rows[0][3] == ""  # the disturbed trial is not there


def test_a_folder_that_is_not_of_broad(tmp_path, folder):
    with pytest.raises(ValueError, match=r"must have one of trials 02, 07, 11, 16 as NAME_\*.mat"):
        broad.read_trials(tmp_path / "none")
    savemat(folder / "02_made.mat", {"imu_gyr": np.zeros((9, 3)), "imu_acc": np.zeros((9, 2))})
    with pytest.raises(ValueError, match="must have an array imu_acc of 3 columns, but .*02_made.mat has"):
        broad.read_trials(folder)
