"""ArduPilot's DataFlash logs (.bin), whose index and units are by the package pymavlink."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.plants.logs.recorders.topics import Topic, Wanted, columns_of, package, reading, silent

KIND = "DataFlash log"
MAGIC = b"\xa3\x95"
STAMPS = {"TimeUS": 1e6, "TimeMS": 1e3}  # ticks a second
HEADER = 3  # bytes before the body of a message
NUMBERS = {  # NumPy's kind of each of ArduPilot's, and by what a message's number is divided
    **{"b": ("i1", 1.0), "B": ("u1", 1.0), "M": ("u1", 1.0), "h": ("<i2", 1.0), "H": ("<u2", 1.0)},
    **{"i": ("<i4", 1.0), "I": ("<u4", 1.0), "q": ("<i8", 1.0), "Q": ("<u8", 1.0)},
    **{"g": ("<f2", 1.0), "f": ("<f4", 1.0), "d": ("<f8", 1.0), "a": ("V64", 1.0)},  # a: 32 of int16
    **{"c": ("<i2", 1e2), "C": ("<u2", 1e2), "e": ("<i4", 1e2), "E": ("<u4", 1e2), "L": ("<i4", 1e7)},
}
FORMATS = ("FMT", "FMTU", "UNIT", "MULT")  # messages that describe others
TEXTS = {"n": 4, "N": 16, "Z": 64}  # bytes
UNITS = {**dict.fromkeys(("degheading", "deglatitude", "deglongitude"), "deg"), "instance": ""}  # ArduPilot's own


def topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The messages of a DataFlash log: times are TimeUS/10^6 (in old logs TimeMS/10^3), [s] since start.

    Units are those of the messages UNIT, MULT and FMTU, where the log has them. Instance 1 of a message, by the
    field that FMTU marks, is NAME#1. What a loss of power cut off is read up to there.

    Args:
        path: of the file.
        wanted: columns whose messages are read; None for all.

    Raises:
        ValueError: if it is no DataFlash log.

    Source: ArduPilot, AP_Logger, "LogStructure.h".
    """
    reader = package("pymavlink.DFReader", KIND, path)
    with reading(KIND, path), silent():
        with _without_clock(reader.DFReader_binary)(str(path)) as index:
            formats, offsets = dict(index.formats), [np.array(one, np.int64) for one in index.offsets]
        if not any(len(offsets[kind]) for kind, form in formats.items() if form.name not in FORMATS):
            raise ValueError("it holds no messages but those that describe others")
    content = np.memmap(path, np.uint8, "r")
    names = None if wanted is None else {one.partition(".")[0].partition("#")[0] for one in wanted}
    for kind, form in sorted(formats.items(), key=lambda item: item[1].name):
        whole = offsets[kind][offsets[kind] + form.len <= len(content)]
        if len(whole) and form.name not in FORMATS and (names is None or form.name in names):
            yield from _instances(form, content, whole)


@cache
def _without_clock(reader: type) -> type:
    """The reader, which does not look through the whole log for the date: stamps count from the start."""
    return type("Index", (reader,), {"init_clock": lambda self: None})


def _instances(form: Any, content: np.ndarray, offsets: np.ndarray) -> Iterator[Topic]:
    """The topics of a message: one, or one an instance.

    Args:
        form: pymavlink's format of the message.
        content: of the file, bytes.
        offsets: of the messages (samples,).
    """
    columns, ticks = {}, None
    for name, kind, numbers in _columns(form, content, offsets):
        if name in STAMPS and ticks is None:
            ticks = numbers / STAMPS[name]
        else:
            columns[name] = numbers if kind != "a" else numbers.view("<i2").reshape(-1, 32)
    if ticks is None:
        return
    units = {name: unit for name, unit in zip(form.columns, form.units or (), strict=False) if unit}
    units = {name: UNITS.get(unit, unit) for name, unit in units.items()}
    which = columns.get(form.instance_field, np.zeros(len(ticks), int))
    for number in np.unique(which):
        own = which == number
        fields = {
            key: one for name, values in columns.items() for key, one in columns_of(name, values[own]).items()
        }
        name = f"{form.name}#{number:g}" if number else form.name
        yield Topic(name, ticks[own], fields, {key: units.get(key.partition("[")[0], "") for key in fields})


def _columns(form: Any, content: np.ndarray, offsets: np.ndarray) -> Iterator[tuple[str, str, np.ndarray]]:
    """Name, ArduPilot's kind and numbers (samples,) of each column of a message that holds numbers."""
    place = HEADER
    for name, kind in zip(form.columns, form.format, strict=False):
        if kind in TEXTS:
            place += TEXTS[kind]
            continue
        kept, divisor = np.dtype(NUMBERS[kind][0]), NUMBERS[kind][1]
        place += kept.itemsize
        if place > form.len:
            return
        at = offsets + (place - kept.itemsize)
        bytewise = np.ndarray((len(content) - kept.itemsize + 1,), kept, content, strides=(1,))
        numbers = bytewise[at]
        yield name, kind, numbers if divisor == 1.0 else numbers / divisor
