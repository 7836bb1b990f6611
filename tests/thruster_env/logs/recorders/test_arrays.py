"""Arrays of MATLAB and HDF5 within structures and cells, in the units of CF, and in files that end the library."""

import struct
from collections import Counter

import numpy as np
import pytest
from scipy.io import savemat

from tests.thruster_env.logs.recorders.files import h5py
from tests.thruster_env.logs.recorders.test_bad_recordings import refused
from tests.thruster_env.logs.test_logs import MODEL
from thruster_env.logs.read import read_log
from thruster_env.logs.recorders import topics
from thruster_env.logs.recorders.registry import contents, read

RNG = np.random.default_rng(0)


def write_cycles(path, cycles, cells):
    """A structure array `run.cycle` and a cell array `c` as MATLAB 7.3 keeps them: references into #refs#."""
    with h5py.File(path, "w", userblock_size=512) as file:
        references = file.create_group("#refs#")
        group = file.create_group("run/cycle")
        file["run"].attrs["MATLAB_class"] = group.attrs["MATLAB_class"] = np.bytes_("struct")
        for key in cycles[0]:
            kept = group.create_dataset(key, (len(cycles), 1), h5py.ref_dtype)
            for place, one in enumerate(cycles):
                if isinstance(one[key], dict):
                    inner = references.create_group(f"{key}{place}")
                    inner.attrs["MATLAB_class"] = np.bytes_("struct")
                    for name, values in one[key].items():
                        inner[name] = values[None, :]
                else:
                    references[f"{key}{place}"] = np.asarray(one[key], float).reshape(1, -1)
                kept[place, 0] = references[f"{key}{place}"].ref
        kept = file.create_dataset("c", (1, len(cells)), h5py.ref_dtype)
        kept.attrs["MATLAB_class"] = np.bytes_("cell")
        for place, one in enumerate(cells):
            references[f"c{place}"] = np.asarray(one, float)
            kept[0, place] = references[f"c{place}"].ref
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


@pytest.mark.parametrize("version", ["5", "5 packed", "7.3"])
def test_arrays_of_structures_and_cells_are_read(tmp_path, version):
    """Laid out as the cycles of a battery's tests: run.cycle(i).data.V beside run.cycle(i).data.time."""
    waves, ticks = RNG.normal(size=(3, 40)), 0.5 * np.arange(40)
    cycles = [{"data": {"V": wave, "time": ticks + k}, "temperature": 24.0} for k, wave in enumerate(waves)]
    cells = [waves[0], 3.0, waves[1, :20]]
    if version == "7.3":
        write_cycles(tmp_path / "a.mat", cycles, cells)
    else:
        listed = np.empty((1, 3), object)
        listed[0] = cells
        array = np.array([tuple(one.values()) for one in cycles], [("data", object), ("temperature", object)])
        savemat(tmp_path / "a.mat", {"run": {"cycle": array}, "c": listed}, do_compression=version != "5")
    found = read(tmp_path / "a.mat", None)
    assert {"run.cycle(1).data.V", "run.cycle(3).data.time", "c{1}", "c{3}"} <= set(found) and "c{2}" not in found
    for k, wave in enumerate(waves):
        one = found[f"run.cycle({k + 1}).data.V"]
        np.testing.assert_array_equal(one.values, wave)
        np.testing.assert_array_equal(one.times, ticks + k)
    np.testing.assert_array_equal(found["c{3}"].values, waves[1, :20])
    assert contents(tmp_path / "a.mat").unread == {}
    with pytest.raises(ValueError, match="must be an array of numbers, but 'c' is a cell array"):
        read(tmp_path / "a.mat", ["c"])
    names = {"V_s": "run.cycle(2).data.V[V]", "tach": "run.cycle(2).data.V"}
    log = read_log(tmp_path / "a.mat", MODEL, names)
    np.testing.assert_array_equal(log.measurements[:, 0], waves[1])
    assert log.dt == pytest.approx(0.5)


