"""`tuning.tune`, `evaluate` and `report`: the numbers of the commands, as values that show and keep themselves."""

import copy
import html
import json
import pickle
import signal
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import matplotlib.figure
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import tuning
from filters import EstimateState
from filters.c.project import c_filter
from filters.monitoring import Monitor
from tests.filters.checks import refused
from thruster_env.core.text_tables import Table
from tuning.api.markers import INPUT, RUNS, Option
from tuning.api.result import Result, plain_data
from tuning.cli.verbs import command_of
from tuning.problems.find import find_problem
from tuning.reporting.tuning_report import next_steps, report

TRIALS = 5
SHORT = find_problem("nominal").replace(steps=70, name="short")  # quick to tune on
FIGURES = ("plot_history", "plot_errors", "plot_run", "plot_consistency")


@pytest.fixture(scope="module")
def study():
    return tuning.tune("mismatch", trials=TRIALS, progress=False)


def plain(data):
    """Numbers as JSON has them."""
    from tuning.cli.output import as_text

    return json.loads(as_text(data))


def test_tune_is_the_command_in_one_call(study, as_json, tmp_path):
    told = as_json("tune", "--filter", "ekf", "--problem", "mismatch", "--trials", TRIALS, "--out", "theirs.json")
    assert study.save("mine.json").name == "mine.json"
    mine, theirs = (json.loads((tmp_path / name).read_text()) for name in ("mine.json", "theirs.json"))
    assert mine == theirs
    ours = plain(study.document())
    assert {**ours, "file": ""} == {**told, "file": ""} and told["trials"] == TRIALS
    found = as_json("evaluate", "--tuned", "mine.json", "--seeds", 4)
    for source in ("mine.json", study):
        assert plain(tuning.evaluate(source, seeds=4).document()) == found


def test_the_tuned_filter_is_ready_to_use(study, tmp_path):
    assert study.filter.name == study.choice.name == "ekf"
    belief, innovation = study.filter.update(study.filter.init(), [1.0])
    assert np.isfinite(belief.mean).all() and np.isfinite(innovation.cov).all()
    made = c_filter(study.filter, "one", single=True, monitor=Monitor(stuck=5))
    folder = study.export_c(tmp_path / "c", "one", single=True, monitor={"stuck": 5})
    assert (folder / "one.c").read_text() == made.source
    file = study.save(tmp_path / "tuned.json")
    wrapped = EstimateState(study.problem.make_env(), tuned=str(file))
    assert wrapped.filter.name == "ekf"
    np.testing.assert_allclose(wrapped.filter.model.process_noise_cov, study.filter.model.process_noise_cov)
    for same in (EstimateState(study.problem.make_env(), tuned=study), EstimateState(wrapped.env, tuned=file)):
        np.testing.assert_array_equal(same.reset(seed=1)[0], wrapped.reset(seed=1)[0])
    with pytest.raises(ValueError, match="tuned must be the path of a tuned file, or what tuning.tune returns"):
        EstimateState(wrapped.env, tuned={"filter": "ekf"})
    with pytest.raises(ValueError, match="tuned must come without filter: it has its own, but got 'ukf'"):
        EstimateState(wrapped.env, "ukf", tuned=study)
    refused("filter must be a name, .* a study is tuned=study; but got Study", EstimateState, wrapped.env, study)


def test_what_is_printed_are_the_tables_of_the_command_line(study):
    found = study.held_out
    lines = str(found).splitlines()
    printed = report(study)
    assert printed[0].startswith(lines[0])
    assert lines[0].startswith("The study returns trial 4 rescaled for its log score")
    assert any(line.startswith("RMSE on held-out seeds") for line in lines) and "\x1b" not in str(found)
    assert any(line.startswith(" scaled ") or line.startswith(" scaled default") for line in lines)
    assert f"{found.evaluation.rmse[0].value:.3f}" in str(found) and "Score of the tuned filter" in str(found)
    assert "\n" not in repr(found) and "\n" not in repr(study)
    assert str(study).splitlines()[0] == lines[0] and str(study).count(lines[0]) == 1
    assert all(line in str(study) for line in lines) and html.escape(printed[0]) in study._repr_html_()
    named = next_steps(replace(study, file=Path("tuned.json")))
    assert named == ["Tuned filter: tuned.json", "Next: thruster report tuned.json"]
    (unsaved,) = next_steps(replace(study, file=None))
    assert "study.save(FILE)" in unsaved and "None" not in unsaved


def test_baselines_are_filters_that_go_around_an_env(study):
    filters = study.held_out.filters
    assert list(filters) == list(study.held_out.evaluations)
    q = study.held_out.choices["rule of thumb"].model["process_noise_cov"]
    wrapped = EstimateState(study.problem.make_env(), filter=filters["rule of thumb"])
    np.testing.assert_allclose(wrapped.filter.model.process_noise_cov.diagonal(), q)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_study_in_memory_is_that_of_a_storage_and_goes_on_there(tmp_path, capsys):
    storage = tmp_path / "studies.journal"
    options = {"storage": storage, "progress": True}
    short = tuning.tune(SHORT, trials=2, **options)
    whole = tuning.tune(SHORT, trials=TRIALS, **options)
    assert "continues after 2 finished trials" in capsys.readouterr().err
    alone = tuning.tune(SHORT, trials=2, progress=False)
    first = [trial.params for trial in alone.trials]
    assert first == [trial.params for trial in short.trials] == [trial.params for trial in whole.trials[:2]]
    page = tuning.report(whole.name, tmp_path / "page.html", storage=storage, problem=SHORT, progress=False).page
    assert "Study &#x27;" not in page.read_text() and page.with_suffix(".md").is_file()


