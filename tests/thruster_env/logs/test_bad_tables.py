"""Tables that are damaged, huge or oddly parted: one line each, and sizes are read before what has them."""

import io
import re
import struct
import sys
import zipfile
from collections import Counter

import numpy as np
import pytest

from tests.thruster_env.logs.test_logs import MODEL
from thruster_env.logs.read import read_log
from thruster_env.logs.recorders import topics
from thruster_env.logs.table import read_table
from thruster_env.logs.write import write_columns

COLUMNS = {"t": 0.1 * np.arange(40), "voltage": np.arange(40.0), "tach": np.arange(40.0) ** 2}


def refused(path, said):
    with pytest.raises(ValueError, match=said) as error:
        read_table(path)
    assert "\n" not in str(error.value) and path.name in str(error.value)


def test_an_npz_header_of_more_numbers_than_the_file_is_refused_before_they_are_read(tmp_path):
    header = io.BytesIO()
    text = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,), }"
    header.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + text.encode() + b"\n")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("voltage.npy", header.getvalue())
    refused(tmp_path / "a.npz", "what an npz file holds must be at most 2.15e.09 bytes, but got 8e.15")
    small = header.getvalue().replace(b"1000000000000000", b"1000000         ")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("voltage.npy", small)
    refused(tmp_path / "a.npz", "an npz file must hold arrays .* does not: 'voltage.npy' ends within its array")


@pytest.mark.parametrize("ending", [".npz", ".parquet"])
def test_what_a_table_unpacks_to_has_a_limit(tmp_path, ending, monkeypatch):
    zeros = np.zeros(200_000)
    if ending == ".npz":
        np.savez_compressed(tmp_path / "a.npz", t=zeros, voltage=zeros)
    else:
        pytest.importorskip("pyarrow")
        write_columns(tmp_path / "a.parquet", {"t": zeros, "voltage": zeros})
    assert (tmp_path / f"a{ending}").stat().st_size < 20_000
    assert len(read_table(tmp_path / f"a{ending}").lines) == 200_000
    monkeypatch.setattr(topics, "MOST_BYTES", 3_000_000)
    refused(
        tmp_path / f"a{ending}", r"what an? (npz|Parquet) file holds must be at most 3e.06 bytes, but got 3.2e.06"
    )


@pytest.mark.parametrize("ending", [".npz", ".parquet"])
def test_a_damaged_table_is_one_line(tmp_path, ending):
    if ending == ".parquet":
        pytest.importorskip("pyarrow")
    path, rng, counts = tmp_path / f"a{ending}", np.random.default_rng(2), Counter()
    if ending == ".npz":
        np.savez_compressed(path, **COLUMNS)
    else:
        write_columns(path, COLUMNS)
    data = path.read_bytes()
    for _ in range(250 if ending == ".npz" else 6):  # which a process of its own reads each time
        bad = bytearray(data)
        for place in rng.integers(len(data), size=rng.integers(1, 4)):
            bad[place] = rng.integers(256)
        path.write_bytes(bad if rng.random() < 0.8 else bad[: rng.integers(len(bad))])
        try:
            read_table(path)
            counts["read"] += 1
        except ValueError as error:
            assert "\n" not in str(error) and "None" not in str(error)  # noqa: PT017 - whether it fails is open
            counts["refused"] += 1
    assert counts["refused"] > 100 or ending == ".parquet"


def test_numbers_are_those_of_other_languages_too(tmp_path):
    for text in ("1_0", "１", "1_000.5"):  # noqa: RUF001
        (tmp_path / "a.csv").write_text(f"t,voltage,tach\n0,1,2\n1,{text},3\n2,4,4\n", encoding="utf-8")
        with pytest.raises(
            ValueError, match=f"columns must hold numbers, but got '{text}' in line 3, column 'volt"
        ):
            read_log(tmp_path / "a.csv", MODEL)
        with pytest.raises(ValueError, match="columns must hold numbers"):
            read_log({"t": [0, 1, 2], "voltage": ["1", text, "4"], "tach": [1, 2, 4]}, MODEL)


