"""`benchmarks.gpu` on the processor: its rows agree with `filters.run`, and its table has every row."""

import json

import numpy as np
import pytest

import benchmarks.gpu as gpu
from benchmarks.gpu import Case, cases, data_of, prepared, timed
from thruster_env.core.compiled import interpreted

torch = pytest.importorskip("torch")


@pytest.mark.parametrize("kind", ["kf", "ekf"])
def test_log_likelihoods_of_tensors_are_those_of_run(kind):
    row = timed(prepared(Case(kind, "eager", 32, 0, False, False, "cpu")), 0.0, 1)
    assert row["deviation"] < 1e-12 and row["steps_per_second"] > 0
    single = prepared(Case(kind, "eager", 32, 0, True, True, "cpu"))
    assert 0 < single.row["deviation"] < 1e-4


def test_an_ensemble_has_almost_the_log_likelihood_of_the_ukf():
    with interpreted():
        assert prepared(Case("enkf", "eager", 16, 100, False, False, "cpu")).row["deviation"] < 0.1


def test_a_peer_that_is_missing_is_said_to_be(monkeypatch):
    monkeypatch.setattr(gpu, "find_spec", lambda name: None)
    row = timed(prepared(Case("kf", "torch-kf", 32, 0, False, False, "cpu")))
    assert row["skipped"] == "torch-kf is not installed"


def test_a_program_that_fails_states_the_reason(monkeypatch):
    def fails(case):
        raise RuntimeError("RESOURCE_EXHAUSTED: 1 TiB")

    monkeypatch.setitem(gpu.PROGRAMS, "eager", fails)
    assert prepared(Case("kf", "eager", 32, 0, False, False, "cpu")).row["skipped"] == "out of memory"


def test_a_batch_repeats_the_trajectories():
    inputs, z = data_of("kf").batch(20)
    np.testing.assert_array_equal(z[16:], z[:4])
    assert inputs.shape == (20, 10, 1) and z.shape == (20, 11, 2)


def test_the_table_has_a_column_for_each_program(tmp_path, capsys):
    rows = [
        {**case._asdict(), "steps": 10, "steps_per_second": 2e6, "deviation": 1e-9}
        for case in cases("cuda", False)
    ]
    rows[0] = {**rows[0], "lower_bound": True}
    del rows[1]["steps_per_second"]
    rows[1]["skipped"] = "out of memory"
    path = tmp_path / "gpu.json"
    path.write_text(
        json.dumps({"machine": {"card": "a card", "cores": 2, "python": "3", "torch": "2"}, "rows": rows})
    )
    gpu.main(["--table", str(path)])
    page = capsys.readouterr().out
    assert "| filter | batch | machine code | eager | compiled | dynamax | torch-kf | cuthbert |" in page
    assert "| KF, 4 states | 1,000,000 | 2 | ≥ 2 / 2 | - / 2 | 2 / 2 | 2 / 2 | |" in page
    assert "| N = 1,000 | 1 | 2 | 2 / 2 | | |" in page and "- out of memory: kf compiled of 1,000,000" in page