def test_tables_have_what_is_in_the_values(study):
    trials, errors = study.to_frame(), study.held_out.to_frame()
    assert len(trials) == len(study.trials) and trials.index.tolist() == list(range(1, TRIALS + 1))
    assert trials.loc[1, "R"] == study.trials[0].params["R"]
    assert trials.loc[1, "score"] == study.trials[0].values[0]
    assert errors.index.tolist() == list(study.held_out.evaluations)
    tuned = study.held_out.evaluation
    assert errors.loc["tuned", "score"] == tuned.score.value and errors.loc["tuned", "NEES"] == tuned.nees.value
    assert errors.loc["tuned", "RMSE omega_m [rad/s] high"] == tuned.rmse[0].high


def test_without_pandas_one_line_says_what_to_install(study, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    refused(r"to_frame must have pandas, .* pip install pandas", study.to_frame)


@pytest.mark.parametrize("name", FIGURES)
def test_figures_are_those_of_matplotlib(study, name):
    figure = getattr(study, name)()
    assert isinstance(figure, matplotlib.figure.Figure) and figure.axes
    assert figure._repr_png_().startswith(b"\x89PNG")  # as notebooks show it


def test_copies_and_pickles_are_the_same(study, tmp_path):
    for other in (copy.copy(study), copy.deepcopy(study), pickle.loads(pickle.dumps(study))):
        assert repr(other) == repr(study) and other.choice == study.choice
        assert other.save(tmp_path / "o.json").read_text() == study.save(tmp_path / "s.json").read_text()
    assert repr(pickle.loads(pickle.dumps(study.held_out))) == repr(study.held_out)
    with pytest.raises(AttributeError):
        study.plan = None


def test_ctrl_c_keeps_what_is_finished(monkeypatch):
    from tuning.search import study as module

    run_trial = module.run_trial

    def interrupted(trial, *arguments):
        if trial.number == 2:
            signal.raise_signal(signal.SIGINT)
        return run_trial(trial, *arguments)

    monkeypatch.setattr(module, "run_trial", interrupted)
    found = tuning.tune(SHORT, trials=30, progress=False)
    assert found.interrupted and found.result.finished == 3 and "3 trials, interrupted" in repr(found)
    assert found.filter.name == "ekf" and found.held_out.score.value > 0


WRONG = [
    (lambda: tuning.tune("mismatch", trials=0), "trials must be a whole number of at least 1, but got 0"),
    (
        lambda: tuning.tune("mismatch", method="newton"),
        "method must be one of tpe, gp, .*, grid, gradient, likeli",
    ),
    (lambda: tuning.tune("mismatch", workers=2), "workers must be 1 without a storage that they share, such as"),
    (lambda: tuning.tune("mismatch", progress="yes"), "progress must be True, False or None, but got 'yes'"),
    (lambda: tuning.tune("mismatch", name="a/b"), "study must be a name without slashes, but got 'a/b'"),
    (lambda: tuning.evaluate("none.json"), "none.json"),
    (lambda: tuning.evaluate(3), "a filter must be a name, a tuned file, a Study or an estimator, but got 3"),
    (lambda: tuning.tune("mismatch", len), "filter must be a name or 'module:object', by which trials keep it"),
    (lambda: tuning.report(3), "a report must be of a Study, a tuned file or the name of a study, but got 3"),
    (lambda: tuning.report(["a.json"]), "a report must be of a Study, a tuned file or the name of a study, but"),
    (lambda: tuning.report("a.json", "b.json"), "for it .tuning.compare compares studies., but got out='b.json'"),
    (lambda: tuning.report("no such study"), "a report must be of a tuned file or of a study in"),
    (lambda: tuning.tune(SHORT, trials=1).plot_sizes(), "figure of ensemble sizes needs an ensemble and true"),
    (lambda: tuning.evaluate("ekf", seeds=2).plot_run(2), "run must be at most 1, but got 2"),
]


@pytest.mark.parametrize("call, said", WRONG)
def test_errors_state_the_rule_and_the_value(call, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(said, call)


def test_a_scenario_that_was_changed_has_another_name_in_files(tmp_path):
    changed = find_problem("nominal").replace(steps=120)
    found = tuning.tune(changed, trials=1, progress=False)
    assert found.problem.name == "nominal (changed)" and found.problem.steps == 120
    file = found.save(tmp_path / "t.json")
    assert tuning.evaluate(file, seeds=2, progress=False).problem.steps == 120


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
    refused(r"a page \(--report\) must end in .html, but got 'tank.pdf'", result.report, "tank.pdf")


def test_an_argument_is_an_option_and_json_has_the_tables(command):
    said = command("--help").stdout
    assert "--repeats" in said and "Number of measurements." in said and "x>=1" in said and "--report" not in said
    data = json.loads(command("--repeats", "3", "--json", "-").stdout)
    assert data["levels"] == [1.0] * 3
    (table,) = data["text_tables"]
    assert table["title"] == "Levels" and table["rows"][2] == ["2", "1.00 ±0.01"]
    assert "Nothing leaks." in command().stdout
