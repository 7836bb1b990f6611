"""The pages on policies say what the code does, and their numbers say what their text says."""

import re
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")

from tuning.experiments.policies import BEST, NOISES, TASK, VARIANTS, WRONG, Comparison, runs_of
from tuning.experiments.policies_report import GOAL, HEADER, NOT_ON_PAGE, name_of
from tuning.plants.thruster import find_scenario
from tuning.policies.algorithms import OBSERVATION_SETS
from tuning.policies.saved import classical_policy, score
from tuning.policies.setup import TASKS, make_configuration
from tuning.problems.data import held_out_seeds

DOCS = Path(__file__).parents[3] / "docs"
PAGE = "\n".join((DOCS / name).read_text() for name in ("policies.md", "appendix/policies.md"))
BEGUN = {noise: PAGE.partition(f"<!-- table policies_{noise} -->")[2] for noise in NOISES}
TABLES = {noise: text.partition("<!-- end -->")[0] for noise, text in BEGUN.items()}
ANSWERS = " ".join(PAGE.partition("<!-- table answers -->")[2].partition("<!-- end -->")[0].split())


def rows_at(noise):
    """Cells by the column's name, of each policy."""
    lines = [[cell.strip() for cell in line.strip("| ").split("|")] for line in TABLES[noise].splitlines() if line]
    assert lines[0] == HEADER[: len(lines[0])]
    return {line[0]: dict(zip(lines[0], line, strict=True)) for line in lines[2:]}


def returned(row):
    return float(row["return"].split(" ± ")[0])


@pytest.mark.parametrize("noise", ["low", "high"])
def test_the_tables_have_every_policy(noise):
    planned = runs_of(Comparison(noises=(noise,), seeds=1, variants=False))
    expected = [name_of(run.kind, run.label) for run in planned if run.label not in NOT_ON_PAGE]
    assert list(rows_at(noise)) == expected


def test_the_table_of_medium_noise_has_every_variant_too():
    planned = runs_of(Comparison(noises=("medium",), seeds=1, variants=False))
    expected = {name_of(run.kind, run.label) for run in planned if run.label not in NOT_ON_PAGE}
    expected |= {name_of(kind, f"{arm}, {variant}") for kind in ("ppo", BEST) for arm, variant in VARIANTS}
    expected |= {name_of("ppo+mpc", f"ekf, {variant}") for variant in WRONG}
    expected |= {name_of(BEST, f"true, {variant}") for variant in WRONG if variant != "wrong model"}
    assert set(rows_at("medium")) == expected


def test_the_page_tells_every_arm_and_the_task():
    assert all(f"`{arm}`" in PAGE for arm in OBSERVATION_SETS)
    (reference,) = TASKS[TASK].arguments["reference"]
    assert f"between {reference['low']} and {reference['high']}" in PAGE and reference["hold_time"] == 0.5
    assert all(f"`{name}`" in PAGE for name in NOISES.values())


def test_filtered_state_closes_the_gap_and_noise_costs():
    for noise in NOISES:
        rows = rows_at(noise)
        assert returned(rows["PPO: raw"]) < returned(rows["PPO: raw+action"]) < returned(rows["PPO: true"])
        for arm in ("ekf", "enkf", "belief"):
            assert int(rows[f"PPO: {arm}"]["gap closed"].split()[0]) >= 100 * GOAL
            if noise == "medium":
                assert float(rows[f"PPO: {arm}"]["observed"]) < float(rows["PPO: raw"]["observed"])
    for policy in ("PPO: ekf", "MPC: ekf", "one step: enkf"):
        costs = [-returned(rows_at(noise)[policy]) for noise in ("low", "medium", "high")]
        assert costs == sorted(costs)
    assert "is reached" in ANSWERS


def test_the_nonlinear_controller_is_what_a_policy_is_measured_by():
    for noise in NOISES:
        rows = rows_at(noise)
        assert rows["MPC: true"]["gap closed"] == "100 %" and returned(rows["MPC: true"]) == -0.445
        for arm in ("ekf", "enkf", "true"):
            best = returned(rows[f"MPC: {arm}"])
            assert best == pytest.approx(returned(rows[f"one step: {arm}"]), abs=1.1e-3)
            assert best > 0.3 * returned(rows[f"{'LQR' if arm == 'true' else 'LQG'}: {arm}"])
        # A policy that corrects the controller is within 2 % of it.
        assert returned(rows["PPO + MPC: ekf"]) > 1.02 * returned(rows["MPC: ekf"])
    assert returned(rows_at("medium")["PPO + MPC: true"]) > 1.02 * returned(rows_at("medium")["MPC: true"])


def test_where_the_model_is_wrong_a_policy_that_corrects_it_beats_the_controller():
    rows = rows_at("medium")
    for variant in WRONG:
        assert returned(rows[f"PPO + MPC: ekf, {variant}"]) > returned(rows[f"MPC: ekf, {variant}"])
        assert f"PPO + MPC: ekf, {variant} returns +" in ANSWERS


@pytest.mark.parametrize(
    ("name", "kind", "arm"),
    [
        ("LQG: ekf", "lqr", "ekf"),
        ("PI: raw", "pi", "raw"),
        pytest.param("one step: ekf", "one-step", "ekf", marks=pytest.mark.slow),
        pytest.param("MPC: true", "mpc", "true", marks=pytest.mark.slow),
    ],
)
def test_classical_rows_are_those_of_the_code(name, kind, arm):
    setup = make_configuration(TASK, find_scenario("medium_noise"), arm)
    found = score(classical_policy(kind, setup), setup, held_out_seeds(0, 200))
    row = rows_at("medium")[name]
    assert returned(row) == pytest.approx(found.returns.mean(), abs=6e-4)
    for part in ("transient", "steady", "reversal", "observed"):
        assert float(row[part]) == pytest.approx(found.parts[part].rms, abs=6e-3)


def test_the_example_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    names = {}
    exec(compile(code, "docs/policies.md", "exec"), names)
    assert names["model"].num_timesteps == 4096
