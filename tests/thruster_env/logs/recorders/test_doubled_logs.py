"""Logs of autopilots that are damaged or define things twice: no row is lost without a word, no field swapped."""

import struct

import numpy as np
import pytest

from tests.thruster_env.logs.recorders.files import dataflash, write_ulog
from tests.thruster_env.logs.recorders.test_bad_recordings import refused, write_good
from tests.thruster_env.logs.test_logs import MODEL
from thruster_env.logs.read import read_log
from thruster_env.logs.recorders.registry import contents, read


def two_formats(first, second, rows=10):
    """Two DataFlash logs put together, of message A, whose fields have other places in the second one."""
    kinds = {1: ("A", "Qdd", "TimeUS,x,z"), 2: ("B", "Qf", "TimeUS,v")}
    units = None if first is None else {1: (f"s{first}", "F00"), 2: ("s-", "F0")}
    messages = [(1, (10_000 * k, k + 0.1, 100.0 + k)) for k in range(rows)]
    data = dataflash(kinds, [*messages, *((2, (10_000 * k, k)) for k in range(rows))], units)
    kinds[1] = ("A", "Qddd", "TimeUS,z,w,x")
    units = None if second is None else {1: (f"s{second}", "F000"), 2: ("s-", "F0")}
    messages = [(1, (10_000 * k, 100.0 + k, -7.0, k + 0.1)) for k in range(rows, 2 * rows)]
    return data + dataflash(kinds, [*messages, *((2, (10_000 * k, k)) for k in range(rows, 2 * rows))], units)


def test_dataflash_messages_of_two_formats_are_matched_by_the_names_of_fields(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(two_formats(None, None))
    found = read(path, None)
    np.testing.assert_array_equal(found["A.x"].values, np.arange(20) + 0.1)
    np.testing.assert_array_equal(found["A.z"].values, np.arange(20) + 100.0)
    np.testing.assert_array_equal(found["A.w"].values, [np.nan] * 10 + [-7.0] * 10)
    np.testing.assert_array_equal(found["A.x"].times, 0.01 * np.arange(20))
    np.testing.assert_array_equal(found["B.v"].values, np.arange(20.0))
    assert not contents(path).damage


def test_units_of_two_dataflash_formats_are_of_their_own_fields(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(two_formats("vk", "k-v"))
    assert {key: one.unit for key, one in read(path, ["A.x", "A.z", "A.w"]).items()} == {
        "A.x": "V", "A.z": "deg", "A.w": "",
    }  # fmt: skip
    path.write_bytes(two_formats("vk", "v-k"))
    assert contents(path).unread == {"A.x": "in V and in deg", "A.z": "in deg and in V"}


def test_a_dataflash_name_of_two_numbers_has_the_rows_of_both(tmp_path):
    kinds = {1: ("A", "Qd", "TimeUS,x"), 2: ("A", "Qd", "TimeUS,x")}
    (tmp_path / "a.bin").write_bytes(dataflash(kinds, [(1 + k % 2, (10_000 * k, k)) for k in range(40)]))
    np.testing.assert_array_equal(read(tmp_path / "a.bin", None)["A.x"].values, np.arange(40.0))


@pytest.mark.parametrize("ending", [".bin", ".ulg"])
def test_damage_is_found_in_the_log_and_in_the_listing(tmp_path, ending):
    path = write_good(tmp_path / f"a{ending}")
    columns = {"V_s": "U.V", "tach": "M.n"} if ending == ".bin" else {"V_s": "v.x", "tach": "w.x"}
    data = path.read_bytes()
    assert not contents(path).damage and not read_log(path, MODEL, columns).findings
    middle = len(data) // 2
    for bad in (data[:middle] + bytes(57) + data[middle + 57 :], data[:-5]):
        path.write_bytes(bad)
        (damage,) = contents(path).damage
        found = [one for one in read_log(path, MODEL, columns).findings if one.kind == "damaged"]
        assert [one.sentence for one in found] == [damage] and "the log" in damage


def test_a_dataflash_format_without_the_names_of_its_fields_is_said(tmp_path):
    """A zero in place of the comma in "TimeUS,V" leaves the field out."""
    path = write_good(tmp_path / "a.bin")
    data = path.read_bytes()
    assert data.count(b"TimeUS,V") == 1
    path.write_bytes(data.replace(b"TimeUS,V", b"TimeUS\0V"))
    assert contents(path).damage == ("the format of 'U' has not as many names as numbers",)


@pytest.mark.parametrize("kind", b"E@Td\x04\xc4LF")
def test_a_ulog_message_whose_kind_is_damaged_is_not_lost_unsaid(tmp_path, kind):
    """Each is one flipped bit away from D; the package passes over them as over newer kinds, text or formats."""
    path = write_good(tmp_path / "a.ulg")
    data = bytearray(path.read_bytes())
    place = len(data) // 2
    place = data.index(struct.pack("<HB", 18, ord("D")), place)
    data[place + 2] = kind
    path.write_bytes(data)
    assert sum(one.samples for one in contents(path).fields) == 599
    assert contents(path).damage == ("1 message is damaged, or of a kind that is not known",)


def ulog_of(path, change):
    """A ULog of two topics whose subscriptions are changed as bytes."""
    columns = {"timestamp": 10_000 * np.arange(30), "x": np.arange(30.0)}
    write_ulog(path, [("v", 0, "double x;", columns), ("w", 0, "double x;", columns)])
    path.write_bytes(change(path.read_bytes()))
    return path


def subscription(number, name, instance=0):
    return struct.pack("<HBBH", 3 + len(name), ord("A"), instance, number) + name


def test_a_number_of_two_ulog_subscriptions_is_refused(tmp_path):
    again = ulog_of(
        tmp_path / "a.ulg", lambda data: data.replace(subscription(1, b"w"), 2 * subscription(1, b"w"))
    )
    refused(again, "a ULog must give each subscription its own number, but .* gives 1 again, to 'w'")


def test_a_ulog_format_that_is_defined_twice_is_refused(tmp_path):
    text = b"v:uint64_t timestamp;double x;"
    other = b"v:uint64_t timestamp;float a;float x;"
    add = struct.pack("<HB", len(other), ord("F")) + other

    def change(data):
        place = data.index(text) - 3
        return data[:place] + add + data[place:]

    refused(ulog_of(tmp_path / "a.ulg", change), "a ULog must define a format once, but .* defines 'v' twice")


def test_a_ulog_topic_of_two_numbers_has_the_rows_of_both(tmp_path):
    ticks = 10_000 * np.arange(30)
    parts = [{"timestamp": ticks[k::2], "x": 1.0 * np.arange(30)[k::2]} for k in range(2)]
    write_ulog(tmp_path / "a.ulg", [("v", 0, "double x;", one) for one in parts])
    np.testing.assert_array_equal(read(tmp_path / "a.ulg", None)["v.x"].values, np.arange(30.0))
