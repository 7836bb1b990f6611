"""Recorders' files, written by the packages' own writers, a DataFlash log by its documented format."""

import struct

import numpy as np
import pytest

h5py, *_ = (
    pytest.importorskip(name) for name in ("h5py", "pyulog", "pymavlink", "rosbags")
)  # the extra recorders
STRUCT = {"Q": "Q", "f": "f", "d": "d", "c": "h", "C": "H", "L": "i", "B": "B", "h": "h", "n": "4s", "N": "16s"}
STRUCT |= {"Z": "64s", "a": "64s", "b": "b", "H": "H", "I": "I"}


def write_ulog(path, topics):
    """A ULog of topics: (name, instance, "type name; ...", columns as of `numpy.void`), by pyulog's writer."""
    from pyulog import ULog

    log = ULog(None)
    for number, (name, instance, text, rows) in enumerate(topics):
        log._message_formats[name] = ULog.MessageFormat(f"{name}:uint64_t timestamp;{text}".encode(), None)
        added = struct.pack("<BH", instance, number) + name.encode()
        subscription = ULog._MessageAddLogged(added, None, log._message_formats)
        table = np.zeros(len(rows["timestamp"]), subscription.dtype)
        for key, values in rows.items():
            table[key] = values
        subscription.buffer += table.tobytes()
        log._data_list.append(ULog.Data(subscription))
    log.write_ulog(str(path))


def dataflash(kinds, messages, units=None):
    """Bytes of a DataFlash log as of ArduPilot's LogStructure.h.

    Args:
        kinds: by number from 1, (name, format, columns).
        messages: (number, values), in order.
        units: letters of units and of multipliers, by number: ("s#d", "F-0").
    """
    out = bytearray()
    own = {0x80: ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns"), **dict(kinds)}
    if units is not None:
        own |= {0x90: ("UNIT", "QbZ", "TimeUS,Id,Label"), 0x91: ("MULT", "Qbd", "TimeUS,Id,Mult")}
        own |= {0x92: ("FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds")}

    def add(number, *values):
        layout = "<" + "".join(STRUCT[one] for one in own[number][1])
        packed = [one.encode() if isinstance(one, str) else one for one in values]
        out.extend(bytes([0xA3, 0x95, number]) + struct.pack(layout, *packed))

    for number, (name, layout, columns) in own.items():
        size = 3 + struct.calcsize("<" + "".join(STRUCT[one] for one in layout))
        add(0x80, number, size, name, layout, columns)
    if units is not None:
        for letter, label in (("s", "s"), ("v", "V"), ("k", "deg"), ("D", "deglatitude"), ("#", "instance")):
            add(0x90, 0, ord(letter), label)
        for letter, factor in (("F", 1e-6), ("B", 1e-2), ("C", 1e-3), ("0", 1.0)):
            add(0x91, 0, ord(letter), factor)
        for number, (ids, multipliers) in units.items():
            add(0x92, 0, number, ids, multipliers)
    for number, values in messages:
        add(number, *values)
    return bytes(out)


def write_bag(path, topics, kind="ros1"):
    """A bag of ROS 1, or of ROS 2 ("sqlite3", "mcap"): topics (name, type, [(received [ns], message)])."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    if kind == "ros1":
        writer, serialize = rosbag1.Writer(path), store.serialize_ros1
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer, serialize = rosbag2.Writer(path, version=9, storage_plugin=plugin), store.serialize_cdr
    with writer:
        for name, type_name, messages in topics:
            connection = writer.add_connection(name, type_name, typestore=store)
            for received, make in messages:
                writer.write(connection, received, serialize(make(store.types, kind), type_name))


def stamped(types, kind, stamp):
    """A header with a stamp [ns]."""
    time = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return types["std_msgs/msg/Header"](**({"seq": 0} if kind == "ros1" else {}), stamp=time, frame_id="base")
