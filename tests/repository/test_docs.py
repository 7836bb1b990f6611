"""docs/plant.md and docs/filters.md say what the code does: examples, tables and pictures are the code's."""

import ast
import dataclasses
import importlib
import importlib.util
import inspect
import re
import shutil
import sys
from pathlib import Path

import gymnasium as gym
import pytest

import thruster_env  # noqa: F401 - registers the envs
from docs.scripts import filter_pictures, made_by
from docs.scripts import main as make_page
from filters.gaussian import extended
from filters.registry import FILTERS
from filters.wrappers.arguments import OBSERVATIONS
from thruster_env.effects.sensors import SENSOR_EFFECTS
from thruster_env.thruster.effects import AMPLIFIER_EFFECTS, DISTRIBUTIONS, FLOW_SIGNALS, REFERENCE_SIGNALS
from thruster_env.thruster.env import BowThrusterEnv, BowThrusterVectorEnv

ROOT = Path(__file__).parents[2]


def with_appendix(page, folder=ROOT / "docs"):
    """A page of the docs and the page of measurements behind it, if it has one."""
    paths = folder / f"{page}.md", folder / "appendix" / f"{page}.md"
    return "\n".join(path.read_text() for path in paths if path.exists())


PAGE = with_appendix("plant")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
NUMBER = r"(\d+(?:\.\d+)?(?:e-?\d+)?)"
FILTER_PAGE = with_appendix("filters")
TUNING_PAGE = with_appendix("tuning")
PAGES = {"plant": PAGE, "filters": FILTER_PAGE, "tuning": TUNING_PAGE}
FILTER_EXAMPLES = re.findall(r"```python\n(.*?)```", FILTER_PAGE, flags=re.DOTALL)
WRITTEN = [path for path in sorted((ROOT / "docs").rglob("*.md")) if "tutorials" not in path.parts]
WRITTEN.append(ROOT / "README.md")
FENCED = re.compile(r"^```.*?^```", flags=re.DOTALL | re.MULTILINE)
every_page = pytest.mark.parametrize("page", PAGES)
KINDS = {
    "Reference signals": REFERENCE_SIGNALS.effects,
    "Sensors": SENSOR_EFFECTS.effects,
    "Flow": FLOW_SIGNALS.effects,
    "Amplifier": AMPLIFIER_EFFECTS.effects,
    "Initial state and uncertain parameters": DISTRIBUTIONS,
}
EFFECTS = [(section, name) for section, effects in KINDS.items() for name in effects]


def pictures_of(page):
    return set(re.findall(r"!\[.*?\]\((?:\.\./)?(.*?)\)", PAGES[page]))


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


def test_the_page_has_every_argument_with_its_default():
    told = rows_of("Arguments")
    known = inspect.signature(BowThrusterEnv).parameters
    assert set(told) == set(known)
    for name, parameter in known.items():
        assert ast.literal_eval(told[name][0].strip("`")) == parameter.default


