"""docs/policies.md says what the code does, and its numbers say what its text says."""

import re
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")

from thruster_cli.study import app
from training.arms import ARMS
from training.classical import classical_policy
from training.comparison.plan import FOR_LQR, FOR_PI, LEARNT, NOISES, TASK, VARIANTS
from training.comparison.tables import GOAL, HEADER
from training.score import score
from training.setup import make_setup
from training.tasks import TASKS
from tuning.scenarios import find_scenario, held_out_seeds

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "policies.md").read_text()
TABLES = {
    noise: PAGE.partition(f"<!-- table policies_{noise} -->")[2].partition("<!-- end -->")[0] for noise in NOISES
}
ANSWERS = " ".join(PAGE.partition("<!-- table answers -->")[2].partition("<!-- end -->")[0].split())


def rows_at(noise):
    """Cells by the column's name, of each policy."""
    lines = [[cell.strip() for cell in line.strip("| ").split("|")] for line in TABLES[noise].splitlines() if line]
    assert lines[0] == HEADER
    return {line[0]: dict(zip(HEADER, line, strict=True)) for line in lines[2:]}


def returned(row):
    return float(row["return"].split(" ± ")[0])


@pytest.mark.parametrize("noise", NOISES)
def test_the_tables_have_every_policy(noise):
    learnt = {f"PPO: {arm}" for arm in LEARNT}
    if noise == "medium":
        learnt |= {f"PPO: {arm}, {variant}" for arm, variant in VARIANTS}
    lqg = {f"LQG: {arm}" for arm in FOR_LQR if arm != "true"} | {"LQR: true"}
    assert set(rows_at(noise)) == learnt | {f"PI: {arm}" for arm in FOR_PI} | lqg


def test_the_page_tells_every_arm_and_the_task():
    assert all(f"`{arm}`" in PAGE for arm in ARMS)
    (reference,) = TASKS[TASK].arguments["reference"]
    assert f"between {reference['low']} and {reference['high']}" in PAGE and reference["hold_time"] == 0.5
    assert all(f"`{name}`" in PAGE for name in NOISES.values())


def test_every_link_leads_somewhere():
    targets = re.findall(r"\]\((?!http)([^)]+)\)", PAGE)
    assert len(targets) >= 2 and all((DOCS / target).stat().st_size < 150_000 for target in targets)


def test_the_command_that_makes_the_page_is_there():
    assert "thruster study policies --page docs/policies.md" in PAGE
    assert [command.name for command in app.registered_commands] == ["policies"]


def test_filtered_state_closes_the_gap_and_noise_costs():
    for noise in NOISES:
        rows = rows_at(noise)
        assert returned(rows["PPO: raw"]) < returned(rows["PPO: raw+action"]) < returned(rows["PPO: true"])
        for arm in ("ekf", "enkf", "belief"):
            assert int(rows[f"PPO: {arm}"]["gap closed"].split()[0]) >= 100 * GOAL
            assert float(rows[f"PPO: {arm}"]["observed"]) < float(rows["PPO: raw"]["observed"])
        for arm in ("ekf", "enkf"):
            assert float(rows[f"PPO: {arm}"]["reversal"]) < 0.5 * float(rows[f"PI: {arm}"]["reversal"])
    ekf = [returned(rows_at(noise)["PPO: ekf"]) for noise in ("low", "medium", "high")]
    assert ekf == sorted(ekf, reverse=True)
    assert "the tuned EKF returns +" in ANSWERS and ": better." in ANSWERS and "is reached" in ANSWERS


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind", "arm"), [("LQG: ekf", "lqr", "ekf"), ("PI: raw", "pi", "raw")])
def test_classical_rows_are_those_of_the_code(name, kind, arm):
    setup = make_setup(TASK, find_scenario("medium_noise"), arm)
    found = score(classical_policy(kind, setup), setup, held_out_seeds(0, 200))
    row = rows_at("medium")[name]
    assert returned(row) == pytest.approx(found.returns.mean(), abs=6e-4)
    for part in ("transient", "steady", "reversal", "observed"):
        assert float(row[part]) == pytest.approx(getattr(found, part).rms, abs=6e-3)


def test_the_example_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    names = {}
    exec(compile(code, "docs/policies.md", "exec"), names)
    assert names["model"].num_timesteps == 4096