@pytest.mark.parametrize("first", ["t voltage tach", "# t   voltage tach", "#t voltage\xa0 tach"])
def test_spaces_may_part_the_cells(tmp_path, first):
    (tmp_path / "a.csv").write_text(f"{first}\n 0.0  1 2\n0.1 2 nan \n\n0.2   3 5\n", encoding="utf-8")
    log = read_log(tmp_path / "a.csv", MODEL)
    assert log.dt == pytest.approx(0.1) and log.inputs[:, 0].tolist() == [1, 2]
    np.testing.assert_array_equal(log.measurements[:, 0], [2, np.nan, 5])
    (tmp_path / "a.csv").write_text("t voltage tach\n0 1 2\n1 2\n")
    refused(tmp_path / "a.csv", "as many cells as the header, 3, but got 2 in line 3")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux limits what a process takes")
def test_a_parquet_file_that_lies_of_its_size_ends_in_one_line(tmp_path, monkeypatch):
    """A dictionary of one long text for many rows; the process may grow by little."""
    arrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    texts = arrow.DictionaryArray.from_arrays(np.zeros(30_000, dtype=np.int32), ["x" * 10_000])
    parquet.write_table(arrow.table({"t": texts}), tmp_path / "a.parquet", store_schema=False)
    monkeypatch.setattr(topics, "MOST_MEMORY", 250_000_000)
    refused(
        tmp_path / "a.parquet", r"a file must take at most 2.5e\+08 bytes of memory, but .* takes more|breaks off"
    )


@pytest.mark.parametrize(("stated", "damaged"), [(b"'<f8'", b"'<f4'"), (b"(4000,)", b"(1000,)")])
def test_an_npz_array_that_holds_more_than_its_header_says_is_refused(tmp_path, stated, damaged):
    """The check sum of a member is compared at its end, which an array of smaller numbers does not reach."""
    path = tmp_path / "a.npz"
    np.savez(path, t=0.1 * np.arange(4000), voltage=np.random.default_rng(0).normal(size=4000))
    path.write_bytes(path.read_bytes().replace(stated, damaged))
    refused(path, "'t.npy' holds more than its array")


def test_an_npz_that_lists_fewer_arrays_than_it_says_is_refused(tmp_path):
    """By the length of a comment, behind which the next array's name is taken for the comment."""
    path = tmp_path / "a.npz"
    np.savez(path, **COLUMNS)
    bad = bytearray(path.read_bytes())
    first, second, third = (one.start() for one in re.finditer(rb"PK\x01\x02", bad))
    bad[first + 32] = third - second
    path.write_bytes(bad)
    refused(path, "it says that it has 3 arrays, but lists 2")


def test_pages_of_a_parquet_file_are_compared_with_their_check_sums(tmp_path):
    arrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    path = tmp_path / "a.parquet"
    some = {"compression": "none", "use_dictionary": False, "write_page_checksum": True}
    parquet.write_table(arrow.table(COLUMNS), path, **some)
    bad = bytearray(path.read_bytes())
    bad[bad.index(np.float64(9.0).tobytes()) + 5] ^= 1
    path.write_bytes(bad)
    refused(path, "a Parquet file must be one, but .* is not: .*(CRC|checksum)")


def test_arrays_of_other_lengths_are_named(tmp_path):
    for other in (0.1, np.arange(3.0), COLUMNS["voltage"][:, None], "text"):
        np.savez(tmp_path / "a.npz", **COLUMNS, gains=other)
        refused(
            tmp_path / "a.npz",
            r"equal length with some rows, but .* has 'gains' of shape \(.* beside 't' of \(40,\)",
        )


@pytest.mark.parametrize(
    "content", ["t,voltage\n0,1\n1,2\n\0\0\0\0", "t,voltage\n0,1\n1,2\n".encode("utf-16-le").decode()]
)
def test_zero_bytes_are_named(tmp_path, content):
    """What a loss of power leaves, and UTF-16 without its mark."""
    (tmp_path / "a.csv").write_text(content)
    refused(tmp_path / "a.csv", "a CSV file must be text in UTF-8, but .* is not: a zero byte in line [14]")


def test_a_csv_that_is_cut_off_within_its_last_number_says_so(tmp_path):
    """What a loss of power leaves: -0.96 is read as -0.9, or -0."""
    path = tmp_path / "a.csv"
    text = "t,voltage,tach\n" + "".join(f"{0.1 * k:.1f},{k % 5},{np.sin(k):.2f}\n" for k in range(6))
    for end, is_cut in ((None, False), (-1, False), (-2, True), (-4, True)):
        path.write_text(text[:end])
        said = [one.sentence for one in read_log(path, MODEL).findings if one.kind == "damaged"]
        assert [one.partition(",")[0] for one in said] == [f"line 7 of {path}"] * is_cut
