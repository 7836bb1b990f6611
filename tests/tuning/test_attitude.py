"""The model `attitude` on recordings, behind gaps, and the Allan deviation of a sensor at rest."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turned

import filters
import tuning
from filters.inertial import attitude, attitude_imu
from filters.logs.estimate import estimate, lost_in_gaps
from filters.logs.findings import findings, verdict
from filters.starts import begun_at
from tests.data.broad import RATE, broad
from thruster_env.logs.log import piece_of
from thruster_env.logs.read import read_log
from tuning.cli.main import main
from tuning.logs.allan import _fit, allan_deviation, flicker_noise, noise_of


def table_of(trial):
    """A recording as a table, and its reference quaternions."""
    columns = broad(trial)
    axes = [(name, i, axis) for name in ("gyr", "acc", "mag") for i, axis in enumerate("xyz")]
    parts = {f"{name}_{axis}": columns[name][:, i] for name, i, axis in axes}
    return {"time": np.arange(len(columns["gyr"])) / RATE, **parts}, columns["quat"]


def total_error(model, table, reference):
    """Root mean square of the angle between estimate and reference while the sensor moves [deg]."""
    z = np.column_stack([table[f"{name}_{axis}"] for name in ("acc", "mag") for axis in "xyz"])
    gyro = np.column_stack([table[f"gyr_{axis}"] for axis in "xyz"])
    begun = model.replace(prior_mean=begun_at(model, z[:1])[0])
    means = filters.run(filters.ExtendedKalmanFilter(model=begun), inputs=gyro[1:], measurements=z).means
    counts = ~np.isnan(reference).any(axis=1)
    estimated, true = (Turned.from_quat(part[counts][:, [1, 2, 3, 0]]) for part in (means[:, :4], reference))
    return np.rad2deg(np.sqrt(np.mean((estimated * true.inv()).magnitude() ** 2)))


def test_attitudes_of_recordings():
    """With what the next test finds; the cuts give Madgwick 3.6 and VQF 1.3 degrees."""
    numbers = {"accelerometer": 0.002, "magnetometer": 0.8, "acceleration": 0.42, "frequency": 1.1}
    model = attitude(1.0 / RATE, **numbers, damping=0.85, field=44.8, dip=69.7)
    table, reference = table_of("03")
    assert total_error(model, *table_of("02")) < 1.35
    assert total_error(model, table, reference) < 1.6
    settings = ",".join(f"{name}={value}" for name, value in numbers.items())
    log = tuning.read_logs(table, model=f"attitude:{settings},damping=0.85,field=44.8,dip=69.7")
    estimate = tuning.estimate(log, filter="ekf")
    q, deviations = estimate.means[-1, :4], estimate.stds[-1, :4]
    np.testing.assert_allclose(q @ q, 1.0, rtol=1e-12)
    assert (deviations < 0.01).all()


@pytest.mark.slow
def test_numbers_of_a_recording_without_its_reference():
    """By maximum likelihood, as `thruster identify imu.csv --model attitude` finds them."""
    table, reference = table_of("02")
    found = tuning.identify(("attitude", table), start={"field": 45.0}, use_all=True, starts=1)
    assert total_error(found.model, table, reference) < 1.35
    assert total_error(found.model, *table_of("03")) < 1.6
    assert found.determined["dip"]
    assert abs(found.values["dip"] - 69.7) < 0.5


@pytest.mark.slow
def test_a_study_on_a_recording(undrawn, tmp_path):
    """Its blocks begin at their own attitudes; the report states Q of the errors."""
    table, _ = table_of("02")
    path = tmp_path / "imu.csv"
    np.savetxt(path, np.column_stack(list(table.values())), delimiter=",", header=",".join(table), comments="")
    study = tuning.tune(("attitude", str(path)), trials=2, out=tmp_path / "tuned.json")
    assert study.result.choice.model["dip"] == pytest.approx(69.7, abs=0.5)
    tuning.report(str(tmp_path / "tuned.json"), out=tmp_path / "report")
    assert "In each step q_3 moves by" in (tmp_path / "report" / "tuned.html").read_text(encoding="utf-8")


DT, ROWS, GAP = 0.02, 600, slice(300, 400)  # a gap of 2 s
MODEL = attitude(DT, accelerometer=0.05, magnetometer=0.5, acceleration=0.05, gyroscope=1e-3)


def turning_table(rate):
    """A sensor that turns about up and east, with its reference, without the rows of the gap."""
    draw, t = np.random.default_rng(4).normal, DT * np.arange(ROWS)
    turn = Turned.from_rotvec(np.column_stack([0.05 * np.sin(t), 0 * t, rate * np.sin(0.8 * t)]))
    gyro = np.zeros((ROWS, 3))
    gyro[1:] = (turn[:-1].inv() * turn[1:]).as_rotvec() / DT
    dip = np.radians(60.0)
    acc = turn.inv().apply([0.0, 0.0, 9.81]) + 0.05 * draw(size=(ROWS, 3))
    mag = turn.inv().apply([0.0, 50 * np.cos(dip), -50 * np.sin(dip)]) + 0.5 * draw(size=(ROWS, 3))
    q = turn.as_quat()
    columns = {"time": t}
    for name, values in (("gyr", gyro), ("acc", acc), ("mag", mag)):
        columns |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"q_{axis}": q[:, i] for i, axis in enumerate("xyzw")}
    return {name: np.delete(values, np.arange(ROWS)[GAP]) for name, values in columns.items()}


@pytest.mark.parametrize("grid", [True, False])
def test_the_filter_begins_anew_after_a_gap(grid):
    """After it estimates are those of the rest of the log alone, with small errors."""
    log = read_log(turning_table(2.0), MODEL, grid=grid)
    (row,) = lost_in_gaps(MODEL, log)
    assert row == (GAP.stop if grid else GAP.start)
    whole = estimate(log, "ekf", MODEL)
    rest = estimate(piece_of(log, row, log.steps + 1 - row), "ekf", MODEL)
    np.testing.assert_array_equal(whole.means[row:], rest.means)
    np.testing.assert_array_equal(whole.covs[row:], rest.covs)
    found = findings(whole)
    (angle,) = (reference for reference in found.references if reference.quantity.symbol == "q_angle")
    assert angle.rmse < 1.5
    assert "The sensor turns in gaps: after the gap the filter begins anew" in " ".join(verdict(whole, found))


def test_a_sensor_that_barely_turns_or_has_no_magnetometer_goes_on():
    assert lost_in_gaps(MODEL, read_log(turning_table(0.0), MODEL)) == []
    blind = attitude_imu(DT)
    assert lost_in_gaps(blind, read_log(turning_table(2.0), blind)) == []


SAMPLE, COUNT = 0.02, 60_000


def test_closed_forms_of_white_noise_walks_and_flicker():
    """N/sqrt(tau), K sqrt(tau/3) and 0.664 B; a drift at a constant rate R is R tau/sqrt(2)."""
    draws = np.random.default_rng(5).standard_normal((2, COUNT))
    for values, expected in (
        (draws[0] / np.sqrt(SAMPLE), lambda tau: 1.0 / np.sqrt(tau)),
        (np.sqrt(SAMPLE) * np.cumsum(draws[1]), lambda tau: np.sqrt((tau**2 + SAMPLE**2 / 2.0) / (3.0 * tau))),
        (flicker_noise(draws[0]), lambda tau: np.full_like(tau, 0.664)),
        (SAMPLE * np.arange(COUNT), lambda tau: tau / np.sqrt(2.0)),
    ):
        taus, deviations = allan_deviation(values, SAMPLE)
        some_samples = (taus > 4.0 * SAMPLE) & (taus < 10.0)
        np.testing.assert_allclose(deviations[some_samples], expected(taus[some_samples]), rtol=0.12)


def test_the_fit_finds_the_terms_of_a_curve():
    taus, terms = np.geomspace(SAMPLE, 100.0, 40), np.array([4e-6, 1e-8, 9e-8])
    curve = terms[0] / taus + terms[1] * 2.0 * np.log(2.0) / np.pi + terms[2] * taus / 3.0
    np.testing.assert_allclose(_fit(taus, np.sqrt(curve), 1200.0), terms, rtol=1e-6)


def test_the_noise_of_a_record_lies_in_its_intervals():
    rng = np.random.default_rng(3)
    true = {"N": 2e-3, "B": 0.0, "K": 4e-4}
    values = true["N"] / np.sqrt(SAMPLE) * rng.standard_normal(COUNT)
    values += true["K"] * np.sqrt(SAMPLE) * np.cumsum(rng.standard_normal(COUNT))
    *_, noise = noise_of(values, SAMPLE, rng)
    assert noise["N"].value == pytest.approx(2e-3, rel=0.02)
    for name, value in true.items():
        assert noise[name].low <= value <= noise[name].high
    assert noise["K"].low > 0.0


def test_a_log_at_rest_from_the_command_line(tmp_path, monkeypatch, capsys):
    """Start values of the model; a short log and one in motion are refused in a line."""
    rng, path = np.random.default_rng(2), tmp_path / "imu.csv"
    time = np.arange(6_200) / 50.0
    columns = {"time": time} | {f"gyr_{axis}": 2e-4 * np.sqrt(50.0) * rng.standard_normal(6_200) for axis in "xyz"}

    def written(**changes):
        table = columns | changes
        np.savetxt(path, np.column_stack(list(table.values())), delimiter=",", header=",".join(table), comments="")
        return str(path)

    def thruster(*arguments):
        monkeypatch.setattr("sys.argv", ["thruster", "log", *arguments, "--allan"])
        with pytest.raises(SystemExit):
            main()
        return " ".join("".join(capsys.readouterr()).split())

    result = thruster(written(), "--plot", str(tmp_path / "allan.png"))
    assert "--model attitude:gyroscope=0.0002,bias_walk=" in result
    assert (tmp_path / "allan.png").stat().st_size > 10_000
    refused = thruster(written(gyr_z=0.3 * np.sin(0.05 * time)))
    assert "must be at rest, but means of gyr_z over 1 s differ by 0.6 rad/s" in refused
