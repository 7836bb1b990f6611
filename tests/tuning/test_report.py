"""The report of a tuning: one page that needs nothing else, its tables, pictures and units."""

import json
import logging
import re
from html import unescape
from html.parser import HTMLParser
from math import nan

import numpy as np
import optuna
import pytest

from filters.consistency.nees import Interval, span
from thruster_env.core.files import BLUE, MOST_POINTS, RUST, panels, thinned
from thruster_env.core.text_tables import typeset
from tuning.api.report import report as write_report
from tuning.evaluation.held_out import Comparison, evaluate_held_out
from tuning.evaluation.tuned import write_tuned
from tuning.plants.thruster import find_scenario
from tuning.reporting.page import Code, Picture, Section, Table, Words, figure_svg, html_page, markdown_page
from tuning.reporting.search_figures import FEWEST_TRIALS, counted_trials, early_trials, importances
from tuning.reporting.sections import advice
from tuning.reporting.tables import about, limit_cell, unless_blank
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
    assert "src=" not in text and "@media print" in page.styles[0]
    assert "prefers-color-scheme: dark" in page.styles[0]
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
    assert report.advice in tables.replace("\\", "")
    assert all(f"| {name} | " in tables for name in ("rule of thumb", "scaled default", "oracle"))
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
        "Tuning makes no significant difference on 4 seeds against the scaled default, against the rule of thumb "
        "and raises the score by 17 % [6, 34] against the noise estimation; the covariance is "
    )
    worse = comparison.untuned._replace(mean_squares=4 * comparison.untuned.mean_squares)
    said = advice(choice, plan, [comparison._replace(tuned=worse)])
    assert "scaled default, by 100 % against the rule of thumb and by 133 % [112, 168] against " in said
    blank = comparison.tuned._replace(nees=Interval(np.nan, np.nan, np.nan), state_nees=None)
    said = advice(choice, plan, [Comparison(blank, blank, blank, comparison.bound, range(4))])
    begins = "Tuning makes no significant difference on 4 seeds against the rule of thumb. The residuals"
    assert said.startswith(begins)


def test_what_is_said_is_escaped():
    table = Table("a < b", ["<script>", "b"], [["x & y", 'say "1"']])
    parts = [table, Words(["<i>"]), Code("<t>", "<u>"), Picture("<svg></svg>", "<s>", '"><b>')]
    text = html_page("<t>", "a & b", [Section("<h>", parts)])
    page = Page(text)
    assert {tag for tag, _ in page.attributes} & {"i", "b", "t", "h", "s", "u"} == set()
    assert "x & y" in page.words and 'say "1"' in page.words and page.pictures()[0]["aria-label"] == '"><b>'
    markdown = markdown_page("a_b", ["1 < 2", Table("c|d", ["", "e"], [["f|g", "h*"]])])
    assert markdown == "# a\\_b\n\n1 \\< 2\n\n**c\\|d**\n\n|  | e |\n| --- | ---: |\n| f\\|g | h\\* |\n"


@pytest.mark.parametrize(
    ("study", "line"),
    [
        ("empty", "a study must have a complete trial for a report, but 'empty' has none"),
        ("foreign", "a report needs the plan of the study, but study 'foreign' has None"),
    ],
)
def test_a_study_that_has_no_report_is_one_clear_line(study, line, folder, thruster):
    open_study("empty", Plan("ekf", (MISMATCH,)), open_storage(STORAGE))
    optuna.create_study(study_name="foreign", storage=open_storage(STORAGE))
    before = {path.name for path in folder.iterdir()}
    done = thruster("report", study, "--storage", STORAGE)
    assert done.returncode == 2 and line in done.stderr
    assert {path.name for path in folder.iterdir()} == before


@pytest.fixture(scope="module")
def drawn():
    figure, (left, right) = panels(2, 2, (3.0, 2.0))
    x = np.linspace(0.0, 5.0, 40)
    left.plot(x, 2.0 * x - 3.0, color=BLUE, label="a line")
    left.plot([0.0, 5.0], [1.0, 1.0], color=RUST, label="two points")
    left.set(xlabel="time [s]", ylabel="speed $\\omega_m$ [rad/s]", xlim=(0.0, 5.0), ylim=(-4.0, 8.0))
    right.plot(x, np.exp(x))
    right.set(yscale="log", ylabel="$U_a$ [m/s]")
    return figure_svg(figure, "q7")


