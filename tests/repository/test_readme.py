"""README: its Python runs, its commands are understood, its links lead somewhere, its numbers are the pages'."""

import re
import shlex
from pathlib import Path

import pytest
import typer
from PIL import Image

from tuning.cli.app import app

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
COMMANDS = re.findall(r"^thruster (.+)$|`thruster ([^`]+ --[^`]+)`", README, flags=re.MULTILINE)


def test_readme_is_one_screen_and_says_early_what_it_is_for():
    assert sum(line != "" for line in README.splitlines()) <= 80
    _, second, *_ = re.split(r"(?<=\.)\s", README.partition("\n\n")[2])
    assert "any model" in second and "any log" in second


@pytest.mark.parametrize("code", EXAMPLES, ids=range(len(EXAMPLES)))
def test_readme_code_runs(code, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(code.replace("trials=50", "trials=3"), "README.md", "exec"), {})
    out = capsys.readouterr().out
    assert out and "nan" not in out


@pytest.mark.parametrize("line", sorted(map("".join, COMMANDS)))
def test_a_command_line_of_readme_is_understood(line, tmp_path, monkeypatch):
    """Down to the last option and the kind of its value; what it would do is not done."""
    monkeypatch.chdir(tmp_path)
    program, arguments = typer.main.get_command(app), shlex.split(line, comments=True)
    name, command, rest = program.resolve_command(
        program.make_context("thruster", [], resilient_parsing=True), arguments
    )
    assert command.make_context(name, rest).params


def test_every_picture_and_page_that_readme_names_is_there():
    for target in re.findall(r"\]\((?!http)([^)#]+)", README):
        assert (ROOT / target).exists(), target


def test_the_picture_that_moves_is_small_and_moves():
    path = ROOT / "docs" / "thruster.gif"
    assert path.stat().st_size < 2_000_000
    with Image.open(path) as picture:
        assert picture.n_frames > 50 and picture.size == (640, 400)
        first = picture.convert("RGB").tobytes()
        picture.seek(picture.n_frames // 2)
        assert picture.convert("RGB").tobytes() != first


def test_what_tuning_is_worth_is_what_the_page_on_tuning_says():
    page = (ROOT / "docs" / "appendix" / "tuning.md").read_text().partition("<!-- table earned -->")[2]
    rows = [[cell.strip("` ") for cell in line.split("|")[1:-1]] for line in page.splitlines()[3:15]]
    ekf = {rows[i - 1][0]: row for i, row in enumerate(rows) if row[1] == "ekf"}  # the row above has the scenario
    ratios = [cell.split()[0] for cell in ekf["outliers"][2:5]]
    gains = [f"{100 * (1 - float(ratio)):.0f} %" for ratio in ratios]
    assert re.findall(r"^- (\d+ %) below that of the \*\*", README, flags=re.MULTILINE) == gains
    assert f"(NEES) is {float(ekf['outliers'][6]):.3g}, where 2 is right" in README
    assert f"scaled default is {100 * (1 - float(ekf['mismatch'][2].split()[0])):.0f} %" in README
