"""The report of a tuning: one page that needs nothing else, and its tables."""

import logging
import sys
from html.parser import HTMLParser

import numpy as np
import optuna
import pytest

from filters.consistency.nees import Interval
from tuning.api.report import report as write_report
from tuning.cli.main import main
from tuning.evaluation.held_out import Comparison, evaluate_held_out
from tuning.evaluation.tuned import write_tuned
from tuning.plants.thruster import find_scenario
from tuning.reporting.page import Code, Picture, Section, Table, Words, html_page, markdown_page
from tuning.reporting.search_figures import FEWEST_TRIALS, counted_trials, early_trials, importances
from tuning.reporting.sections import advice
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.storage import open_storage
from tuning.search.study import open_study, run_study

MISMATCH, OUTLIERS = find_scenario("mismatch"), find_scenario("outliers")
VOID = {"meta", "img", "br", "link", "input", "hr"}
STORAGE = "j.journal"


class Page(HTMLParser):
    """Reads a page, and refuses one whose elements do not close."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.attributes, self.headings, self.styles = [], [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.attributes.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "style":
            self.styles.append(data)
        if self.open and self.open[-1] not in ("style", "title", "script"):
            self.words.append(data)
            if self.open[-1] == "h2":
                self.headings.append(data)

    def pictures(self):
        return [found for tag, found in self.attributes if tag == "svg"]


def tuned(plan, trials, name="s", seeds=6):
    """A small study in a journal, and its tuned file, s.json."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    result = run_study(open_study(name, plan, open_storage(STORAGE)), plan, trials)
    comparisons = [evaluate_held_out(result.choice, scenario, plan.seed, seeds) for scenario in plan.scenarios]
    write_tuned(f"{name}.json", plan, result, comparisons, name)
    return result


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_the_page_of_a_tuned_ensemble_has_all_parts_and_needs_no_network(folder):
    result = tuned(Plan("enkf", (MISMATCH,)), 14)
    report = write_report("s.json", storage=STORAGE)
    assert (report.page.as_posix(), report.markdown.as_posix()) == ("s.html", "s.md")
    text = report.page.read_text()
    page = Page(text)
    assert page.headings == [
        "Before and after, on held-out seeds",
        "What the score is",
        "What the data determine",
        "Model, Q and R",
        "The study",
        "Error against ensemble size",
        "One run over time",
        "Measured signal",
        "Innovations",
        "Gain over time",
        "Is the covariance consistent?",
        "Lines to copy",
        "What was done",
    ]
    links = [found["href"] for tag, found in page.attributes if tag == "a"]
    ids = [found["id"] for _, found in page.attributes if "id" in found]
    assert len(links) == len(page.headings) and {link[1:] for link in links} <= set(ids)
    assert len(ids) == len(set(ids))
    assert "http" not in text and not {"img", "link", "iframe"} & {tag for tag, _ in page.attributes}
    assert (
        "src=" not in text and "@media print" in page.styles[0] and "prefers-color-scheme: dark" in page.styles[0]
    )
    assert len(page.pictures()) == 10 and len(text) < 2_000_000
    for picture in page.pictures():
        assert picture["aria-label"].endswith(".") and any(letter.isdigit() for letter in picture["aria-label"])
    assert "var(--c-" in text and "--c-b5541c:#b5541c;" in page.styles[0]
    words = " ".join(page.words)
    assert report.advice in words and f"take N = {result.choice.numbers['ensemble_size']};" in report.advice
    assert " lowers the score by " in report.advice and "(mean NEES " in report.advice
    assert "held-out seeds 500000 to 500005" in words and "14, " in words
    assert str(folder) not in text
    tables = report.markdown.read_text()
    assert report.advice in tables.replace("\\", "") and all(
        f"| {name} | " in tables for name in ("rule of thumb", "scaled default", "oracle")
    )
    assert "upper end of its 95 % interval" in words and "250000 to 250099" in text
    assert write_report("s.json", "again", storage=STORAGE).page.read_text() == text


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_without_its_study_a_tuned_file_still_has_a_page():
    plan = Plan("ekf", (MISMATCH,))
    tuned(plan, 2)
    open_study("s", plan._replace(seed=1), open_storage("other.journal"))  # of the same name
    for storage in ("nowhere.journal", "other.journal", STORAGE):
        page = Page(write_report("s.json", "out", storage=storage).page.read_text())
        said = "Study 's' is not in the storage" in " ".join(page.words)
        assert said == (storage != STORAGE)
        assert "Error against ensemble size" not in page.headings