def test_text_is_text_and_colours_are_those_of_the_page(drawn):
    svg, _ = drawn
    assert ">time [s]</text>" in svg and "<metadata" not in svg and "http" not in svg
    assert not re.search(r"#[0-9a-fA-F]{6}\b", svg) and "var(--c-0b6fa4)" in svg and "var(--c-b5541c)" in svg
    ids = re.findall(r'\bid="([^"]*)"', svg)
    assert all(one.startswith("q7-") for one in ids) and len(ids) == len(set(ids))
    known = {(one, "") for one in ids} | {("", one) for one in ids}
    assert set(re.findall(r'href="#([^"]*)"|url\(#([^)]*)\)', svg)) <= known


def test_values_are_read_off_where_they_are_drawn(drawn):
    svg, readings = drawn
    left, right = json.loads(unescape(readings))
    assert [label for _, label in left["lines"]] == ["a line"] and left["label"] == "time [s]"
    assert right["log"] == [False, True] and right["lines"][0][1] == "U_a [m/s]"
    group = svg[svg.index(f'id="{left["lines"][0][0]}"') :]
    path = re.search(r' d="([^"]*)"', group)[1]
    points = np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", path), float)
    (x0, top, x1, bottom), (low, high) = left["box"], left["y"]
    times = left["x"][0] + (points[:, 0] - x0) / (x1 - x0) * np.diff(left["x"])
    values = low + (bottom - points[:, 1]) / (bottom - top) * (high - low)
    np.testing.assert_allclose([times[0], times[-1]], [0.0, 5.0], atol=0.01)
    np.testing.assert_allclose(values, 2.0 * times - 3.0, atol=0.05)


def test_a_thinned_line_keeps_its_extremes_and_its_ends():
    x = np.arange(20_000.0)
    y = np.sin(x / 700)
    y[[4321, 17_000]] = 9.0, -9.0
    y[5000:5040] = np.nan
    times, values = thinned(x, y)
    assert len(times) <= MOST_POINTS and (np.diff(times) > 0).all()
    assert np.nanmax(values) == 9.0 and np.nanmin(values) == -9.0 and times[np.nanargmax(values)] == 4321
    _, above = thinned(x, y, np.fmax)
    assert np.nanmax(above) == 9.0 and len(above) == MOST_POINTS // 2
    short = x[:100], y[:100]
    assert all(np.array_equal(one, other) for one, other in zip(thinned(*short), short, strict=True))


@pytest.mark.parametrize(
    ("unit", "page"), [("m^3/s", "m³/s"), ("(m/s)^2", "(m/s)²"), ("1/s", "1/s"), ("s^-1", "s⁻¹"), ("m", "m")]
)
def test_units_are_typeset_in_words_and_tables(unit, page):
    assert typeset(unit) == page
    assert page in Words([f"It is 1 {unit}."]).html()
    assert page in Table("", ["", f"q [{unit}]"], [["a", "1"]]).html()


def test_numbers_that_round_to_zero_have_no_minus_and_small_errors_powers_of_ten():
    values = (-0.3, "+.0f"), (-0.004, ".2f"), (-1.2, "+.0f"), (nan, "")
    cells = [unless_blank(value, form) for value, form in values]
    assert cells == ["0", "0.00", "-1", ""]
    value = Interval(8.59e-6, 8.37e-6, 8.81e-6)
    assert about(value, 8) == "8.59e-06 ±2e-07" and limit_cell(7.5e-6, 8) == "7.50e-06"
    assert about(value._replace(value=0.1, low=0.09, high=0.11), 4) == "0.1000 ±0.0100"
    assert about(value._replace(value=float("nan")), 8) == limit_cell(float("nan"), 8) == ""


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ((26.0, 25.0, 27.0), "26 % [25, 27]"),
        ((26.0, 25.86, 26.14), "26.0 % [25.9, 26.1]"),
        ((26.0, 25.99, 26.01), "26.00 % [25.99, 26.01]"),
        ((26.0, 26.0, 26.0), "26 %"),
        ((26.0, 26.0 - 1e-6, 26.0 + 1e-6), "26 %"),
        ((0.0, -0.2, 0.6), "0 % [0, 1]"),
    ],
)
def test_the_ends_of_an_interval_differ_or_are_left_out(value, said):
    assert span(Interval(*value), 0, " %") == said
