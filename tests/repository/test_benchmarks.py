import inspect
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import PARTS, command, rows_of
from benchmarks.batches import NORMALS, array_filter
from benchmarks.timing import HEADER, NO_BREAK, Row, Timing, check_page, write_page
from filters import EnsembleKalmanFilter, thruster_model
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, fill_normals
from thruster_env.thruster.plant import make_plant


@pytest.mark.slow
def test_each_part_of_the_benchmark_can_be_measured_quickly():
    """Some rows of one part; that all parts run is for the slow test."""
    pytest.importorskip("filterpy")
    for part in PARTS:
        assert list(inspect.signature(rows_of(part)).parameters) == ["seed", "quick"]
    row = next(rows_of("steps")(0, True))
    assert row.timing.ours > 0


@pytest.mark.slow
def test_the_quick_benchmark_measures_the_rows_of_parts():
    """Of those with other packages and machine code of C; a study takes minutes."""
    pytest.importorskip("filterpy")
    found = command(quick=True, part=["steps", "trajectories", "c_code"]).data
    rows = found["rows"]
    assert not found["failed"]
    assert len(rows) >= 9
    assert all(row["ours_seconds"] > 0 for row in rows)
    assert {"FilterPy", "FilterPy's UKF", "FilterPy's KF"} < {row["peer"] for row in rows}
    assert any(row["peer"] in ("JAX", "JAX is not installed") for row in rows)


@pytest.mark.parametrize("process_noise_cov", [[1.0, 4e-4], [[1.0, 0.01], [0.01, 4e-4]]])
def test_the_filter_written_for_jax_is_ours_given_our_random_numbers(process_noise_cov):
    size, key, arguments = 64, (7, 11), {"process_noise_cov": process_noise_cov}
    plant = make_plant(**arguments)
    peer, ours = (
        array_filter(plant, np),
        EnsembleKalmanFilter(model=thruster_model(**arguments), ensemble_size=size),
    )

    def normals(step, of_states):
        states, measurement = np.zeros(2 * size), np.zeros(size)
        fill_normals(states, len(states), step, of_states, *key)
        fill_normals(measurement, size, step, FILTER_MEASUREMENT, *key)
        return np.concatenate([states, measurement]).reshape(NORMALS, size)

    with interpreted():
        belief, _ = ours.update(ours.init(key), [3.0])
        members = peer.start(normals(0, FILTER_PRIOR), 3.0)
        for step in range(1, 6):
            voltage, z = 20.0 - 8.0 * step, 15.0 * step
            belief, _ = ours.update(ours.predict(belief, [voltage]), [z])
            members = peer.step(members, voltage, normals(step, FILTER_PROCESS), z)
        mean, cov = peer.moments(members)
    np.testing.assert_allclose(mean, belief.mean, rtol=1e-9)
    np.testing.assert_allclose(cov, belief.cov, rtol=1e-9)


@pytest.mark.parametrize(
    ("row", "shown"),
    [
        (
            Row("a", "b", Timing(1234.5, 4938.0, 0.25), ratio_goal=1 / 3),
            ["a; b", "1234 s", "4938 s", "0.25", "0.33", "yes"],
        ),
        (
            Row("a", "b", Timing(0.5, 0.1, 5.0), time_goal=0.6),
            ["a; b", "500 ms", "100 ms", "5", "600 ms", "yes"],
        ),
        (Row("a", "b is not installed", Timing(0.5, None, None)), ["a; b is not installed", "500 ms", *"----"]),
    ],
)
def test_a_row_says_whether_its_goal_is_met(row, shown):
    assert row.cells() == shown


FACTS = {
    **{"cpu": "a processor", "cores": 2, "system": "Linux", "architecture": "znver9", "avx512": True},
    **{"python": "3.11.7", "numba": "0.68.1"},
}
MACHINE = "Machine: a processor, 2 cores, Linux; znver9 with AVX-512. Python 3.11.7, numba 0.68.1."


def test_each_machine_has_its_table_on_the_page_on_speed(tmp_path):
    page = tmp_path / "speed.md"
    page.write_text((Path(__file__).parents[2] / "docs" / "speed.md").read_text())
    before = page.read_text()
    check_page(page)
    rows = [
        Row("a step", "b", Timing(1e-6, 4e-6, 0.25), ratio_goal=1 / 3),
        Row("c", None, Timing(2e-9, None, None)),
    ]
    write_page(page, rows, FACTS, ["Memory: 8 bytes."])
    first = page.read_text()
    write_page(page, rows[1:], FACTS, [])
    second = page.read_text()
    a, b, c = (
        "## On a processor, 2 cores",
        f"| a step | b | 1{NO_BREAK}us | 4{NO_BREAK}us | 0.25 | 0.33 | yes |",
        f"| c | | 2{NO_BREAK}ns | | | | |",
    )
    header = "| " + " | ".join(HEADER) + " |"
    assert header in before and {a, header, b, c, f"{MACHINE} Memory: 8 bytes."} <= {*first.splitlines()}
    assert first.index(c) < first.index("## What is compared with what")
    assert {*before.splitlines()} < {*first.splitlines()}
    assert second == first.replace(f"{b}\n", "").replace(f"{MACHINE} Memory: 8 bytes.", MACHINE)


def test_a_page_without_a_place_for_the_table_is_refused(tmp_path):
    (tmp_path / "other.md").write_text("# Other")
    for name, rule in (("other.md", "with <!-- table speed: PROCESSOR"), ("none.md", "that can be read")):
        with pytest.raises(ValueError, match=rule):
            check_page(tmp_path / name)


def test_rough_times_are_not_written_into_a_page(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.__main__.importlib.util.find_spec", lambda name: True)
    monkeypatch.setattr("benchmarks.__main__.check_installed", lambda: None)
    monkeypatch.setattr("benchmarks.__main__.rows_of", lambda name: pytest.fail("about to measure"))
    page = tmp_path / "speed.md"
    page.write_text((Path(__file__).parents[2] / "docs" / "speed.md").read_text())
    with pytest.raises(
        ValueError, match="--quick must go without --page, for its times are rough, but got --page"
    ):
        command(quick=True, page=page)
