"""The recorded ROV thruster and BROAD: on runs of our own and, where there are any, on the recorded ones."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation as Turned

from tests.filters.checks import refused
from thruster_env.core.streams import episode_keys
from thruster_env.model import rotations
from thruster_env.model.simulate import simulate
from tuning.experiments import broad, recordings
from tuning.experiments.recordings import CHOSEN, LOOKUP, OURS, OWN, STATIC_MAP, STRUCTURES, Structure
from tuning.experiments.recordings_model import DT, clock_offset, model, read_recordings, to_identify
from tuning.likelihood.result import valued

RECORDED = Path(__file__).parents[4] / "shared" / "data" / "rov_thruster"
TRUTH = {"inertia": 0.01, "thrust_factor": 1.2e-3, "dead_band_high": 0.9, "Q11": 1.0, "Q22": 0.04, "R22": 0.04}
OFFSET = 0.05
SERIES = "times", "command", "flow", "tachometer", "load", "own", "desired"
HEADER = (
    "t_s,Td_N,n_desired_rad_s,u_cmd_V,y_tach_abs_rad_s,y_flow_m_s,loadcell_thrust_N,loadcell_torque_Nm,"
    "loadcell_tach_abs_rad_s,authors_nhat_rad_s,authors_vhat_axial_m_s,authors_vahat_ambient_m_s"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two runs of our own in the recorder's form, the load cell's clock ahead by 0.05 s."""
    folder = tmp_path_factory.mktemp("recorded")
    times = DT * np.arange(251)
    commands = [2.5 * np.sin(2 * np.pi * times / 10), np.where(times < 5, -2.5, 2.0)]
    made = valued(to_identify(), TRUTH)
    runs = simulate(made, episode_keys([1, 2]), np.stack(commands)[:, :-1, None])
    for place, name in enumerate(("Ramp", "CLLookupStep")):
        tachometer, load = runs.measurements[place].T
        shifted = [np.interp(times - OFFSET, times, one) for one in (load, tachometer)]
        own = np.full_like(times, np.nan) if place else 1.1 * runs.states[place, :, 0]
        zero = np.zeros_like(times)
        measured = times, load + 1.0, zero, commands[place], tachometer, zero
        columns = *measured, shifted[0], zero, shifted[1], own, zero, zero
        text = [",".join(f"{value:.8g}" for value in row) for row in np.stack(columns, axis=1)]
        (folder / f"{name}.csv").write_text("\n".join([HEADER, *text]), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def runs(folder):
    return read_recordings(folder)


def test_the_clock_offset_is_read_off_the_two_tachometers(runs):
    times = DT * np.arange(300)
    here = np.sin(times) + np.sin(3.1 * times)
    late = np.sin(times - 0.033) + np.sin(3.1 * (times - 0.033))
    assert clock_offset(times, here, late) == pytest.approx(0.033, abs=2e-3)
    assert runs[1].offset == pytest.approx(OFFSET, abs=1e-2)
    assert runs[0].name == "CLLookupStep" and runs[0].own_is_desired and not runs[1].own_is_desired
    np.testing.assert_array_equal(runs[0].own, runs[0].desired)


def test_a_run_is_a_log_on_the_recorders_clock(runs):
    log = runs[1].log()
    assert log.dt == DT and log.inputs.shape == (250, 1) and np.isnan(log.measurements[0, 0])
    there = ~np.isnan(log.measurements[:, 1])
    shifted = np.interp(runs[1].times[there] + runs[1].offset, runs[1].times, runs[1].load)
    np.testing.assert_allclose(log.measurements[there, 1], shifted, atol=1e-9)
    assert runs[1].log(ambient=True).inputs.shape == (250, 2)


def test_errors_are_averaged_and_shifted(runs):
    assert recordings.averaged(np.array([0.0, 3.0, 0.0, 0.0]), 3).tolist() == [1.5, 1.0, 1.0, 0.0]
    run = runs[1]
    exact = np.interp(run.times + run.offset, run.times, run.load)
    middle = slice(5, -5)
    assert (
        abs(recordings.error(exact, run, run.offset)[middle]).max()
        < 0.1 * abs(recordings.error(exact, run, 0.1)[middle]).max()
    )
    assert recordings.best_rmse(exact, run) <= recordings.rmse(exact, run, 0.0)
    assert recordings.rmse(run.own, run) > recordings.settled_rmse(exact, run)
    assert recordings.ratios(run.own, run) == (1.0, 1.0, 1.0)


@pytest.mark.slow
def test_numbers_found_from_runs_estimate_thrust_where_the_load_cell_is_not(runs):
    few = tuple(one for one in STRUCTURES[CHOSEN].free if one.name in ("thrust_factor", "dead_band_high", "R22"))
    fixed = {name: value for name, value in TRUTH.items() if name not in ("thrust_factor", "dead_band_high")}
    structure = Structure("few", few, fixed)
    found = recordings.identified(structure, runs)
    assert found.values["thrust_factor"] == pytest.approx(TRUTH["thrust_factor"], rel=0.05)
    assert found.values["dead_band_high"] == pytest.approx(TRUTH["dead_band_high"], abs=0.05)
    better = recordings.thrusts(structure.model(**found.values), runs)
    worse = recordings.thrusts(structure.model(thrust_factor=2e-3), runs)
    for one, other, run in zip(better, worse, runs, strict=True):
        assert len(one) == len(run.times) and recordings.settled_rmse(one, run) < 0.5 * recordings.settled_rmse(
            other, run
        )


@pytest.mark.slow
def test_more_noise_after_reversals_is_the_projects_filter_where_there_is_none(runs):
    after = recordings.after_reversal(np.array([0.0, -1.0, -1.0, *[-1.0] * 12, 2.0, 2.0]))
    assert after.tolist() == [True] * 11 + [False] * 4 + [True] * 2
    short = [runs[1]._replace(**{name: getattr(runs[1], name)[:40] for name in SERIES})]
    (one,) = recordings.regimes(valued(to_identify(), TRUTH), short, [1.0])
    ours = recordings.thrusts(valued(to_identify(), TRUTH), short)[0]
    assert one.ratio == pytest.approx(recordings.ratios(ours, short[0]).averaged, rel=1e-6)
    (more,) = recordings.regimes(valued(to_identify(), TRUTH), short, [16.0])
    assert more.nis < one.nis


@pytest.mark.slow
def test_what_is_done_is_kept_and_not_done_again(runs, tmp_path, monkeypatch):
    class Learnt:
        interrupted, log_likelihood, agreement, optima = False, -1.0, 1, (1,)

        def __init__(self, structure):
            self.values = {one.name: one.start for one in structure.free}
            self.standard_errors = dict.fromkeys(self.values, 0.1)
            self.determined = dict.fromkeys(self.values, True)

        def sentences(self):
            return []

    asked = []
    learnt = "tuning.experiments.recordings.identified"
    monkeypatch.setattr(learnt, lambda structure, *_: asked.append(structure) or Learnt(structure))
    file, told = tmp_path / "results.json", []
    tasks = recordings.identify_all(runs, file, progress=lambda *one: told.append(one))
    assert len(asked) == len(tasks) == len(recordings.tasks_of(runs)) == 3 * len(STRUCTURES)
    assert told[0] == (CHOSEN, 0, len(tasks)) and told[1][0] == f"{CHOSEN}, without CLLookupStep"
    recordings.identify_all(runs, file)
    assert len(asked) == len(tasks)
    assert len(recordings.number_rows(runs, tasks)) == len(STRUCTURES[CHOSEN].free)
    assert len(recordings.estimates_of(runs, tasks)[OURS]) == 2
    few = {name: one for name, one in STRUCTURES.items() if name in (CHOSEN, "ambient")}
    monkeypatch.setattr("tuning.experiments.recordings.STRUCTURES", few)
    assert [row[0] for row in recordings.ladder_rows(runs, tasks)] == [one.about for one in few.values()]


@pytest.mark.slow
def test_the_command_compares_with_the_recorders_own_estimate(as_json, folder, tmp_path):
    found = as_json("reproduce", "recordings", "--data", folder)
    assert [row["run"] for row in found["ratios"]] == ["CLLookupStep", "Ramp", "mean"]
    assert {OURS, OWN, STATIC_MAP, LOOKUP} <= set(found["estimators"][0])
    assert float(found["clocks"][1]["offset, s"]) == pytest.approx(OFFSET, abs=1e-2)


def test_a_folder_without_recordings_is_refused(thruster, tmp_path):
    refused = thruster("reproduce", "recordings", "--data", tmp_path)
    assert refused.returncode == 2 and "recordings must be .csv files in" in refused.stderr
    (tmp_path / "x.csv").write_text("t_s,u_cmd_V\n0,1\n1,2\n", encoding="utf-8")
    refused = thruster("reproduce", "recordings", "--data", tmp_path)
    assert refused.returncode == 2 and "a recording must have the column y_flow_m_s" in refused.stderr


@pytest.mark.skipif(not RECORDED.is_dir(), reason="the recordings are no part of this project")
def test_goals_on_the_recorded_runs():
    recorded = read_recordings(RECORDED)
    found = np.array(
        [
            recordings.ratios(one, run)
            for one, run in zip(recordings.thrusts(model(), recorded), recorded, strict=True)
        ]
    )
    averages, best, raw = found.T
    steps = np.array(["Step" in run.name for run in recorded])
    assert averages.max() <= 0.6 and averages.mean() <= 0.4 and best.max() <= 0.8
    assert raw[~steps].max() <= 0.65 and raw[steps].max() <= 0.7
    assert recordings.rmse(recorded[0].own, recorded[0], 0.0, window=1) == pytest.approx(
        1.99, abs=5e-3
    )  # as filed


def test_the_own_estimate_of_another_estimator_is_not_made_up(folder, tmp_path):
    """Coefficients of runs named CL1state are not known: these are compared with the desired thrust."""
    (tmp_path / "CL1stateKFRamp.csv").write_text((folder / "Ramp.csv").read_text())
    (run,) = read_recordings(tmp_path)
    assert run.own_is_desired
    np.testing.assert_array_equal(run.own, run.desired)


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
def broad_folder(tmp_path):
    """Two trials of 20 s that turn about a moving axis, the last 16 in motion, as BROAD's files have them."""
    rate, draw = 100.0, np.random.default_rng(2).normal
    time = np.arange(2000) / rate
    for name in ("02_made", "03_made"):
        waves = np.column_stack([np.sin(1.3 * time), np.cos(0.7 * time), 0.5 * np.sin(0.4 * time)])
        swing = np.where(time > 4.0, 1.0, 0.0)[:, None] * waves
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


def test_trials_are_read_and_filtered(broad_folder):
    trials = broad.read_trials(broad_folder)
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


def test_a_folder_that_is_not_of_broad(tmp_path, broad_folder):
    refused(r"must have one of trials 02, 07, 11, 16 as NAME_\*.mat", broad.read_trials, tmp_path / "none")
    savemat(broad_folder / "02_made.mat", {"imu_gyr": np.zeros((9, 3)), "imu_acc": np.zeros((9, 2))})
    refused("must have an array imu_acc of 3 columns, but .*02_made.mat has", broad.read_trials, broad_folder)