@pytest.mark.parametrize("shape", [(2, 3), (1, 30_000)])
def test_of_arrays_of_structures_the_entries_are_counted_along_columns(tmp_path, shape):
    values = np.arange(np.prod(shape) * 4.0).reshape(*shape, 4)
    array = np.empty(shape, [("v", object)])
    for place in np.ndindex(shape):
        array[place] = (values[place],)
    savemat(tmp_path / "a.mat", {"s": array})
    if shape[1] > 20_000:
        assert contents(tmp_path / "a.mat").unread == {"s": "an array of structures"}
        return
    found = read(tmp_path / "a.mat", None)
    np.testing.assert_array_equal(found["s(2).v"].values, values[1, 0])
    np.testing.assert_array_equal(found["s(3).v"].values, values[0, 1])


def test_attributes_of_cf_scale_shift_and_leave_out(tmp_path):
    stored = np.arange(-5, 35, dtype=np.int16)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"] = np.arange(40)
        file["time"].attrs.update({"scale_factor": 10.0, "units": np.array([b"milliseconds since 2026-05-01"])})
        file["voltage"] = stored
        file["voltage"].attrs.update(
            {"scale_factor": [0.01], "add_offset": np.float32(2.5), "_FillValue": np.int16(7)}
        )
        file["force"] = stored.astype(float)
        file["force"].attrs.update({"Units": np.array(["kgf"], h5py.string_dtype()), "missing_value": [-5.0]})
        file["plain"] = stored
        file["plain"].attrs["UNIT"] = "rpm"
    found = read(tmp_path / "a.h5", None)
    expected = np.where(stored == 7, np.nan, 0.01 * stored + 2.5)
    np.testing.assert_allclose(found["voltage"].values, expected, rtol=1e-15)
    np.testing.assert_allclose(found["voltage"].times, 0.01 * np.arange(40), rtol=1e-15)
    np.testing.assert_array_equal(found["force"].values, [np.nan, *range(-4, 35)])
    assert (found["force"].unit, found["plain"].unit) == ("kgf", "rpm")
    np.testing.assert_array_equal(found["plain"].values, stored)


def test_one_dataset_that_cannot_be_read_leaves_the_others(tmp_path):
    """The bytes of one packed part are damaged."""
    values = RNG.normal(size=(2, 400))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"] = np.arange(400.0)
        for name, one in zip(("good", "bad"), values, strict=True):
            file.create_dataset(name, data=one, chunks=(400,), compression="gzip")
        place = file["bad"].id.get_chunk_info(0).byte_offset
    data = bytearray((tmp_path / "a.h5").read_bytes())
    data[place : place + 40] = bytes(40)
    (tmp_path / "a.h5").write_bytes(data)
    found = contents(tmp_path / "a.h5")
    assert {one.name for one in found.fields} == {"t", "good"} and "damaged" in found.unread["bad"]
    np.testing.assert_array_equal(read(tmp_path / "a.h5", ["good"])["good"].values, values[0])
    refused(
        tmp_path / "a.h5", "a field must be one that can be read, but 'bad' is not", lambda one: read(one, ["bad"])
    )


