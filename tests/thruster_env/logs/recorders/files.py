"""Recorders' files, written by the packages' own writers, a DataFlash log by its documented format."""

import struct

import numpy as np
import pytest

h5py, *_ = (
    pytest.importorskip(name) for name in ("h5py", "pyulog", "pymavlink", "rosbags")
)  # the extra recorders
EPOCH = 1_700_000_000 * 10**9  # [ns]
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


def bag_writer(path, kind):
    """A writer of bags of ROS 1 ("ros1"), or of ROS 2 ("sqlite3", "mcap")."""
    from rosbags import rosbag1, rosbag2

    if kind == "ros1":
        return rosbag1.Writer(path)
    plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
    return rosbag2.Writer(path, version=9, storage_plugin=plugin)


def messages_of(kind):
    """The known types of messages of a bag, and the function that serialises them."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    return store, store.serialize_ros1 if kind == "ros1" else store.serialize_cdr


def write_bag(path, topics, kind="ros1"):
    """A bag of some kind: topics (name, type, [(received [ns], message)])."""
    store, serialize = messages_of(kind)
    with bag_writer(path, kind) as writer:
        for name, type_name, messages in topics:
            connection = writer.add_connection(name, type_name, typestore=store)
            for received, make in messages:
                writer.write(connection, received, serialize(make(store.types, kind), type_name))


def write_definitions(path, kind, orders, rows, fields):
    """A bag whose topic /m has several definitions, in turns: names of numbers and rows."""
    head = b"" if kind == "ros1" else b"\x00\x01\x00\x00"
    with bag_writer(path, kind) as writer:
        for part, (order, numbers) in enumerate(zip(orders, rows, strict=True)):
            text = "".join(f"float64 {key}\n" for key in order)
            own = {"md5sum": f"{part:032d}"} if kind == "ros1" else {"rihs01": f"RIHS01_{part:064d}"}
            name = "a/msg/M" if kind == "ros1" else f"a{part}/msg/M"
            connection = writer.add_connection("/m", name, msgdef=text, **own)
            for k, values in enumerate(numbers, sum(map(len, rows[:part]))):
                body = struct.pack(f"<{len(order)}d", *(values[fields.index(key)] for key in order))
                writer.write(connection, EPOCH + 10**7 * k, head + body)


def twists(values, stamps):
    """Messages with values in linear.x: with stamps [ns] in their headers, or without headers (None)."""

    def at(k):
        def make(types, kind):
            vector = types["geometry_msgs/msg/Vector3"]
            twist = types["geometry_msgs/msg/Twist"](vector(float(values[k]), 0.0, 0.0), vector(0.0, 0.0, 0.0))
            if stamps is None:
                return twist
            return types["geometry_msgs/msg/TwistStamped"](stamped(types, kind, int(stamps[k])), twist)

        return make

    return [at(k) for k in range(len(values))]


def stamped(types, kind, stamp):
    """A header with a stamp [ns]."""
    time = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return types["std_msgs/msg/Header"](**({"seq": 0} if kind == "ros1" else {}), stamp=time, frame_id="base")
