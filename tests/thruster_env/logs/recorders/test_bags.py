"""Bags that are damaged, merged or packed: as many messages as they say, each field by its name, or one line."""

import os
import sqlite3
import struct
from collections import Counter

import numpy as np
import pytest

from tests.thruster_env.logs.recorders.files import write_bag, write_definitions
from tests.thruster_env.logs.recorders.test_bad_recordings import refused, write_good
from tests.thruster_env.logs.recorders.test_formats import bag_topics
from thruster_env.logs.recorders import topics
from thruster_env.logs.recorders.bag_counts import counts_of
from thruster_env.logs.recorders.registry import fields, read


def samples_by_topic(path):
    return {one.topic: one.samples for one in fields(path)}


@pytest.mark.parametrize("ending", [".mcap", ".bag", ".db3"])
def test_of_a_damaged_bag_all_messages_are_read_or_none(tmp_path, ending):
    path, rng = write_good(tmp_path / f"a{ending}"), np.random.default_rng(3)
    data, expected, accepted = path.read_bytes(), samples_by_topic(path), Counter()
    assert all({*counts.values()} == {100} for counts in counts_of(path).values())
    for _ in range(60):
        place, length = int(rng.integers(len(data))), int(rng.integers(1, 80))
        path.write_bytes((data[:place] + bytes(length) + data[place + length :])[: len(data)])
        try:
            got = samples_by_topic(path)
        except ValueError as error:
            assert "\n" not in str(error)  # noqa: PT017 - whether it fails is open
            continue
        accepted[sorted(got.values()) == sorted(expected.values())] += 1
    assert not accepted[False] and accepted[True]


def test_fifty_seven_zeros_in_an_mcap_file_are_said(tmp_path):
    """The zeros are records of no known kind, and what follows is read as if it were another one."""
    path = write_good(tmp_path / "a.mcap")
    data = path.read_bytes()
    place = 28_000
    path.write_bytes(data[:place] + bytes(57) + data[place + 57 :])
    refused(path, "a bag must hold the messages that it says it has, but '/.*' has .* of 100 by its statistics")


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_messages_of_two_definitions_are_matched_by_the_names_of_fields(tmp_path, kind):
    """In the second one z stands where x was; w is new."""
    rows = np.column_stack([np.arange(10) + 0.1, np.arange(10) + 100.0, np.full(10, -7.0)])
    write_definitions(tmp_path / "a.bag", kind, ["xz", "zwx"], [rows, rows], "xzw")
    found = read(tmp_path / "a.bag", None if kind == "ros1" else ["/m.x", "/m.z", "/m.w"])
    twice = np.tile(np.arange(10.0), 2)
    np.testing.assert_array_equal(found["/m.x"].values, twice + 0.1)
    np.testing.assert_array_equal(found["/m.z"].values, twice + 100.0)
    np.testing.assert_array_equal(found["/m.w"].values, [np.nan] * 10 + [-7.0] * 10)
    np.testing.assert_allclose(found["/m.w"].times, 0.01 * np.arange(20), atol=1e-12)


def test_a_folder_has_as_many_messages_as_its_metadata_says(tmp_path):
    write_bag(tmp_path / "a", bag_topics(20), "sqlite3")
    file = next((tmp_path / "a").glob("*.db3"))
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM messages WHERE id IN (3, 4, 50)")
    refused(tmp_path / "a", "but '/.*' has 1[89] of 20 by its metadata.yaml")
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET topic_id = 77 WHERE id = 5")
    refused(file, "but a topic without a name has 0 of 1 by its table of messages")
    (tmp_path / "a" / f"{file.name}-wal").write_bytes(b"x" * 40)
    refused(file, "a bag must be closed, but rows of .* are still in .*-wal")


@pytest.mark.parametrize("stated", [True, False])
def test_what_a_packed_bag_unpacks_to_has_a_limit_on_the_disk(tmp_path, stated, monkeypatch):
    """A .db3.zstd of zeros; its header says how many, or not."""
    zstd = pytest.importorskip("backports.zstd")
    write_bag(tmp_path / "a", bag_topics(20), "sqlite3")
    file, metadata = next((tmp_path / "a").glob("*.db3")), tmp_path / "a" / "metadata.yaml"
    text = metadata.read_text().replace(file.name, f"{file.name}.zstd")
    text = text.replace("compression_format: ''", "compression_format: zstd").replace(
        "compression_mode: ''", "compression_mode: file"
    )
    metadata.write_text(text)
    packed, whole = file.with_name(f"{file.name}.zstd"), file.read_bytes()
    file.unlink()
    packed.write_bytes(zstd.compress(whole))
    assert set(samples_by_topic(tmp_path / "a").values()) == {20}
    if stated:
        packed.write_bytes(zstd.compress(whole + bytes(10**7)))
    else:
        with zstd.open(packed, "wb") as target:
            target.write(whole + bytes(10**7))
    monkeypatch.setattr(topics, "MOST_BYTES", 10**6)
    before = {*os.listdir("/tmp")} if os.path.isdir("/tmp") else set()
    refused(tmp_path / "a", "what the files of a bag unpack to must be at most 1e.06 bytes, but got ")
    assert {one for one in os.listdir("/tmp") if one not in before and one.endswith(".db3")} == set()


def test_an_mcap_file_whose_parts_contradict_one_another_is_refused(tmp_path):
    path = write_good(tmp_path / "a.mcap")
    data = path.read_bytes()
    summary = struct.unpack("<Q", data[-28:-20])[0]
    statistics = summary
    while data[statistics] != 11:
        statistics += 9 + struct.unpack_from("<Q", data, statistics + 1)[0]
    assert struct.unpack_from("<Q", data, statistics + 9)[0] == 300
    path.write_bytes(data[: statistics + 9] + struct.pack("<Q", 301) + data[statistics + 17 :])
    refused(path, "its statistics say 301 messages, but 300 by channel|check sum of its summary")


@pytest.mark.parametrize("kind", [3, 4])
def test_an_mcap_file_that_does_not_repeat_its_schemas_or_channels_is_not_called_damaged(tmp_path, kind):
    """Their summary may be without, as `Writer(repeat_channels=False)` of the package mcap writes it."""
    path = write_good(tmp_path / "a.mcap")
    data, place, changed = bytearray(path.read_bytes()), 8, 0
    while place < len(data) - 8:
        changed += data[place] == kind
        data[place] = 0x81 if data[place] == kind else data[place]  # a record that only its writer knows
        place += 9 + struct.unpack_from("<Q", data, place + 1)[0]
    assert changed
    path.write_bytes(data)
    refused(path, "must have its schemas and channels in its summary, but .* mcap recover writes one that is read")
