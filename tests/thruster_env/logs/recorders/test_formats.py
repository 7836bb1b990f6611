"""Each format of recorders: what its own writer wrote is read back."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from scipy.io import loadmat, savemat

from tests.thruster_env.logs.recorders.files import EPOCH, dataflash, h5py, stamped, write_bag, write_ulog
from thruster_env.logs.recorders.arrays import arrays_of
from thruster_env.logs.recorders.registry import fields, format_of, read

RNG = np.random.default_rng(0)


def by_name(path):
    return {one.name: one for one in fields(path)}


def test_a_ulog_has_topics_instances_and_arrays(tmp_path):
    ticks = 5_000 + 10_000 * np.arange(200)
    wave, wide = RNG.normal(size=200).astype(np.float32), RNG.normal(size=100)
    text = "float[3] output;bool armed;char[2] word;uint8_t[5] _padding0;"
    write_ulog(
        tmp_path / "a.ulg",
        [
            ("act", 0, text, {"timestamp": ticks, "output[1]": wave, "armed": np.arange(200) % 2}),
            ("act", 1, text, {"timestamp": ticks, "output[1]": -wave}),
            ("pos", 0, "double x;int64_t far;", {"timestamp": 2 * ticks[:100], "x": wide, "far": -(2**40)}),
        ],
    )
    found = by_name(tmp_path / "a.ulg")
    outputs = [f"act.output[{place}]" for place in range(3)]
    assert list(found)[:4] == [*outputs, "act.armed"] and "act#1.output[1]" in found and len(found) == 10
    assert (found["pos.x"].samples, found["pos.x"].unit) == (100, "")
    assert (found["pos.x"].rate, found["pos.x"].gap) == pytest.approx((50.0, 0.02))
    assert (found["pos.x"].least, found["pos.x"].greatest) == (wide.min(), wide.max())
    some = read(tmp_path / "a.ulg", ["act.output[1]", "act#1.output[1]", "pos.x", "pos.far", "no.such"])
    assert list(some) == ["act.output[1]", "act#1.output[1]", "pos.x", "pos.far"]
    np.testing.assert_array_equal(some["act.output[1]"].values, wave.astype(float))
    np.testing.assert_array_equal(some["act#1.output[1]"].values, -wave.astype(float))
    np.testing.assert_array_equal(some["pos.x"].values, wide)
    np.testing.assert_array_equal(some["pos.far"].values, -(2.0**40))
    np.testing.assert_allclose(some["act.output[1]"].times, 0.005 + 0.01 * np.arange(200), rtol=1e-15)


def test_a_dataflash_log_has_units_instances_and_scaled_integers(tmp_path):
    kinds = {
        1: ("RCOU", "QchC", "TimeUS,C1,C2,C3"),
        2: ("IMU", "QBfd", "TimeUS,I,GyrX,AccX"),
        3: ("POS", "QLN", "TimeUS,Lat,Text"),
        4: ("ISBD", "Qa", "TimeUS,x"),
        5: ("OLD", "Qf", "TimeMS,v"),
    }
    messages, wave = [], RNG.normal(size=(2, 40))
    array = np.arange(32, dtype=np.int16) - 7
    for k in range(40):
        messages += [(1, (20_000 * k, 10 * k, -k, 5 * k)), (3, (20_000 * k, -123_456_789 - k, "here"))]
        messages += [(2, (20_000 * k + 7 * i, i, wave[i, k], wave[i, k])) for i in (0, 1)]
        messages += [(4, (k, (array * k).tobytes())), (5, (1500 * k, k))]
    units = {1: ("svv-", "F0C-"), 2: ("s#kk", "F-00"), 3: ("sD-", "FG-")}
    (tmp_path / "a.BIN").write_bytes(dataflash(kinds, messages, units))
    found = by_name(tmp_path / "a.BIN")
    assert not [name for name in found if name.startswith(("FMT", "UNIT", "MULT"))] and "POS.Text" not in found
    told = {name: found[name].unit for name in ("RCOU.C1", "RCOU.C2", "RCOU.C3", "IMU#1.GyrX", "IMU.I", "POS.Lat")}
    assert [*told.values()] == ["V", "mV", "", "deg", "", "deg"]
    some = read(tmp_path / "a.BIN", None)
    np.testing.assert_allclose(some["RCOU.C1"].values, 0.1 * np.arange(40), rtol=1e-15)  # c: hundredths
    np.testing.assert_array_equal(some["RCOU.C2"].values, -np.arange(40.0))
    np.testing.assert_allclose(some["RCOU.C3"].values, 0.05 * np.arange(40), rtol=1e-15)
    np.testing.assert_allclose(some["POS.Lat"].values, -12.3456789 - 1e-7 * np.arange(40), rtol=1e-15)
    np.testing.assert_array_equal(some["IMU#1.AccX"].values, wave[1])
    np.testing.assert_array_equal(some["IMU.GyrX"].values, wave[0].astype(np.float32).astype(float))
    np.testing.assert_allclose(some["IMU#1.AccX"].times, 0.02 * np.arange(40) + 7e-6, rtol=1e-12)
    np.testing.assert_array_equal(some["ISBD.x[31]"].values, 24.0 * np.arange(40))
    np.testing.assert_array_equal(some["OLD.v"].times, 1.5 * np.arange(40))
    assert set(read(tmp_path / "a.BIN", ["IMU#1.AccX"])) == {"IMU#1.AccX"}
    from pymavlink.DFReader import DFReader_binary

    index = DFReader_binary(str(tmp_path / "a.BIN"))  # message by message, as pymavlink has them
    theirs = [message.to_dict() for message in iter(index.recv_msg, None)]
    index.close()
    for name, one in some.items():
        topic, _, field = name.partition(".")
        own = [row for row in theirs if f"{row['mavpackettype']}{'#1' * row.get('I', 0)}" == topic]
        key, _, place = field.rstrip("]").partition("[")
        np.testing.assert_array_equal(one.values, [row[key][int(place)] if place else row[key] for row in own])


def bag_topics(rows=30):
    """A velocity whose header's stamp is 3 us before it was received, a number without, and joints."""

    def velocity(k):
        def make(types, kind):
            vector = types["geometry_msgs/msg/Vector3"]
            twist = types["geometry_msgs/msg/Twist"](vector(0.5 * k, -k, 3.0), vector(0.0, 0.0, 0.1 * k))
            return types["geometry_msgs/msg/TwistStamped"](stamped(types, kind, EPOCH + 10**7 * k), twist)

        return make

    def joints(k):
        def make(types, kind):
            header = stamped(types, kind, 0)  # as of who sets no stamp
            arrays = np.array([k, 2.0 * k]), np.zeros(k), np.array([])
            return types["sensor_msgs/msg/JointState"](header, ["a", "b"], *arrays)

        return make

    def number(k):
        return lambda types, kind: types["std_msgs/msg/Float64"](0.1 * k)

    kinds = ("/vel", "geometry_msgs/msg/TwistStamped", velocity), ("/f", "std_msgs/msg/Float64", number)
    kinds += (("/joints", "sensor_msgs/msg/JointState", joints),)
    received = EPOCH + 10**7 * np.arange(rows) + 3000
    return [(name, kind, [(int(received[k]), make(k)) for k in range(rows)]) for name, kind, make in kinds]


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_bag_has_nested_fields_and_stamps_of_headers(tmp_path, kind):
    write_bag(tmp_path / "a.bag", bag_topics(), kind)
    paths = [tmp_path / "a.bag"]
    if kind != "ros1":
        (tmp_path / "a.bag").rename(tmp_path / "a")
        paths = [tmp_path / "a", next((tmp_path / "a").glob("*.[dm]*[3p]"))]
    for path in paths:
        assert format_of(path).kind.startswith(("bag of ROS", "MCAP"))
        some = read(path, None)
        assert {"/vel.twist.linear.x", "/vel.twist.angular.z", "/f.data", "/joints.position[1]"} <= set(some)
        assert not [name for name in some if "header" in name or "velocity" in name or "effort" in name]
        np.testing.assert_array_equal(some["/vel.twist.linear.y"].values, -np.arange(30.0))
        np.testing.assert_array_equal(some["/joints.position[1]"].values, 2 * np.arange(30.0))
        np.testing.assert_allclose(some["/f.data"].values, 0.1 * np.arange(30), rtol=1e-15)
        since = 0.01 * np.arange(30)  # since the first message was received
        np.testing.assert_allclose(some["/vel.twist.linear.x"].times, since - 3e-6, atol=1e-12)
        np.testing.assert_allclose(some["/f.data"].times, since, atol=1e-12)
        np.testing.assert_allclose(some["/joints.position[0]"].times, since, atol=1e-12)
        assert set(read(path, ["/f.data"])) == {"/f.data"}