@pytest.mark.parametrize("when", ["at once", "while it reads"])
def test_where_the_library_ends_its_process_the_file_is_refused(tmp_path, when, monkeypatch):
    """A script that ends as the library does stands for it."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"] = np.arange(9.0)
    text = topics.SCRIPT.read_text()
    place = "    request = json" if when == "at once" else "    for line in sys.stdin:\n"
    end = "os.kill(os.getpid(), 11)\n"
    changed = text.replace(place, f"    {end}{place}" if when == "at once" else f"{place}        {end}")
    (tmp_path / "script.py").write_text(changed)
    monkeypatch.setattr(topics, "SCRIPT", tmp_path / "script.py")
    if when == "at once":
        refused(tmp_path / "a.h5", r"must be one, but .* is not: the library that reads it breaks off \(SIGSEGV\)")
    else:
        assert "breaks off (SIGSEGV)" in contents(tmp_path / "a.h5").unread["t"]


def test_flipped_bits_of_packed_arrays_are_found_by_their_check_sum(tmp_path):
    """SciPy refuses the same."""
    rng, path, counts = np.random.default_rng(5), tmp_path / "a.mat", Counter()
    values = {"t": 0.1 * np.arange(40), "voltage": np.round(rng.normal(size=40), 2)}
    savemat(path, values, do_compression=True)
    data = path.read_bytes()
    for _ in range(300):
        bad = bytearray(data)
        bad[rng.integers(136, len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(bad)
        try:
            some = read(path, None)
        except ValueError:
            counts["refused"] += 1
            continue
        for name, one in values.items():
            np.testing.assert_array_equal(some[name].values, one)
        counts["same"] += 1
    assert counts["refused"] > 250
    path.write_bytes(data + data[128:135])
    refused(path, "it ends within an array")


def test_attributes_of_valid_numbers_and_of_signs(tmp_path):
    stored = np.arange(-20, 20, dtype=np.int8)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, attributes in {
            "least": {"valid_min": np.int8(-3), "scale_factor": 0.5},
            "greatest": {"valid_max": [np.int8(4)]},
            "both": {"valid_range": np.array([-2, 5], np.int8), "add_offset": 1.0},
            "some": {"missing_value": np.array([1, 2], np.int8)},
            "unsigned": {"_Unsigned": "true", "_FillValue": np.int8(-1)},
            "nothing": {"units": h5py.Empty("S1"), "valid_max": h5py.Empty("f8")},
        }.items():
            file[name] = stored
            file[name].attrs.update(attributes)
        file["halves"] = np.arange(40, dtype=np.float16)
        file["halves"].attrs["scale_factor"] = 1e6
        file["wrong"] = stored
        file["wrong"].attrs["valid_range"] = "0, 1"
    found, wide = read(tmp_path / "a.h5", None), stored.astype(float)
    expected = {
        "least": np.where(wide < -3, np.nan, 0.5 * wide),
        "greatest": np.where(wide > 4, np.nan, wide),
        "both": np.where((wide < -2) | (wide > 5), np.nan, wide + 1.0),
        "some": np.where((wide == 1) | (wide == 2), np.nan, wide),
        "unsigned": np.where(wide == -1, np.nan, wide % 256),
        "nothing": wide,
        "halves": 1e6 * np.arange(40.0),
    }
    assert set(found) == set(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name].values, values, err_msg=name)
    assert found["nothing"].unit == ""
    assert "valid_range='0, 1' is no number" in contents(tmp_path / "a.h5").unread["wrong"]


def test_a_dataset_of_two_names_has_both(tmp_path):
    """As NeXus files have: hard links. A group within itself has no end, and is read once."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["entry/time"], file["entry/speed"] = 0.1 * np.arange(40), np.arange(40.0)
        file["entry/again"], file["data/speed"] = file["entry"], file["entry/speed"]
    some = contents(tmp_path / "a.h5")
    assert {one.name for one in some.fields} == {"entry.time", "entry.speed", "data.speed"}
    assert some.unread == {"entry.again": "a group that has another name, too"}


@pytest.mark.parametrize("form", ["mat", "h5"])
def test_sides_of_one_entry_count_for_nothing_and_larger_arrays_are_named(tmp_path, form):
    """Simulink writes the samples of a signal as 1 x 1 x N."""
    values, path = np.arange(40.0), tmp_path / f"a.{form}"
    arrays = {
        "time": 0.1 * values,
        "force": values[None, None],
        "pair": np.stack([values, 2.0 * values])[:, None],
        "cube": np.zeros((40, 2, 3)),
        "picture": np.zeros((70, 80)),
    }
    if form == "mat":
        savemat(path, arrays)
    else:
        with h5py.File(path, "w") as file:
            file.update(arrays)
    some, found = contents(path), read(path, None)
    np.testing.assert_array_equal(found["force"].values, values)
    np.testing.assert_array_equal(found["pair[1]"].values, 2.0 * values)
    np.testing.assert_array_equal(found["pair[1]"].times, 0.1 * values)
    assert set(found) == {"time", "force", "pair[0]", "pair[1]"}
    assert some.unread == {"cube": "of 3 dimensions", "picture": "a matrix of 70 times 80"}