def test_importances_need_enough_trials_and_sum_to_one():
    plan = Plan("ekf", (MISMATCH,), prune=False)
    study = open_study("s", plan, optuna.storages.InMemoryStorage())
    run_study(study, plan, FEWEST_TRIALS - 1)
    assert importances(study) == {}
    run_study(study, plan, FEWEST_TRIALS + 2)
    found = importances(study)
    assert set(found) == {"Q11", "Q22", "R"} and sum(found.values()) == pytest.approx(1.0)


def test_importances_count_pruned_trials_where_few_are_complete(caplog, monkeypatch):
    plan = Plan("ekf", (MISMATCH,))
    study = open_study("s", plan, optuna.storages.InMemoryStorage())
    result = run_study(study, plan, 12)
    complete = len(result.trials) - result.pruned
    assert counted_trials(study) == (complete, result.pruned) and complete < FEWEST_TRIALS and result.pruned
    monkeypatch.setattr(logging.getLogger("optuna"), "propagate", True)
    optuna.logging.set_verbosity(optuna.logging.INFO)
    caplog.clear()
    assert sum(importances(study).values()) == pytest.approx(1.0)
    assert caplog.text == "", "a copy of a study is nobody's study"


def test_trials_that_ended_early_stand_at_the_mean_of_their_seeds():
    plan = Plan("ekf", (MISMATCH,))
    result = run_study(open_study("s", plan, optuna.storages.InMemoryStorage()), plan, 20)
    early = early_trials(result.trials)
    assert len(early) == result.pruned > 0
    trial, value = early[0]
    assert value == pytest.approx(np.mean(list(trial.intermediate_values.values())))


def test_the_advice_says_when_tuning_is_worth_nothing_or_harms():
    choice = untuned_choice("ekf", MISMATCH)
    comparison = evaluate_held_out(choice, MISMATCH, 0, 4)
    plan = Plan("ekf", (MISMATCH,))
    assert advice(choice, plan, [comparison]).startswith(
        "Tuning raises the score by 10 % [4, 21] against the scaled default, makes no significant difference "
        "on 4 seeds against the rule of thumb and raises the score by 17 % [11, 26] against the noise estimation; "
        "the covariance is "
    )
    worse = comparison.untuned._replace(mean_squares=4 * comparison.untuned.mean_squares)
    said = advice(choice, plan, [comparison._replace(tuned=worse)])
    assert (
        "against the scaled default, by 100 % against the rule of thumb and by 133 % [122, 151] against " in said
    )
    blank = comparison.tuned._replace(nees=Interval(np.nan, np.nan, np.nan), state_nees=None)
    said = advice(choice, plan, [Comparison(blank, blank, blank, comparison.bound, range(4))])
    assert said.startswith(
        "Tuning makes no significant difference on 4 seeds against the rule of thumb. The residuals"
    )


def test_what_is_said_is_escaped():
    table = Table("a < b", ["<script>", "b"], [["x & y", 'say "1"']])
    text = html_page(
        "<t>",
        "a & b",
        [Section("<h>", [table, Words(["<i>"]), Code("<t>", "<u>"), Picture("<svg></svg>", "<s>", '"><b>')])],
    )
    page = Page(text)
    assert {tag for tag, _ in page.attributes} & {"i", "b", "t", "h", "s", "u"} == set()
    assert "x & y" in page.words and 'say "1"' in page.words and page.pictures()[0]["aria-label"] == '"><b>'
    markdown = markdown_page("a_b", ["1 < 2", Table("c|d", ["", "e"], [["f|g", "h*"]])])
    assert markdown == "# a\\_b\n\n1 \\< 2\n\n**c\\|d**\n\n|  | e |\n| --- | ---: |\n| f\\|g | h\\* |\n"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("none",), "a report must be of a tuned file or of a study in out/studies.journal, but got 'none'"),
        (("none.json",), "a tuned file must be readable, but none.json is not"),
        (("text.txt",), "a tuned file must be whole JSON, but text.txt is not"),
        (("none", "--storage", "text.txt"), "storage must be a journal file"),
        (("empty", "--storage", STORAGE), "a study must have a complete trial for a report, but 'empty' has none"),
        (("foreign", "--storage", STORAGE), "a report needs the plan of the study, but study 'foreign' has None"),
    ],
)
def test_a_mistake_is_one_clear_line(arguments, line, folder, monkeypatch, capsys):
    (folder / "text.txt").write_text("hello\n")
    open_study("empty", Plan("ekf", (MISMATCH,)), open_storage(STORAGE))
    optuna.create_study(study_name="foreign", storage=open_storage(STORAGE))
    before = {path.name for path in folder.iterdir()}
    monkeypatch.setattr(sys, "argv", ["thruster", "report", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2 and line in capsys.readouterr().err
    assert {path.name for path in folder.iterdir()} == before