@pytest.mark.parametrize("compressed", [False, True])
def test_a_matlab_file_has_structures_beside_their_times(tmp_path, compressed):
    t, wave = 0.1 * np.arange(50), RNG.normal(size=(50, 3))
    structure = {"time": 2 * t, "speed_rpm": 3 * t, "acc": wave, "signals": {"values": -t}}
    content = {"t": t, "V": t[:, None] > 2, "log": structure, "name": "hi", "k": 3.0, "many": np.ones((50, 100))}
    savemat(tmp_path / "a.mat", content, do_compression=compressed)
    some, found = read(tmp_path / "a.mat", None), by_name(tmp_path / "a.mat")
    fields_of_log = {"log.time", "log.speed_rpm", "log.signals.values", *(f"log.acc[{k}]" for k in range(3))}
    assert set(some) == set(found) == {"t", "V", *fields_of_log}
    np.testing.assert_array_equal(some["log.acc[2]"].values, wave[:, 2])
    np.testing.assert_array_equal(some["V"].values, (t > 2).astype(float))
    for name, times in (("V", t), ("log.acc[2]", 2 * t), ("log.signals.values", 2 * t)):
        np.testing.assert_array_equal(some[name].times, times)
    assert found["V"].rate == pytest.approx(10.0)


def test_files_of_matlab_that_come_with_scipy_are_read_as_scipy_reads_them():
    paths = sorted((Path(scipy.io.__file__).parent / "matlab" / "tests" / "data").glob("test*_[567]*.mat"))
    if not paths:
        pytest.skip("this build of SciPy comes without its tests")
    count = 0
    for path in paths:
        if path.read_bytes()[:8] == b"MATLAB 5":
            ours = arrays_of(path)
            theirs = {key: one for key, one in loadmat(path).items() if isinstance(one, np.ndarray)}
            numbers = {key: one for key, one in theirs.items() if one.dtype.kind in "biuf"}
            for key, one in numbers.items():
                np.testing.assert_array_equal(ours[key], one)
            count += len(numbers)
    assert count > 10