def test_times_that_cannot_be_read_leave_the_numbers(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("time", data=RNG.normal(size=400), chunks=(100,), compression="gzip")
        file["voltage"] = np.arange(400.0)
        where = file["time"].id.get_chunk_info(1)
    with (tmp_path / "a.h5").open("r+b") as file:
        file.seek(where.byte_offset)
        file.write(bytes(50))
    some = contents(tmp_path / "a.h5")
    assert [(one.name, one.begin) for one in some.fields] == [("voltage", pytest.approx(np.nan, nan_ok=True))]
    assert "damaged" in some.unread["time"]


def test_a_dataset_that_was_never_written_is_named(tmp_path):
    """It was read as zeros."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"] = 0.1 * np.arange(40)
        file.create_dataset("voltage", (40,), "f8")
    assert contents(tmp_path / "a.h5").unread == {"voltage": "never written"}


def test_numbers_that_are_lost_or_were_never_written_are_not_zeros(tmp_path):
    """The library gives the fill value for a part whose place is lost, and fewer numbers of a smaller size."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["t"], file["short"] = np.arange(300.0), np.arange(123.0)
        for name, fill in (("part", 0.0), ("missing", np.nan)):
            file.create_dataset(name, (300,), "f8", chunks=(50,), fillvalue=fill)[100:] = 1.0 + np.arange(200.0)
    data = path.read_bytes()
    assert data.count(struct.pack("<QQ", 123, 123)) == 1
    path.write_bytes(data.replace(struct.pack("<QQ", 123, 123), struct.pack("<QQ", 100, 100)))
    found = contents(path)
    assert {one.name for one in found.fields} == {"t", "missing"}
    assert found.unread == {
        "part": "2 of its 6 parts were never written, or are lost",
        "short": "damaged: it says 800 bytes, but has 984",
    }
    assert np.isnan(read(path, ["missing"])["missing"].values[:100]).all()


def test_units_may_be_one_for_each_column(tmp_path):
    """Of any other number they were ignored: kN was taken for N."""
    path, t = tmp_path / "a.h5", 0.1 * np.arange(50)
    with h5py.File(path, "w") as file:
        file["t"] = t
        file["m"] = np.column_stack([np.sin(t), np.cos(t)])
        file["m"].attrs["units"] = ["mV", "rpm"]
        file["two"] = np.sin(t)
        file["two"].attrs["units"] = ["mV", "kV"]
    log = read_log(path, MODEL, {"V_s": "m[0]", "tach": "m[1]"})
    np.testing.assert_allclose(log.inputs[:, 0], 1e-3 * np.sin(t[:-1]), atol=1e-15)
    np.testing.assert_allclose(log.measurements[:, 0], np.pi / 30.0 * np.cos(t), atol=1e-15)
    with pytest.raises(ValueError, match="the unit of column 'two' .* but got 'mV, kV'.*name another in brackets"):
        read_log(path, MODEL, {"V_s": "two", "tach": "m[1]"})
    assert read_log(path, MODEL, {"V_s": "two[V]", "tach": "m[1]"}).inputs[1, 0] == np.sin(t[1])


def test_numbers_come_from_the_reading_process_in_their_own_kind(tmp_path):
    sent = {"d": RNG.normal(size=5), "f": RNG.normal(size=5).astype(np.float32), "i": np.arange(5, dtype=np.int16)}
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in sent.items():
            file[name] = values
    with topics.opened("hdf5", tmp_path / "a.h5") as file:
        received = [file.read(i) for i in range(len(sent))]
    for values, expected in zip(received, sent.values(), strict=True):
        assert values.dtype == expected.dtype
        np.testing.assert_array_equal(values, expected)
