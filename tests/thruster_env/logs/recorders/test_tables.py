"""Logs of sensor apps: folders, zips and files of CSV with several clocks, and the names of their columns."""

from zipfile import ZipFile

import numpy as np
import pytest

from filters.inertial import attitude
from thruster_env.logs.columns import sensor_of
from thruster_env.logs.read import read_log
from thruster_env.logs.recorders.registry import contents, format_of

ROWS = 100
FAST, SLOW = 0.01 * np.arange(ROWS), 0.02 * np.arange(ROWS // 2)
DRAWN = np.random.default_rng(0).normal(size=(ROWS, 9)).round(6)
GYRO, ACC, MAG = DRAWN[:, :3], DRAWN[:, 3:6], DRAWN[::2, 6:]


def write(path, header, times, values, end=""):
    rows = [
        f"{time:.9g},{','.join(f'{value:.9g}' for value in row)}{end}"
        for time, row in zip(times, values, strict=True)
    ]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def check(log):
    """That a log has the samples above: the gyroscope until a row, the magnetometer in every other row."""
    assert log.dt == pytest.approx(0.01)
    np.testing.assert_allclose(log.inputs, GYRO[1:], atol=1e-8)
    np.testing.assert_allclose(log.measurements[:, :3], ACC, atol=1e-8)
    np.testing.assert_allclose(log.measurements[::2, 3:], MAG, atol=1e-8)
    assert np.isnan(log.measurements[1::2, 3:]).all()


@pytest.fixture
def folder(tmp_path):
    """As Phyphox exports them, with headers in quotation marks and a folder beside."""
    folder = tmp_path / "phyphox"
    folder.mkdir()
    for name, unit, times, values in (
        ("Gyroscope", "rad/s", FAST, GYRO),
        ("Accelerometer", "m/s^2", FAST, ACC),
        ("Magnetometer", "µT", SLOW, MAG),
    ):
        header = ",".join(['"Time (s)"', *(f'"{name} {axis} ({unit})"' for axis in "xyz")])
        write(folder / f"{name}.csv", header, times, values)
    return folder


def test_a_folder_and_a_zip_of_files(folder, tmp_path):
    check(read_log(folder, attitude()))
    with ZipFile(tmp_path / "phone.zip", "w") as archive:
        for file in folder.iterdir():
            archive.write(file, file.name)
        archive.writestr("meta/device.csv", "property,value\nversion,1\n")
        archive.writestr("../outside.csv", "time,x\n0,1\n")
    check(read_log(tmp_path / "phone.zip", attitude()))
    assert len(contents(tmp_path / "phone.zip").fields) == 9


def test_a_folder_whose_accelerometer_is_without_gravity(tmp_path):
    """As Sensor Logger writes them: dates in ns beside seconds, axes from z to x, and the total acceleration."""
    for name, times, values in (
        ("Gyroscope", FAST, GYRO),
        ("Accelerometer", FAST, 0.0 * ACC),
        ("TotalAcceleration", FAST, ACC),
        ("Magnetometer", SLOW, MAG),
    ):
        dates = [1763980000123456789 + round(1e9 * time) for time in times]
        rows = [
            f"{date},{time:.9f},{z},{y},{x}" for date, time, (x, y, z) in zip(dates, times, values, strict=True)
        ]
        (tmp_path / f"{name}.csv").write_text("\n".join(["time,seconds_elapsed,z,y,x", *rows]), encoding="utf-8")
    check(read_log(tmp_path, attitude()))


def test_a_file_with_several_columns_of_times(tmp_path):
    sensors = (("gyro", " [deg/s]"), ("acc", " [g]"), ("mag", ""))
    groups = [[f"{name}_time [s]", *(f"{name}_{axis}{unit}" for axis in "xyz")] for name, unit in sensors]
    header = ",".join(sum(groups, []))
    slow = np.full((ROWS, 4), np.nan)
    slow[: ROWS // 2] = np.column_stack([SLOW, MAG])
    table = np.column_stack([FAST, np.degrees(GYRO), FAST, ACC / 9.80665, slow])
    rows = [",".join("" if np.isnan(value) else f"{value:.12g}" for value in row) for row in table]
    (tmp_path / "phone.csv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    check(read_log(tmp_path / "phone.csv", attitude()))
    one_clock = "time,gps_time,gyr_x,gyr_y,gyr_z"
    write(tmp_path / "plain.csv", one_clock, FAST, np.column_stack([FAST, GYRO]))
    assert format_of(tmp_path / "plain.csv") is None


def test_names_and_units_of_ros(tmp_path):
    """Its field is in tesla, its acceleration has gravity, and its quaternion, scalar last, is a reference."""
    names = [
        f"field.{part}.{axis}"
        for part in ("angular_velocity", "linear_acceleration", "magnetic_field")
        for axis in "xyz"
    ]
    header = ",".join(["%time", *(f"field.orientation.{axis}" for axis in "xyzw"), *names])
    quaternion = np.tile([0.0, 0.0, 0.6, 0.8], (ROWS, 1))
    values = np.column_stack([quaternion, DRAWN[:, :6], 1e-6 * DRAWN[:, 6:]])
    write(tmp_path / "ros.csv", header, FAST, values)
    log = read_log(tmp_path / "ros.csv", attitude())
    np.testing.assert_allclose(log.inputs, GYRO[1:], atol=1e-8)
    np.testing.assert_allclose(log.measurements, DRAWN[:, 3:], atol=1e-6)
    assert [log.references[f"state:q_{axis}"][5] for axis in "wxyz"] == pytest.approx([0.8, 0.0, 0.0, 0.6])


@pytest.mark.parametrize(
    ("header", "symbol"),
    [
        ("ACCELEROMETER X (m/s²)", "acc_x"),
        ("MAGNETIC FIELD Z (μT)", "mag_z"),
        ("gyroscope.y", "gyr_y"),
        ("/imu/data.linear_acceleration.x", "acc_x"),
        ("linear acceleration x (m/s^2)", None),  # of a phone, without gravity
        ("velocity_x", None),
        ("x", None),
    ],
)
def test_names_of_sensors(header, symbol):
    found = sensor_of(header)
    assert (found and found[0]) == symbol


def test_what_is_no_log_of_sensors(folder, tmp_path):
    (tmp_path / "bad.zip").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(ValueError, match="a folder of CSV files must be one, but .*bad.zip is not"):
        read_log(tmp_path / "bad.zip", attitude())
    (folder / "Magnetometer.csv").write_text("x,y,z\n1,2,3\n", encoding="utf-8")
    with pytest.raises(
        ValueError, match="all fields of a log must have times|Magnetometer|a log must have a column"
    ):
        read_log(folder, attitude())
    (folder / "Magnetometer.csv").write_text("time,x\n1,2,3\n", encoding="utf-8")
    with pytest.raises(
        ValueError, match="rows must have as many cells as the header, 2, but got 3 in line 2 of .*Magnetometer"
    ):
        read_log(folder, attitude())