@pytest.mark.parametrize("ending", [".h5", ".mat"])
def test_an_hdf5_file_has_groups_tables_and_units(tmp_path, ending):
    t, wave = np.arange(60), RNG.normal(size=(3, 60))
    options = {"userblock_size": 512} if ending == ".mat" else {}
    with h5py.File(tmp_path / f"a{ending}", "w", **options) as file:
        file["time"], file["voltage"] = 0.1 * t, 1000.0 * t
        file["voltage"].attrs["units"] = "mV"
        group = file.create_group("log/imu")
        group["t_ms"], group["acc"], group["words"] = 10 * t, wave, ["a", "b"]
        group["table"] = np.array([(k, -k, b"x") for k in t], [("a", "f4"), ("b", "i2"), ("s", "S3")])
        file["log/short"], file["log/round"] = np.arange(7.0), file["/"]
        file["log/picture"] = np.ones((20, 30, 3))
    if ending == ".mat":  # MATLAB writes its name before what HDF5 begins with
        with h5py.File(tmp_path / "a.mat", "a") as file:
            kinds = {"MATLAB_class": np.bytes_("char")}, {"MATLAB_empty": 1}, {"MATLAB_object_decode": 3}
            for name, attributes in zip(("text", "nothing", "series"), kinds, strict=True):
                file[name] = np.arange(60, dtype="u4")
                file[name].attrs.update(attributes)
            file["sparse/data"] = np.arange(60.0)
            file["sparse"].attrs["MATLAB_sparse"] = 60
        with (tmp_path / "a.mat").open("r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    some = read(tmp_path / f"a{ending}", None)
    names = [f"log.imu.acc[{k}]" for k in range(3)] + ["log.imu.t_ms", "log.imu.table.a", "log.imu.table.b"]
    assert set(some) == {"time", "voltage", "log.short", *names}
    assert some["voltage"].unit == "mV" and some["log.short"].times is None
    np.testing.assert_array_equal(some["log.imu.acc[1]"].values, wave[1])
    np.testing.assert_array_equal(some["log.imu.table.b"].values, -t.astype(float))
    np.testing.assert_allclose(some["log.imu.acc[1]"].times, 0.01 * t, rtol=1e-15)
    assert set(read(tmp_path / f"a{ending}", ["log.imu.acc[1]"])) == {"log.imu.acc[1]"}


def test_the_course_of_a_field_is_its_means_and_leaves_out_what_is_missing(tmp_path):
    values = np.repeat([1.0, np.nan, -2.0, 4.0], 8)
    values[25] = 6.0
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = values
    (field,) = fields(tmp_path / "a.h5")
    assert (field.samples, field.least, field.greatest) == (32, -2.0, 6.0) and np.isnan(field.rate)
    expected = [np.nanmean(values[4 * k : 4 * k + 4]) if not 2 <= k < 4 else np.nan for k in range(8)]
    np.testing.assert_allclose(field.course, expected)


def test_a_file_of_another_ending_is_known_by_its_first_bytes(tmp_path):
    write_ulog(tmp_path / "a.ulg", [("v", 0, "float x;", {"timestamp": np.arange(9), "x": np.arange(9)})])
    (tmp_path / "a.ulg").rename(tmp_path / "a.log")
    assert format_of(tmp_path / "a.log").kind == "ULog" and len(fields(tmp_path / "a.log")) == 1
    (tmp_path / "a.csv").write_text("t,v\n0,1\n")
    assert format_of(tmp_path / "a.csv") is None
    with pytest.raises(ValueError, match=r"a recorder's file must end in .ulg, .* but got .*a.csv"):
        fields(tmp_path / "a.csv")
