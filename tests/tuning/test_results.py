"""A result shows its tables everywhere, and a command has the options of its function."""

import json
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import tuning
from thruster_env.core.text_tables import Table
from tuning.api.markers import INPUT, RUNS, Option
from tuning.api.result import Result, plain_data
from tuning.cli.verbs import command_of


@dataclass(frozen=True)
class Tank(Result):
    """Levels of a tank."""

    levels: tuple[float, ...]

    def tables(self):
        rows = [[f"{number}", f"{level:.2f} ±0.01"] for number, level in enumerate(self.levels)]
        return [Table("Levels", ["run", "level\n[m^2]"], rows, "The tank | is full."), "Nothing leaks."]

    def as_dict(self):
        return {"levels": self.levels}


def tank(level: Annotated[float, Option(INPUT)] = 1.0, repeats: Annotated[int, Option(RUNS, least=1)] = 2) -> Tank:
    """Measure a tank several times.

    Args:
        level: of the water [m].
        repeats: number of measurements.
    """
    return Tank((level,) * repeats)


@pytest.fixture
def command(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    app = typer.Typer()
    app.command()(command_of(tank))
    return lambda *arguments: CliRunner().invoke(app, arguments)


def test_a_result_and_the_json_of_its_command_are_the_same_data(tmp_path):
    file, written = tmp_path / "acc.csv", tmp_path / "fit.json"
    file.write_text("\n".join(["acc", *(f"{(7 * k) % 11}" for k in range(60))]))
    app = typer.Typer()
    app.command()(command_of(tuning.fit))
    CliRunner().invoke(app, [str(file), "--json", str(written)])
    stored = json.loads(written.read_text())
    del stored["text_tables"]
    assert json.loads(json.dumps(tuning.fit(file).as_dict(), allow_nan=False)) == stored
    mixed = {1: (np.nan, np.inf), "x": np.array([[0.5, np.nan]])}
    assert plain_data(mixed) == {"1": [None, None], "x": [[0.5, None]]}


def test_a_table_is_shown_by_terminal_notebook_page_and_markdown(tmp_path):
    result = tank(0.5)
    page = result.report(tmp_path / "tank.html")
    forms = str(result), result._repr_html_(), page.read_text(), page.with_suffix(".md").read_text()
    for text in forms:
        assert all(word in text for word in ("Levels", "run", "0.50", "±0.01", "is full.", "Nothing leaks."))
    assert forms[3] == result.to_markdown() and "The tank \\| is full." in forms[3] and "m²" in forms[2]
    with pytest.raises(ValueError, match=r"a page \(--report\) must end in .html, but got 'tank.pdf'"):
        result.report("tank.pdf")


def test_an_argument_is_an_option_and_json_has_the_tables(command):
    said = command("--help").stdout
    assert "--repeats" in said and "Number of measurements." in said and "x>=1" in said and "--report" not in said
    data = json.loads(command("--repeats", "3", "--json", "-").stdout)
    assert data["levels"] == [1.0] * 3
    (table,) = data["text_tables"]
    assert table["title"] == "Levels" and table["rows"][2] == ["2", "1.00 ±0.01"]
    assert "Nothing leaks." in command().stdout
