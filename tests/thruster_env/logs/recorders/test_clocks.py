"""Several clocks in one file: all topics of a log have the times of one, or a finding says it."""

import numpy as np
import pytest
from scipy.io import savemat

from tests.fuzz.logs import MODEL
from tests.thruster_env.logs.recorders.files import EPOCH, dataflash, h5py, twists, write_bag
from thruster_env.logs.findings import sentences
from thruster_env.logs.read import read_log
from thruster_env.logs.recorders.registry import fields
from thruster_env.model.affine import affine_model

TICK = 10**7  # [ns] from message to message
ROWS = 120
K = np.arange(ROWS)
FORCE = np.where(np.arange(ROWS) // 20 % 2, -1.0, 1.0)
SPEED = np.sin(np.arange(ROWS) / 7.0)
# The clock in the headers of the speed, the force and its rate; None for headers without one, "" for no header.
CLOCKS = {
    "wall time in both": (EPOCH, EPOCH, 1),
    "device time beside no header": (123 * 10**9, "", 1),
    "simulated time beside no header": (0, "", 1),
    "simulated time in both": (0, 0, 1),
    "fast simulated time in both": (0, 0, 7),
    "simulated time beside none": (0, None, 1),
    "device time beside wall time": (123 * 10**9, EPOCH, 1),
    "wall time beside no header": (EPOCH, "", 1),
    "none in both": (None, None, 1),
}
ON_HEADERS = ("wall time in both", "simulated time in both", "fast simulated time in both")


def write(path, name, kind):
    """A bag with a force and a speed, received at the same times, whose headers have these clocks."""
    speed, force, rate = CLOCKS[name]

    def messages(values, clock):
        stamps = None if clock == "" else 0 * K if clock is None else clock + rate * TICK * K
        return list(zip((EPOCH + TICK * K).tolist(), twists(values, stamps), strict=True))

    types = ["geometry_msgs/msg/Twist" + ("" if clock == "" else "Stamped") for clock in (speed, force)]
    write_bag(path, [("/v", types[0], messages(SPEED, speed)), ("/f", types[1], messages(FORCE, force))], kind)
    return {"u_1": f"/f.{'' if force == '' else 'twist.'}linear.x", "z_1": "/v.twist.linear.x"}


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
@pytest.mark.parametrize("name", CLOCKS)
def test_all_topics_of_a_bag_have_the_times_of_one_clock(name, kind, tmp_path):
    path = tmp_path / ("a.bag" if kind == "ros1" else "a")
    columns = write(path, name, kind)
    clock, rate = "header" if name in ON_HEADERS else "receipt", CLOCKS[name][2]
    for stamps in (None, clock):
        log = read_log(path, MODEL, columns, stamps=stamps)
        np.testing.assert_array_equal(log.inputs[:, 0], FORCE[:-1])
        np.testing.assert_array_equal(log.measurements[:, 0], SPEED)
        assert abs(log.dt - (0.01 * rate if clock == "header" else 0.01)) < 1e-9
        mixed = {None, ""} & {*CLOCKS[name][:2]} and name != "none in both" or name.startswith("device")
        assert [one.kind for one in log.findings] == ["clock"] * bool(mixed and stamps is None)
    listed = [one for one in fields(path) if one.name in columns.values()]
    assert {one.clock for one in listed} == {clock}
    assert {(one.begin, one.end) for one in listed} == {(log.start, log.start + listed[0].end - listed[0].begin)}


@pytest.mark.parametrize("name", CLOCKS)
def test_headers_or_reception_are_chosen_for_all_topics_or_refused(name, tmp_path):
    columns = write(tmp_path / "a.bag", name, "ros1")
    log = read_log(tmp_path / "a.bag", MODEL, columns, stamps="receipt")
    np.testing.assert_array_equal(log.inputs[:, 0], FORCE[:-1])
    assert (log.start, log.dt) == (0.0, 0.01)
    if name in ON_HEADERS:
        return
    with pytest.raises(
        ValueError, match=r"(in the headers of all topics|must continue after all inputs)"
    ) as caught:
        log = read_log(tmp_path / "a.bag", MODEL, columns, stamps="header")
        raise ValueError(f"must continue after all inputs {[one.kind for one in log.findings].index('no input')}")
    assert "\n" not in str(caught.value)


def test_stamps_are_chosen_for_bags_only(tmp_path):
    table = {"t": np.arange(9.0), "force": FORCE[:9], "speed": SPEED[:9]}
    savemat(tmp_path / "a.mat", table)
    for log in (table, tmp_path / "a.mat"):
        with pytest.raises(ValueError, match="must be chosen for a bag, but got 'header'"):
            read_log(log, MODEL, stamps="header")
    with pytest.raises(ValueError, match="must be one of header, receipt, but got 'both'"):
        read_log(tmp_path / "a.mat", MODEL, stamps="both")


def groups(path, force_times, speed_times):
    """A file of two groups with times of their own."""
    some = {"a": {"t": force_times, "force": FORCE[: len(force_times)]}, "b": {"t": speed_times, "speed": SPEED}}
    if path.suffix == ".mat":
        savemat(path, some)
        return
    with h5py.File(path, "w") as file:
        for group, arrays in some.items():
            for key, values in arrays.items():
                file[f"{group}/{key}"] = values


@pytest.mark.parametrize("ending", ["mat", "h5"])
def test_an_input_of_another_clock_is_a_finding_or_refused(ending, tmp_path):
    path, times, columns = tmp_path / f"a.{ending}", 0.01 * np.arange(ROWS), {"u_1": "a.force", "z_1": "b.speed"}
    groups(path, times, times)
    assert not sentences(read_log(path, MODEL, columns).findings)
    groups(path, times - 1e3, times)  # it ends before the log begins
    log = read_log(path, MODEL, columns)
    assert [one.kind for one in log.findings] == ["outside", "no input"]
    assert sentences(log.findings)[0] == (
        "all samples of a.force lie outside the log: they are from -1000 to -998.81 s, the log from 0 to 1.19 s."
    )
    assert log.findings[1].sentence == "u_1 has no sample after the first row: it is held at -1 in all rows"
    groups(path, times + 1e3, times)
    with pytest.raises(ValueError, match="after all inputs have begun, at 1000 s, but .* has 0 .* end at 1.19 s"):
        read_log(path, MODEL, columns)
    groups(path, times - 0.7, times)  # it ends in the middle
    log = read_log(path, MODEL, columns)
    assert [one.kind for one in log.findings] == ["outside", "no input"] and log.steps == ROWS - 1
    groups(path, times + 0.7, times)  # and begins there
    log = read_log(path, MODEL, columns)
    assert [one.kind for one in log.findings] == ["outside", "outside"] and round(log.start, 9) == 0.7


def test_a_table_whose_input_ends_early_has_a_finding():
    times, force = 0.01 * np.arange(ROWS), FORCE.copy()
    force[30:] = np.nan
    log = read_log({"t": times, "force": force, "speed": SPEED}, MODEL)
    assert [one.kind for one in log.findings] == ["no input"]
    force[1:] = np.nan
    log = read_log({"t": times, "force": force, "speed": SPEED}, MODEL)
    assert log.findings[0].sentence == "u_1 has no sample after the first row: it is held at 1 in all rows"


def test_positions_of_old_dataflash_logs_have_the_time_since_start_and_not_that_of_the_week(tmp_path):
    kinds = {1: ("GPS", "IHfI", "TimeMS,Week,Spd,T"), 2: ("CMD", "If", "TimeMS,F")}
    rows = [(1, (345_600_000 + 10 * k, 1800, SPEED[k], 5000 + 10 * k)) for k in range(ROWS)]
    rows += [(2, (5000 + 10 * k, FORCE[k])) for k in range(ROWS)]
    (tmp_path / "a.bin").write_bytes(dataflash(kinds, rows))
    log = read_log(tmp_path / "a.bin", MODEL, {"u_1": "CMD.F", "z_1": "GPS.Spd"})
    np.testing.assert_array_equal(log.inputs[:, 0], FORCE[:-1])
    assert log.start == 5.0 and not log.findings


def test_a_measurement_of_another_clock_is_refused_with_the_times(tmp_path):
    times = 0.01 * np.arange(ROWS)
    some = {"a": {"t": times, "force": FORCE, "speed": SPEED}, "b": {"t": times[::2] + 1e4, "flow": SPEED[::2]}}
    savemat(tmp_path / "a.mat", some)
    model = affine_model(
        **{"a": [[0.9]], "b": [[0.5]], "c": [[1.0], [1.0]], "process_noise_cov": [0.01], "prior_mean": [0.0]},
        **{"measurement_noise_cov": [0.04, 0.04], "prior_cov": [1.0], "measurements": ["speed", "flow"]},
        input_quantities=["force"],
    )
    with pytest.raises(
        ValueError, match=r"but those of b.flow are from 10000 to 10001.18 s, the log from 0 to 1.19 s"
    ):
        read_log(tmp_path / "a.mat", model, {"speed": "a.speed", "flow": "b.flow", "force": "a.force"})