def anchors_of(path):
    """The anchors of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", WRITTEN, ids=lambda path: path.name)
def test_every_link_leads_somewhere(page):
    for target in re.findall(r"\]\((?!http)([^)\s]+)\)", FENCED.sub("", page.read_text())):
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists() or "tutorials" in name, target
        assert not anchor or path.suffix != ".md" or anchor in anchors_of(path), target


@every_page
def test_the_page_shows_what_its_script_draws_and_has_the_tables_it_makes(page):
    assert set(made_by(page, "FIGURES")) <= pictures_of(page)
    assert set(made_by(page, "TABLES")) == set(re.findall(r"<!-- table (\w+) -->", PAGES[page]))
    assert all((ROOT / "docs" / name).stat().st_size < 150_000 for name in made_by(page, "FIGURES"))


@pytest.mark.slow
@pytest.mark.parametrize("code", FILTER_EXAMPLES, ids=range(len(FILTER_EXAMPLES)))
def test_an_example_of_a_filter_runs(code, capsys, tmp_path, monkeypatch):
    """As a module of its own: what compiles is kept under the name of its module."""
    path = tmp_path / "filters_example.py"
    path.write_text(code)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, path.stem, module)
    spec.loader.exec_module(module)
    names = vars(module)
    if "Pendulum" in code:
        assert sum(line != "" for line in code.splitlines()) < 30
        assert names["angle"] < 0.5 * names["raw_angle"] and names["speed"] < 0.5 * names["raw_speed"]


def test_the_table_of_all_filters_is_that_of_the_code():
    from docs.scripts.filters import kinds

    table = kinds()
    assert table in FILTER_PAGE
    assert [line.split("`")[1] for line in table.splitlines()[2:]] == list(FILTERS)
    assert all(f"`{kind.__name__}`" in table for kind in FILTERS.values())


def test_the_list_of_which_filter_for_what_names_filters_that_there_are():
    from filters.learned.filters import LEARNED

    lines = re.findall(r"^\d+\. .*$", (ROOT / "docs" / "ranking.md").read_text(), flags=re.MULTILINE)
    named = {name for line in lines for name in re.findall(r"`([^`]+)`", line)}
    assert len(lines) == 14 and named <= {*FILTERS, *LEARNED} and len(named) > 20


def test_the_table_of_info_is_that_of_the_wrapper():
    env = gym.make("filters:BowThruster-EKF-v0")
    _, with_filter = env.reset(seed=0)
    _, without = env.unwrapped.reset(seed=0)
    told = re.findall(r"^\| `(\w+)` \|", FILTER_PAGE.partition("| `info` |")[2], flags=re.MULTILINE)
    assert set(told) == set(with_filter) - set(without)
    assert all(f'| `"{form}"` |' in FILTER_PAGE for form in OBSERVATIONS)


@pytest.mark.slow
@pytest.mark.parametrize("page", ["plant", "filters"])
def test_pictures_and_tables_are_those_of_the_code(page, tmp_path, monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setattr(filter_pictures, "RUNS", 4)
    (tmp_path / "appendix").mkdir()
    for name in (f"{page}.md", f"appendix/{page}.md"):
        shutil.copy(ROOT / "docs" / name, tmp_path / name)
    make_page([page, "--out", str(tmp_path)])
    anew, here = (re.split(NUMBER, with_appendix(page, folder)) for folder in (tmp_path, ROOT / "docs"))
    assert anew[::2] == here[::2]
    assert [float(n) for n in here[1::2]] == pytest.approx([float(n) for n in anew[1::2]], rel=0.03)
    assert {path.name for path in tmp_path.glob("*.png")} == set(made_by(page, "FIGURES"))
    assert all(path.stat().st_size < 150_000 for path in tmp_path.glob("*.png"))


def test_what_readme_says_of_tuning_is_what_the_page_on_tuning_says():
    readme = (ROOT / "README.md").read_text()
    page = (ROOT / "docs" / "appendix" / "tuning.md").read_text().partition("<!-- table earned -->")[2]
    rows = [[cell.strip("` ") for cell in line.split("|")[1:-1]] for line in page.splitlines()[3:15]]
    ekf = {rows[i - 1][0]: row for i, row in enumerate(rows) if row[1] == "ekf"}  # the row above has the scenario
    ratios = [cell.split()[0] for cell in ekf["outliers"][2:5]]
    gains = [f"{100 * (1 - float(ratio)):.0f} %" for ratio in ratios]
    assert re.findall(r"^- (\d+ %) below that of the \*\*", readme, flags=re.MULTILINE) == gains
    assert f"(NEES) is {float(ekf['outliers'][6]):.3g}, where 2 is right" in readme
    assert f"scaled default is {100 * (1 - float(ekf['mismatch'][2].split()[0])):.0f} %" in readme


def test_the_page_on_design_has_the_update_of_the_ekf_as_it_is():
    lines = [line for line in inspect.getsource(extended.update).splitlines() if '"""' not in line]
    assert "\n".join(f"   {line}" for line in lines) in (ROOT / "docs" / "design.md").read_text()
