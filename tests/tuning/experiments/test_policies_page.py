"""The pages on policies say what the code does, and their numbers say what their text says."""

import re
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")

from tuning.experiments.policies import NOISES, TASK
from tuning.experiments.policies_report import HEADER
from tuning.policies.saved import classical_policy, score
from tuning.policies.setup import make_configuration
from tuning.problems.data import held_out_seeds
from tuning.thruster.scenario import find_scenario

DOCS = Path(__file__).parents[3] / "docs"
PAGE = "\n".join((DOCS / name).read_text() for name in ("policies.md", "appendix/policies.md"))
TABLES = {
    noise: PAGE.partition(f"<!-- table policies_{noise} -->")[2].partition("<!-- end -->")[0] for noise in NOISES
}


def rows_at(noise):
    """Cells by the column's name, of each policy."""
    lines = [[cell.strip() for cell in line.strip("| ").split("|")] for line in TABLES[noise].splitlines() if line]
    assert lines[0] == HEADER[: len(lines[0])]
    return {line[0]: dict(zip(lines[0], line, strict=True)) for line in lines[2:]}


def returned(row):
    return float(row["return"].split(" ± ")[0])


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
