"""The model `attitude` on recordings: its numbers without the reference, and its errors against that."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turned

import filters
import tuning
from filters.inertial import attitude
from filters.starts import begun_at
from tests.data.broad import RATE, broad


def table_of(trial):
    """A recording as a table, and its reference quaternions."""
    columns = broad(trial)
    parts = {
        f"{name}_{axis}": columns[name][:, i] for name in ("gyr", "acc", "mag") for i, axis in enumerate("xyz")
    }
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
