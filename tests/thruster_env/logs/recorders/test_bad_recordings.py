"""What is wrong with a recorder's file is one line; nothing of it is run, and nothing large is read."""

import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from scipy.io import savemat
from scipy.io.matlab import MatlabObject

from tests.thruster_env.logs.recorders.files import dataflash, h5py, write_bag, write_ulog
from tests.thruster_env.logs.recorders.test_formats import bag_topics
from tests.thruster_env.logs.test_logs import MODEL
from thruster_env.logs.read import read_log
from thruster_env.logs.recorders import topics
from thruster_env.logs.recorders.registry import FORMATS, fields, read

ENDINGS = [ending for one in FORMATS for ending in one.endings]
MAGIC = {ending: one.magic for one in FORMATS for ending in one.endings}


def write_good(path):
    """A small file of the format that a path ends in."""
    ticks, values = 10_000 * np.arange(300), np.arange(300.0)
    kinds = {1: ("U", "Qd", "TimeUS,V"), 2: ("M", "Qd", "TimeUS,n")}
    if path.suffix == ".ulg":
        columns = {"timestamp": ticks, "x": values}
        write_ulog(path, [("v", 0, "double x;", columns), ("w", 0, "double x;", columns)])
    elif path.suffix == ".bin":
        path.write_bytes(dataflash(kinds, [(1 + k % 2, (int(ticks[k]), values[k])) for k in range(300)]))
    elif path.suffix == ".bag":
        write_bag(path, bag_topics(100))
    elif path.suffix in (".mcap", ".db3"):
        write_bag(path.with_suffix(""), bag_topics(100), "mcap" if path.suffix == ".mcap" else "sqlite3")
        (path.with_suffix("") / path.name).rename(path)
    elif path.suffix == ".mat":
        savemat(path, {"t": ticks / 1e6, "v": values})
    else:
        with h5py.File(path, "w") as file:
            file["t"], file["v"] = ticks / 1e6, values
    return path


def refused(path, said="", call=fields):
    """The message by which a file is refused, one line that is not too long."""
    with pytest.raises(ValueError, match=said or None) as error:
        call(path)
    text = str(error.value)
    assert "\n" not in text and len(text) < 700 and path.name in text
    return text


SOME = [".ulg", ".bin", ".bag", ".mcap", ".db3", ".mat", ".h5"]


@pytest.mark.parametrize("ending", SOME)
def test_what_is_no_such_file_is_refused(tmp_path, ending, capfd):
    path = tmp_path / f"a{ending}"
    refused(path, "a log must be a file that can be read, but .* is not: No such file")
    path.write_bytes(b"")
    refused(path, "must be one, but .* is not: it is empty")
    path.write_bytes(b"\x00" * 4096)
    refused(path, "must be one, but .* is not: it begins with")
    path.write_bytes(MAGIC[".h5" if ending != ".h5" else ".ulg"] + bytes(99))
    refused(path, f"is not: it is a {'HDF5 file' if ending != '.h5' else 'ULog'}")
    random = np.random.default_rng(0).bytes(10_000_000)
    path.write_bytes(random)
    refused(path, "must be one, but .* is not: it begins with")
    path.write_bytes(MAGIC[ending] + random)
    refused(path, "must be one, but .* is not: ")
    path.write_bytes(MAGIC[ending])
    refused(path)
    path.unlink()
    path.mkdir()
    refused(path, "is not: it is a folder")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("ending", SOME)
