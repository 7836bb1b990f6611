"""The environments in docs/auv.md: examples run, and what is listed is all there is."""

import re
from pathlib import Path

import gymnasium as gym
import pytest

import thruster_env.auv  # noqa: F401 - registers the envs
from docs.scripts import made_by
from thruster_env.auv.plant import CURRENT_SIGNALS, SUITES
from tuning.auv.scenario import SCENARIOS

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = "\n".join((DOCS / name).read_text(encoding="utf-8") for name in ("auv.md", "appendix/auv.md"))
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("code", EXAMPLES, ids=range(len(EXAMPLES)))
def test_an_example_runs_and_warns_of_nothing(code, capsys, recwarn):
    names = {}
    exec(compile(code, "docs/auv.md", "exec"), names)
    assert len(names) > 1 and not recwarn.list and capsys.readouterr().err == ""


def test_ids_suites_and_signals_are_named():
    ids = [name for name in gym.registry if re.fullmatch(r"SegorogeniAUV\w*-v0", name)]
    assert len(ids) == 3 and all(f"| `{name}` |" in PAGE for name in ids)
    assert all(f"`{name}`" in PAGE for name in (*SUITES, *CURRENT_SIGNALS.effects))


def test_scenarios_are_listed_with_their_states_and_what_they_are():
    assert all(f"| `{one.name}` | {one.count} | {one.about} |" in PAGE for one in SCENARIOS.values())


def test_the_page_has_what_its_scripts_make():
    assert set(made_by("auv", "FIGURES")) == set(re.findall(r"!\[.*?\]\((?:\.\./)?(.*?)\)", PAGE))
    assert set(made_by("auv", "TABLES")) == set(re.findall(r"<!-- table (\w+) -->", PAGE))
