"""docs/plant.md says what the code does: its examples run, its tables are the code's, its pictures are there."""

import ast
import dataclasses
import inspect
import re
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest

import thruster_env  # noqa: F401 - registers the envs
from thruster_env.amplifier import AMPLIFIER_EFFECTS
from thruster_env.env import BowThrusterEnv
from thruster_env.flow import FLOW_SIGNALS
from thruster_env.parameters import PRESETS
from thruster_env.reference import REFERENCE_SIGNALS
from thruster_env.sensors import CHANNELS, SENSOR_EFFECTS
from thruster_env.tasks import BowThrusterLinearEnv
from thruster_env.uncertainty import DISTRIBUTIONS
from thruster_env.vector_env import BowThrusterVectorEnv

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "plant.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
NUMBER = r"(\d+(?:\.\d+)?(?:e-?\d+)?)"
PICTURES = re.findall(r"!\[.*?\]\((.*?)\)", PAGE)
KINDS = {
    "Reference signals": REFERENCE_SIGNALS.effects,
    "Sensors": SENSOR_EFFECTS.effects,
    "Flow": FLOW_SIGNALS.effects,
    "Amplifier": AMPLIFIER_EFFECTS.effects,
    "Initial state and uncertain parameters": DISTRIBUTIONS,
}
EFFECTS = [(section, name) for section, effects in KINDS.items() for name in effects]


def rows_of(section):
    """Cells of the table rows of a section by their first cell, which stands in backticks."""
    text = re.split(r"^##+ ", PAGE.partition(f"# {section}\n")[2], maxsplit=1, flags=re.MULTILINE)[0]
    rows = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in text.splitlines() if "|" in line]
    return {cells[0].strip("`"): cells[1:] for cells in rows if cells[0].startswith("`")}


def state_after_a_step(env):
    env.reset(seed=5)
    return env.step([6.0])[4]["state"].tolist()


@pytest.mark.parametrize("code", EXAMPLES, ids=range(len(EXAMPLES)))
def test_an_example_runs_and_json_holds_its_arguments(code, capsys):
    if "render_mode" in code:
        pytest.importorskip("pygame")
    names = {}
    exec(compile(code, "docs/plant.md", "exec"), names)
    if "env" in names:
        again = gym.make(gym.envs.registration.EnvSpec.from_json(names["env"].spec.to_json()))
        assert state_after_a_step(again) == state_after_a_step(names["env"])
    else:
        assert isinstance(names["envs"], BowThrusterVectorEnv)


def test_every_section_on_what_can_be_chosen_has_an_example():
    for section in (*KINDS, "Presets", "Linear plants", "In number", "Rendering", "Baselines", "The environments"):
        text = PAGE.partition(f"# {section}\n")[2]
        assert "gym.make" in text.partition("```python")[2].partition("```")[0], section


@pytest.mark.parametrize(("section", "name"), EFFECTS)
def test_the_page_has_every_effect_with_its_arguments_and_defaults(section, name):
    told = dict(re.findall(r"`(\w+)`(?: = `([^`]+)`)?", rows_of(section)[name][-1]))
    fields = dataclasses.fields(KINDS[section][name])
    assert list(told) == [field.name for field in fields]
    for field in fields:
        if field.default is dataclasses.MISSING:
            assert told[field.name] == ""
        else:
            assert ast.literal_eval(told[field.name]) == field.default


def test_the_page_has_no_effect_that_is_not_there():
    for section, known in KINDS.items():
        assert set(rows_of(section)) - set(CHANNELS) == set(known)


def test_the_page_has_every_argument_with_its_default():
    told = rows_of("Arguments")
    known = inspect.signature(BowThrusterEnv).parameters
    assert set(told) == set(known)
    for name, parameter in known.items():
        assert ast.literal_eval(told[name][0].strip("`")) == parameter.default


def test_the_page_names_the_arguments_of_the_other_envs():
    for cls in (BowThrusterLinearEnv, BowThrusterVectorEnv):
        assert all(f"`{name}`" in PAGE for name in inspect.signature(cls).parameters if name != "arguments")


def test_the_page_has_every_channel_with_unit_and_variance():
    rows = rows_of("Sensors")
    assert {name: (rows[name][1], float(rows[name][2])) for name in CHANNELS} == CHANNELS


def test_the_page_names_every_env_and_every_preset():
    ids = [name for name in gym.registry if re.fullmatch(r"BowThruster\w*-v0", name)]
    assert len(ids) >= 4
    assert all(f"| `{name}` |" in PAGE for name in (*ids, *rows_of("The environments")))
    assert all(f"`{name}`" in PAGE for name in PRESETS)


def test_every_link_leads_somewhere():
    headings = re.findall(r"^#+ (.*)$", PAGE, flags=re.MULTILINE)
    anchors = {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}
    for target in re.findall(r"\]\((?!http)([^)]+)\)", PAGE):
        assert target[1:] in anchors if target.startswith("#") else (ROOT / "docs" / target).exists(), target


@pytest.mark.slow
def test_pictures_and_tables_are_those_of_the_code(tmp_path):
    pytest.importorskip("pygame")
    shutil.copy(ROOT / "docs" / "plant.md", tmp_path)
    subprocess.run([sys.executable, "-m", "docs.plant_figures", str(tmp_path)], cwd=ROOT, check=True)
    anew, here = (re.split(NUMBER, page) for page in ((tmp_path / "plant.md").read_text(), PAGE))
    assert anew[::2] == here[::2]
    assert [float(n) for n in here[1::2]] == pytest.approx([float(n) for n in anew[1::2]], rel=0.03)
    assert {path.name for path in tmp_path.glob("*.png")} == set(PICTURES)
    assert all(path.stat().st_size < 150_000 for path in tmp_path.glob("*.png"))