def test_a_file_that_is_cut_off_is_read_in_part_or_refused(tmp_path, ending, capfd):
    """Two recorders may lose their power in the middle of the data; no other file is read in part."""
    path = write_good(tmp_path / f"a{ending}")
    whole, data = read(path, None), path.read_bytes()
    name = max(whole, key=lambda one: len(whole[one].values))
    for share in (0.02, 0.3, 0.6, 0.9, 0.999):
        path.write_bytes(data[: int(share * len(data))])
        if ending in (".ulg", ".bin") and share > 0.5:
            some = read(path, None)[name]
            assert 0.3 * share < len(some.values) / len(whole[name].values) <= share + 0.01
            np.testing.assert_array_equal(some.values, whole[name].values[: len(some.values)])
        elif ending not in (".ulg", ".bin"):
            refused(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux limits what a process takes")
@pytest.mark.parametrize("kind", ["ros1", "message"])
def test_what_unpacks_to_too_much_is_refused(tmp_path, kind, monkeypatch):
    """A bag of 80 MB of zeros, compressed."""
    import resource

    path = write_bomb(tmp_path / ("a.bag" if kind == "ros1" else "a"), kind, 80_000_000)
    size = sum(one.stat().st_size for one in path.rglob("*")) if path.is_dir() else path.stat().st_size
    assert size < 400_000
    limits = resource.getrlimit(resource.RLIMIT_AS)
    monkeypatch.setattr(topics, "MOST_MEMORY", 40_000_000)
    refused(path, "a bag must take at most 4e.07 bytes of memory, but .* takes more")
    assert resource.getrlimit(resource.RLIMIT_AS) == limits
    monkeypatch.undo()
    assert fields(path)


def write_bomb(path, kind, size):
    """A bag with one message that holds a number and so many zeros, compressed."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float64 x\nuint8[] picture", "a/msg/Bomb"))
    message = store.types["a/msg/Bomb"](1.0, np.zeros(size, np.uint8))
    if kind == "ros1":
        writer, data = rosbag1.Writer(path), store.serialize_ros1(message, "a/msg/Bomb")
        writer.set_compression(writer.CompressionFormat.LZ4)
    else:
        writer, data = rosbag2.Writer(path, version=9), store.serialize_cdr(message, "a/msg/Bomb")
        writer.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        writer.write(writer.add_connection("/bomb", "a/msg/Bomb", typestore=store), 1, data)
    return path


def test_a_field_that_is_not_there_is_answered_with_those_near_it(tmp_path):
    ticks = np.arange(9)
    rows = {"timestamp": ticks, **{f"output[{k}]": ticks for k in range(40)}}
    write_ulog(
        tmp_path / "a.ulg",
        [("actuators", 0, "float[40] output;", rows), ("m", 0, "float n;", {"timestamp": ticks, "n": ticks})],
    )
    said = r"and 33 more, but got 'actuator.output\[3\]' \(.*a.ulg\); near it are actuators.output\[3\], "
    with pytest.raises(ValueError, match=said):
        read_log(tmp_path / "a.ulg", MODEL, {"V_s": "actuator.output[3]", "tach": "m.n"})
    with pytest.raises(ValueError, match=r"a log must have a column for the measurement tachometer"):
        read_log(tmp_path / "a.ulg", MODEL, {"V_s": "actuators.output[3]"})
    with pytest.raises(ValueError, match=r"times of a ULog must be the stamps of its messages, but got time=m.n"):
        read_log(tmp_path / "a.ulg", MODEL, {"V_s": "m.n", "tach": "actuators.output[0]", "time": "m.n"})


RISING = 0.01 * np.arange(9)


@pytest.mark.parametrize(
    ("clocks", "speeds", "said"),
    [
        (
            (RISING, RISING[::-1]),
            RISING,
            "times must increase from sample to sample, but 0.07 s follows 0.08 s in 'b.n'",
        ),
        ((RISING, RISING), np.full(9, np.inf), "must be finite, but got inf at 0 s in 'b.n'"),
        (
            (RISING + 0.09, RISING),
            RISING,
            "after all inputs have begun, at 0.09 s, but .*a.h5 has 0 from there on",
        ),
        ((RISING, RISING), np.full(9, np.nan), "a column must hold numbers"),
        ((RISING, RISING), np.ones(9), "a measurement must vary"),
        (
            (RISING, np.where(RISING == 0.05, np.nan, RISING)),
            RISING,
            "every sample must have a time, but one of 'b.n'",
        ),
        ((RISING, np.append(RISING, 1.0)), RISING, "must have times, but there are none beside 'b.n'"),
    ],
)
def test_times_and_values_have_to_be_in_order(tmp_path, clocks, speeds, said):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a/t"], file["b/t"], file["a/u"], file["b/n"] = *clocks, RISING, speeds
    refused(tmp_path / "a.h5", said, lambda path: read_log(path, MODEL, {"V_s": "a.u", "tach": "b.n"}))


def test_an_array_that_is_said_to_be_huge_is_refused_before_it_is_read(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("huge", (10**12,), "f4", chunks=(1024,))[0] = 1.0  # what was never written is not read
        file["t"] = np.arange(9.0)
    refused(tmp_path / "a.h5", "the array 'huge' must be at most 2.15e.09 bytes, but got 8e.12")
    assert set(read(tmp_path / "a.h5", ["t"])) == {"t"}
    savemat(tmp_path / "a.mat", {"v": np.arange(1234.0)})
    data = (tmp_path / "a.mat").read_bytes()
    shape = struct.pack("<ii", 1, 1234)
    assert data.count(shape) == 1
    (tmp_path / "a.mat").write_bytes(data.replace(shape, struct.pack("<ii", 10**6, 10**6)))
    refused(tmp_path / "a.mat", "the array 'v' must be at most 2.15e.09 bytes, but got 8e.12")


def test_what_unpacks_to_more_than_may_be_read_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(topics, "MOST_BYTES", 10**7)
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    for tag, size, said in (
        (
            struct.pack("<II", 14, 15_000_000),
            15_000_000,
            "what a MATLAB file holds must be at most 1e.07 bytes, but got [1-2]",
        ),
        (
            struct.pack("<II", 14, 2**32 - 8),
            10,
            "what a MATLAB file holds must be at most 1e.07 bytes, but got 4.29e.09",
        ),
        (
            struct.pack("<II", 0, 0),
            3 * 10**7,
            "it holds an array that is packed and damaged",
        ),  # says 0: no more is unpacked
        (struct.pack("<II", 14, 1000), 10, "it holds a damaged element"),
    ):
        packed = zlib.compress(tag + bytes(size))
        (tmp_path / "a.mat").write_bytes(header + struct.pack("<II", 15, len(packed)) + packed)
        refused(tmp_path / "a.mat", said)
    write_ulog(tmp_path / "a.ulg", [("v", 0, "float x;", {"timestamp": np.arange(9), "x": np.arange(9)})])
    monkeypatch.setattr(topics, "MOST_BYTES", 100)
    refused(tmp_path / "a.ulg", "a ULog must be at most 100 bytes, but got")
    write_bag(tmp_path / "a.bag", bag_topics(20))
    refused(tmp_path / "a.bag", "a chunk of a bag must be at most 100 bytes")
    write_bag(
        tmp_path / "b.bag", [("/b", "std_msgs/msg/UInt8MultiArray", [(1 + k, sixty_bytes) for k in range(99)])]
    )
    monkeypatch.setattr(topics, "MOST_BYTES", 30_000)
    refused(tmp_path / "b.bag", "the numbers of a bag must be at most 3e.04 bytes")


def sixty_bytes(types, kind):
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    return types["std_msgs/msg/UInt8MultiArray"](layout, np.zeros(60, np.uint8))


@pytest.mark.parametrize(
    ("place", "byte"), [(26, 1), (28, 0), (24, 9), (48, 0), (48, 19), (48, 254), (49, 128), (16, 99)]
)
def test_a_matlab_file_on_which_scipy_would_crash_is_refused(tmp_path, place, byte):
    """Most of these end the process that hands them to SciPy 1.17: unknown types of elements, no sides."""
    savemat(tmp_path / "a.mat", {"t": np.arange(9.0)})
    data = bytearray((tmp_path / "a.mat").read_bytes())
    assert data[128 + 24] == 5 and data[128 + 48] == 9  # the type of the sides, and that of the numbers
    data[128 + place] = byte
    (tmp_path / "a.mat").write_bytes(data)
    refused(tmp_path / "a.mat", "it holds a|it ends within an")


def formats(*texts):
    """A ULog of these formats."""
    out = b"ULog\x01\x12\x35\x01" + bytes(8)
    for text in texts:
        out += struct.pack("<HB", len(text), ord("F")) + text.encode()
    name = texts[-1].partition(":")[0]
    return out + struct.pack("<HBBH", 3 + len(name), ord("A"), 0, 1) + name.encode()


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (["a:a[2] x;"], "holds itself"),
        (["a:b x;", "b:a x;"], "holds itself"),
        (["a:float[60000] x;"], "has 6e.04 fields"),
        (["a:float[999] x;", "b:a[999] x;", "c:b[999] x;"], "fields"),
        (["a:float[99999999] x;"], "holds no data"),
    ],
)
def test_a_ulog_of_endless_formats_is_refused(tmp_path, texts, said):
    (tmp_path / "a.ulg").write_bytes(formats(*texts))
    refused(tmp_path / "a.ulg", said)


def test_links_objects_and_numbers_in_other_files_are_refused_by_name(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["secret"] = np.arange(9.0)
    layout = h5py.VirtualLayout((9,), "f8")
    layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "secret", (9,))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"] = np.arange(9.0)
        file["outside"], file["inside"] = h5py.ExternalLink("other.h5", "secret"), h5py.SoftLink("/t")
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("raw", (9,), "f8", external=[(str(tmp_path / "other.h5"), 0, 72)])
        file.create_dataset("objects", (9,), h5py.special_dtype(ref=h5py.Reference))
        file.create_dataset("texts", (9,), h5py.string_dtype())
        file["complex"] = np.ones(9, complex)
    assert set(read(tmp_path / "a.h5", None)) == {"t"}
    for name in ("outside", "inside", "virtual", "raw", "objects", "texts", "complex"):
        refused(
            tmp_path / "a.h5",
            f"must be an array of numbers, but {name!r} is",
            lambda path, name=name: read(path, [name]),
        )
    cells, record = np.array([1.0, "x"], object), np.array([(np.arange(9.0),)], [("d", object)])
    content = {
        "cells": cells,
        "z": np.arange(9.0) * 1j,
        "s": {"c": cells},
        "series": MatlabObject(record, "timeseries"),
    }
    savemat(tmp_path / "a.mat", {"t": np.arange(9.0), **content})
    assert set(read(tmp_path / "a.mat", None)) == {"t"}
    for name in ("cells", "z", "s.c", "series"):
        refused(tmp_path / "a.mat", "must be an array of numbers", lambda path, name=name: read(path, [name]))


@pytest.mark.parametrize(
    "text",
    [
        "float64 x\nfloat64[4000000000] y\n",
        "float64 x\nA[9999999] y\n" + "=" * 80 + "\nMSG: p/A\nuint8 z\n",
        "float64 x\nA[] y\n" + "=" * 80 + "\nMSG: p/A\nE z\n" + "=" * 80 + "\nMSG: p/E\n# nothing\n",
        "float64 x\nimport os\n'''",
    ],
)
def test_types_that_a_bag_defines_are_checked_before_they_become_classes(tmp_path, text):
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(tmp_path / "b", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/x", "p/msg/B", msgdef=text, rihs01="RIHS01_" + "0" * 64)
        writer.write(connection, 1, b"\x00\x01\x00\x00" + bytes(64))
    refused(tmp_path / "b", "must be one, but .* is not")


def test_without_its_package_a_file_is_answered_with_the_extra(tmp_path):
    for ending, name in ((".ulg", "pyulog"), (".bin", "pymavlink"), (".bag", "rosbags"), (".h5", "h5py")):
        path = write_good(tmp_path / f"a{ending}")
        code = f"import sys; sys.modules[{name!r}] = None\n"
        code += f"from thruster_env.logs.recorders.registry import fields\nfields({str(path)!r})"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert f"must be read by {name}, which is not installed (pip install '.[recorders]' in" in done.stderr


def test_reading_takes_little_more_memory_than_what_is_read(tmp_path):
    """A child process may have no more than twice what its imports take."""
    write_good(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file.create_dataset("huge", (2 * 10**8,), "f8", chunks=(10**6,))
    code = (
        "import resource, sys, numpy, h5py\nfrom thruster_env.logs.recorders.registry import read\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        f"read({str(tmp_path / 'a.h5')!r}, ['v'])\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 50_000  # [kB]
