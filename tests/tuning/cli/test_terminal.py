"""How the command line presents itself: version, panels, names, tables at any width, colour, progress."""

import io

import pytest
from rich.console import Console

from docs.scripts import DOCS, PAGES, made_by
from filters.registry import FILTERS
from tests.tuning.cli.test_cli import as_json, thruster  # noqa: F401 - fixtures
from thruster_env.core.text_tables import Table
from tuning.api.tune import file_name
from tuning.cli import output
from tuning.cli.app import COMMANDS
from tuning.experiments import EXPERIMENTS

WITHOUT_JSON = ("explore",)  # what it finds is exported from its page


def test_what_is_random_has_a_seed_and_all_write_json(thruster):  # noqa: F811
    commands = set(COMMANDS) - {"reproduce"}
    without = {name for name in commands if "--seed " not in thruster(name, "--help").stdout}
    rest = {"inspect", "filters", "fit", "new", "methods", "report", "verify", "export", "log", "bollard"}
    assert without == rest
    for name in (*(commands - {*WITHOUT_JSON}), *(f"reproduce {experiment}" for experiment in EXPERIMENTS)):
        assert "--json " in thruster(*name.split(), "--help").stdout


@pytest.mark.parametrize("page", PAGES)
def test_tables_and_pictures_of_scripts_and_experiments_stand_on_their_page(page):
    files = [file for file in (DOCS / f"{page}.md", DOCS / "appendix" / f"{page}.md") if file.exists()]
    text = "\n".join(file.read_text() for file in files) or (DOCS.parent / "README.md").read_text()
    missing = [name for name in made_by(page, "TABLES") if f"<!-- table {name} -->" not in text]
    assert not missing + [name for name in made_by(page, "FIGURES") if f"{name})" not in text]


@pytest.mark.parametrize(
    ("arguments", "end"),
    [
        (
            ("evaluate", "--filter", "EFK"),
            f"and {len(FILTERS) - 4} more (thruster filters lists all), but got 'EFK'; did you mean 'ekf'?",
        ),
        (("compare", "--scenario", "mismach"), "but got 'mismach'; did you mean 'mismatch'?"),
        (("inspect", "--preset", "tunel"), "but got 'tunel'; did you mean 'tunnel'?"),
        (("reproduce", "lorenz36"), "No such command 'lorenz36'. Did you mean 'lorenz96'"),
        (("train", "--scenario", "ambiant"), "but got 'ambiant'; did you mean 'ambient'?"),
        (("tunne",), "Did you mean 'tune'?"),
        (("tune", "--trails", "3"), "--trials"),
        (("evaluate", "--filter", "zzz"), "but got 'zzz'\n"),
        (("evaluate",), "but got none"),
    ],
)
def test_a_misspelt_name_comes_with_the_nearest_one(thruster, arguments, end):  # noqa: F811
    done = thruster(*arguments)
    assert done.returncode == 2 and end in done.stderr and done.stderr.count("\n") == 1


ROWS = [["rule of thumb", "5.887 ±0.069", "0.1229 ±0.0018", "7.0", "0.21"]] * 2
HEADS = ["filter", "omega_m\n[rad/s]", "U_a\n[m/s]", "NEES", "NIS"]


def drawn(made, width, terminal=False, **environment):
    stream = io.StringIO()
    environment = {"TERM": "xterm-256color", **environment}
    Console(file=stream, width=width, force_terminal=terminal or None, _environ=environment).print(made)
    return stream.getvalue()


@pytest.mark.parametrize("width", [40, 60, 80, 140])
def test_a_table_has_the_same_columns_at_any_width(monkeypatch, width):
    monkeypatch.setattr(output.console, "width", width)
    made = Table("a title that is longer than the table", HEADS, ROWS, caption="of nothing")
    said = drawn(made, width)
    assert max(map(len, said.splitlines())) <= width and "…" not in said
    lines = said.splitlines()
    below = lines[next(i for i, line in enumerate(lines) if "──" in line) + 1]
    assert len(below.split()) >= 5 and below.rstrip().endswith("0.21")
    for word in "rule thumb 5.887 ±0.069 0.1229 7.0 omega_m NEES NIS".split():
        assert word in said


def test_a_refused_study_leaves_no_journal(thruster, tmp_path):  # noqa: F811
    for arguments in (("--method", "none"), ("--objective", "none"), ("--filter", "none")):
        assert thruster("tune", "--filter", "ekf", *arguments).returncode == 2
    assert not list(tmp_path.rglob("*.journal"))


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("auv:motion", "auv-motion"),
        ("my folder/mine.toml", "mine"),
        ("nominal (presets/mine.toml)", "nominal-mine"),
        ("nominal (t200)", "nominal-t200"),
        ("run1.csv and 2 more", "run1.csv-and-2-more"),
    ],
)
def test_names_of_files_need_no_quotes(name, file):
    assert file_name(name) == file
