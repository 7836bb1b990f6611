"""Recordings that are damaged, put together or packed: as many messages as were written, each field by its name.

The counts are those that the formats' own writers were given. Of a damaged file all are read, or it is refused, or
(of the logs of autopilots, which a loss of power cuts off anywhere) the damage is said.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from pathlib import Path

import h5py
import numpy as np
import pyarrow
from pyarrow import parquet
from scipy.io import savemat

from tests.fuzz.files import _damaged
from tests.thruster_env.logs.recorders.files import EPOCH, dataflash, write_definitions
from thruster_env.logs.recorders.registry import contents, read
from thruster_env.logs.table import read_table

AUTOPILOTS, BAGS = (".bin", ".ulg"), (".mcap", ".bag", ".db3")
TABLES = (".npz", ".parquet", ".csv")
FIELDS = ("x", "y", "z", "w")


def message_counts(rng: np.random.Generator, seconds: float) -> str:
    """Bags and logs of autopilots with bytes zeroed, flipped, doubled or cut off: no message is lost unsaid."""
    from tests.thruster_env.logs.recorders.test_bad_recordings import write_good

    counts, end = Counter(), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        good = {}
        for ending in (*AUTOPILOTS, *BAGS):
            path = write_good(Path(folder) / f"{ending[1:]}{ending}")
            good[ending] = path.read_bytes(), _by_topic(path)
        while not counts or time.monotonic() < end:
            ending = str(rng.choice([*good]))
            data, written = good[ending]
            data = rng.choice([_zeroed, _damaged, _one_bit])(rng, data) or data
            path = Path(folder) / f"{counts.total()}{ending}"
            path.write_bytes(data)
            try:
                found = contents(path)
            except ValueError as error:
                assert str(error) and "\n" not in str(error), repr(error)
                counts["refused"] += 1
                continue
            finally:
                path.unlink()
            same = sorted(_by_topic_of(found).values()) == sorted(written.values())
            if ending in BAGS:
                assert same or found.unread, f"{ending}: {_by_topic_of(found)} of {written}"
            elif not good[ending][0].startswith(data.rstrip(b"\0")) and sum(_by_topic_of(found).values()) < sum(
                written.values()
            ):
                assert found.damage or found.unread, f"{ending}: {_by_topic_of(found)} of {written}"
            counts["whole" if same else "said to be damaged"] += 1
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def two_definitions(rng: np.random.Generator, seconds: float) -> str:
    """Topics whose fields have other places, and others beside them, in a second definition, in all formats."""
    kinds, counts, end = ("ros1", "mcap", "sqlite3", ".bin"), Counter(), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        while not counts or time.monotonic() < end:
            kind = str(rng.choice(kinds))
            orders = [list(rng.permutation(FIELDS)[: rng.integers(1, 5)]) for _ in range(rng.integers(1, 4))]
            rows = [rng.normal(size=(int(rng.integers(2, 9)), len(FIELDS))) for _ in orders]
            path = Path(folder) / f"{counts.total()}"
            if kind == ".bin":
                path = _write_dataflash(path, orders, rows)
            else:
                path = path.with_suffix(".bag" if kind == "ros1" else "")
                write_definitions(path, kind, orders, rows, FIELDS)
            name = "A" if kind == ".bin" else "/m"
            found = read(path, None)
            assert set(found) == {f"{name}.{key}" for order in orders for key in order}
            for place, key in enumerate(FIELDS):
                expected = [
                    np.where(key in order, part[:, place], np.nan)
                    for order, part in zip(orders, rows, strict=True)
                ]
                if f"{name}.{key}" in found:
                    np.testing.assert_array_equal(found[f"{name}.{key}"].values, np.concatenate(expected))
            counts[kind] += 1
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def transforms_of_bags(rng: np.random.Generator, seconds: float) -> str:
    """Transforms of random frames in bags of all kinds: of each pair the numbers and stamps that were written."""
    from tests.thruster_env.logs.recorders.test_transforms import FIELDS as NUMBERS
    from tests.thruster_env.logs.recorders.test_transforms import write_transforms

    frames = ["map", "odom", "base_link", "r1.arm", "imu[0]", "Größe"]
    counts, end = Counter(), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        while not counts or time.monotonic() < end:
            kind, path = str(rng.choice(["ros1", "mcap", "sqlite3"])), Path(folder) / f"{counts.total()}"
            expected: dict[str, list[tuple[int, np.ndarray]]] = {}
            messages = []
            for k in range(rng.integers(1, 20)):
                topic, array = str(rng.choice(["/tf", "/tf_static", "/r/tf"])), []
                for _ in range(rng.integers(0, 4)):
                    parent, child = rng.choice(frames, 2)
                    stamp, numbers = EPOCH + int(rng.integers(10**10)), rng.normal(size=7)
                    array.append((str(parent), str(child), stamp, numbers))
                    expected.setdefault(f"{topic}/{parent}/{child}", []).append((stamp, numbers))
                messages.append((topic, EPOCH + k, array))
            write_transforms(path, messages, kind)
            found = read(path, None)
            assert set(found) == {f"{pair}.{field}" for pair in expected for field in NUMBERS}
            for pair, rows in expected.items():
                rows.sort(key=lambda row: row[0])
                for place, field in enumerate(NUMBERS):
                    one = found[f"{pair}.{field}"]
                    np.testing.assert_array_equal(one.values, [numbers[place] for _, numbers in rows])
                    np.testing.assert_allclose(one.times, [(stamp - EPOCH) / 1e9 for stamp, _ in rows], atol=1e-9)
            counts[kind] += 1
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def flipped_bits(rng: np.random.Generator, seconds: float) -> str:
    """Flipped bits of files with check sums (npz, MATLAB, Parquet, HDF5): the numbers of the file, or one line.

    Names of the columns of Parquet have none: an array may be missing.
    """
    counts, end, kinds = Counter(), time.monotonic() + seconds, (".npz", ".mat", ".parquet", ".h5")
    with tempfile.TemporaryDirectory() as folder:
        while not counts or time.monotonic() < end:
            columns = {"t": 0.1 * np.arange(900), "voltage": np.round(rng.normal(size=900), 2)}
            path = Path(folder) / f"a{rng.choice(kinds, p=[0.4, 0.4, 0.1, 0.1])}"
            _write_with_check_sums(path, columns, rng)
            data = path.read_bytes()
            for _ in range(50 if path.suffix in (".npz", ".mat") else 3):  # a process of its own reads the others
                bad, first = bytearray(data), 128 if path.suffix == ".mat" else 0
                for place in rng.integers(first, len(bad), rng.integers(1, 3)):
                    bad[place] ^= 1 << int(rng.integers(8))
                path.write_bytes(bad)
                try:
                    if path.suffix in TABLES:
                        table = read_table(path)
                        some = {one: table.numbers(one) for one in table.names}
                    else:
                        some = {one: samples.values for one, samples in read(path, None).items()}
                except ValueError as error:
                    assert str(error) and "\n" not in str(error), repr(error)
                    counts["refused"] += 1
                    continue
                for name, values in columns.items():
                    assert name in some or path.suffix in (".parquet", ".h5"), (path.suffix, [*some])
                    np.testing.assert_array_equal(some.get(name, values), values)
                counts["read" if set(some) == set(columns) else "read in part"] += 1
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def _write_with_check_sums(path: Path, columns: dict[str, np.ndarray], rng: np.random.Generator) -> None:
    """Write arrays such that all of them are under check sums."""
    if path.suffix == ".mat":
        savemat(path, columns, do_compression=True)
    elif path.suffix == ".parquet":
        packing = str(rng.choice(["none", "snappy", "zstd"]))
        parquet.write_table(pyarrow.table(columns), path, write_page_checksum=True, compression=packing)
    elif path.suffix == ".h5":
        with h5py.File(path, "w", libver="latest") as file:
            for name, values in columns.items():
                file.create_dataset(name, data=values, chunks=(200,), fletcher32=True)
    else:
        rng.choice([np.savez, np.savez_compressed])(path, **columns)


def _by_topic(path: Path) -> dict[str, int]:
    return _by_topic_of(contents(path))


def _by_topic_of(found) -> dict[str, int]:
    return {one.topic: one.samples for one in found.fields}


def _zeroed(rng: np.random.Generator, data: bytes) -> bytes:
    """Zeros in place of some bytes, as of a block that was never written."""
    place, length = int(rng.integers(len(data))), int(rng.integers(1, 200))
    return (data[:place] + bytes(length) + data[place + length :])[: len(data)]


def _one_bit(rng: np.random.Generator, data: bytes) -> bytes:
    """One flipped bit, behind the first bytes."""
    bad = bytearray(data)
    bad[int(rng.integers(16, len(bad)))] ^= 1 << int(rng.integers(8))
    return bytes(bad)


def _write_dataflash(path: Path, orders: list[list[str]], rows: list[np.ndarray]) -> Path:
    """Logs put together, each with its own format of message A."""
    out, row = b"", 0
    for order, part in zip(orders, rows, strict=True):
        places = [FIELDS.index(key) for key in order]
        messages = [(1, (10_000 * (row + k), *values[places])) for k, values in enumerate(part)]
        out += dataflash({1: ("A", "Q" + "d" * len(order), ",".join(["TimeUS", *order]))}, messages)
        row += len(part)
    path = path.with_suffix(".bin")
    path.write_bytes(out)
    return path
