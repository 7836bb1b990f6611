"""Files of every format with a force and a speed, on one clock or two: samples belong together, or it is said."""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from pathlib import Path

import h5py
import numpy as np
from scipy.io import savemat

from tests.fuzz.logs import MODEL
from tests.thruster_env.logs.recorders.files import dataflash, twists, write_bag, write_ulog
from thruster_env.logs.read import read_log
from thruster_env.logs.recorders.registry import fields
from thruster_env.logs.write import write_columns

EPOCH = 1_700_000_000  # [s]
BAGS = {"ros1": ".bag", "sqlite3": "", "mcap": ""}
FORMATS = (*BAGS, "ulg", "bin", "mat", "h5", "csv", "npz")
ORIGINS = (0.0, 5.0, 12_345.0, float(EPOCH))  # [s], of clocks
SAID = {"clock", "outside", "no input", "gap"}


def two_clocks(rng: np.random.Generator, seconds: float) -> str:
    """A force and a speed that were sampled at the same times, by clocks with other origins and rates."""
    counts, end = Counter(), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        while not counts or time.monotonic() < end:
            form, place = str(rng.choice(FORMATS)), Path(folder) / f"run{counts.total()}"
            counts[_attack(rng, form, place)] += 1
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def _attack(rng: np.random.Generator, form: str, place: Path) -> str:
    """Write a file, and read it; AssertionError if samples are put together that are not, without a word."""
    rows, dt = int(rng.choice([40, 150])), float(rng.choice([0.004, 0.01, 0.1]))
    force = np.where(np.arange(rows) // int(rng.integers(5, 12)) % 2, -1.0, 1.0)
    speed = np.arange(rows) + 0.5  # tells the row
    origins = [float(rng.choice(ORIGINS))] * 2
    if rng.random() < 0.6:  # another clock, by a third of the log or more
        origins[1] = float(rng.choice([*ORIGINS, origins[0] + rng.uniform(0.35, 2.0) * rows * dt]))
    if form in BAGS:
        path, columns, is_one = _bag(rng, form, place, dt, force, speed, origins)
    else:
        path, columns = _other(form, place, dt, force, speed, origins)
        is_one = origins[0] == origins[1]
    options = {"stamps": str(rng.choice(["header", "receipt"]))} if form in BAGS and rng.random() < 0.3 else {}
    try:
        log = read_log(path, MODEL, columns, **options)
    except ValueError as error:
        assert str(error) and "\n" not in str(error), repr(error)
        assert not is_one or options, f"{form} on one clock is refused: {error}"
        return "refused"
    there = np.flatnonzero(~np.isnan(log.measurements[:-1, 0]))
    at = np.round(log.measurements[there, 0] - 0.5).astype(int)
    is_right = bool((abs(log.inputs[there, 0] - force[at]) < 0.2).all())
    kinds = {one.kind for one in log.findings}
    assert is_right or kinds & SAID, f"{form} {origins} {options}: samples of two clocks without a finding"
    if is_one and not options:
        assert is_right and log.steps == rows - 1 and not kinds & (SAID - {"clock"}), (form, origins, kinds)
    if form in BAGS:
        ends = {(one.clock, round(one.begin, 6)) for one in fields(path) if one.name in columns.values()}
        assert len({clock for clock, _ in ends}) == 1, "a listing on two clocks"
    return "read" if is_right else "read with a finding"


def _bag(rng, form: str, place: Path, dt: float, force, speed, origins) -> tuple[Path, dict[str, str], bool]:
    """A bag whose topics have headers of these clocks, headers without stamps, or none."""
    kinds = [str(rng.choice(["stamps", "stamps", "no stamps", "no header"])) for _ in origins]
    rate = float(rng.choice([1.0, 1.0, 0.2, 5.0]))

    def messages(values, kind, origin):
        since = np.round(1e9 * dt * np.arange(len(values))).astype(int)
        stamps = {"stamps": round(1e9 * origin) + np.round(rate * since).astype(int), "no stamps": 0 * since}
        received = (EPOCH * 10**9 + since).tolist()
        return list(zip(received, twists(values, stamps.get(kind)), strict=True))

    topics, columns = [], {}
    for name, key, values, kind, origin in zip(
        ("/f", "/v"), ("u_1", "z_1"), (force, speed), kinds, origins, strict=True
    ):
        is_plain = kind == "no header"
        type_name = f"geometry_msgs/msg/Twist{'' if is_plain else 'Stamped'}"
        topics.append((name, type_name, messages(values, kind, origin)))
        columns[key] = f"{name}.{'' if is_plain else 'twist.'}linear.x"
    path = place.with_suffix(BAGS[form])
    write_bag(path, topics, form)
    return (
        path,
        columns,
        set(kinds) != {"stamps"} or abs(origins[0] - origins[1]) > 60.0 or origins[0] == origins[1],
    )


def _other(form: str, place: Path, dt: float, force, speed, origins) -> tuple[Path, dict[str, str]]:
    """A file of another format, whose times are those of these clocks."""
    path, times = place.with_suffix(f".{form}"), [origin + dt * np.arange(len(force)) for origin in origins]
    if form == "ulg":
        ticks = [np.round(1e6 * one).astype(np.int64) for one in times]
        topics = [("f", "x", force, ticks[0]), ("v", "y", speed, ticks[1])]
        write_ulog(path, [(n, 0, f"double {key};", {"timestamp": t, key: one}) for n, key, one, t in topics])
        return path, {"u_1": "f.x", "z_1": "v.y"}
    if form == "bin":
        ticks = [np.round(1e6 * one).astype(int).tolist() for one in times]
        rows = [(1, row) for row in zip(ticks[0], force.tolist(), strict=True)]
        rows += [(2, row) for row in zip(ticks[1], speed.tolist(), strict=True)]
        path.write_bytes(dataflash({1: ("CMD", "Qd", "TimeUS,X"), 2: ("SPD", "Qd", "TimeUS,Y")}, rows))
        return path, {"u_1": "CMD.X", "z_1": "SPD.Y"}
    groups = {"f": {"t": times[0], "force": force}, "v": {"t": times[1], "speed": speed}}
    if form == "mat":
        savemat(path, groups)
    elif form == "h5":
        with h5py.File(path, "w") as file:
            for group, arrays in groups.items():
                for key, values in arrays.items():
                    file[f"{group}/{key}"] = values
    else:  # a table of all times
        every = np.unique(np.concatenate(times))
        columns = {"t": every, "force": np.full(len(every), np.nan), "speed": np.full(len(every), np.nan)}
        columns["force"][np.searchsorted(every, times[0])] = force
        columns["speed"][np.searchsorted(every, times[1])] = speed
        write_columns(path, columns, "exact")
        return path, {}
    return path, {"u_1": "f.force", "z_1": "v.speed"}
