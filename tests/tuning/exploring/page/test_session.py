"""What a tab asks and is told, without a browser: the document, its numbers, and wrong questions."""

import base64
import json
import math
import queue
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("bokeh")

from bokeh.document import Document

from tests.linear_problem import LinearProblem
from tuning.exploring.bench import Bench
from tuning.exploring.page.pictures import DARK, HELD, as_sent, corners, drawn_steps, extremes
from tuning.exploring.page.session import Server, Session, _plain, page_of
from tuning.exploring.view import present

SEEDS = 3
WITHIN = 1.959963984540054


class Tab:
    """A session whose other threads' calls wait until somebody asks for them."""

    def __init__(self, bench, monkeypatch):
        self.calls = queue.Queue()
        monkeypatch.setattr(Session, "_later", lambda _, call: self.calls.put(call))
        self.session = Session(Document(), bench, SEEDS)
        self.number = 0

    def ask(self, what, **more):
        self.number += 1
        self.session.wire.asked = json.dumps({"do": what, "number": self.number, **more})
        return self.told()

    def told(self):
        return json.loads(self.session.wire.told)

    def wait_for(self, key):
        """Whatever is told until a key is in it."""
        while True:
            self.calls.get(timeout=60)()
            if key in self.told():
                return self.told()[key]


@pytest.fixture(scope="module")
def bench():
    return Bench(LinearProblem(n=2, m=1), "kf")


@pytest.fixture
def tab(bench, monkeypatch):
    return Tab(bench, monkeypatch)


def test_a_tab_begins_with_every_knob_and_the_figures(tab, bench):
    told = tab.ask("hello", width=600, dark=True)
    assert told["answers"] == 1
    assert [knob["name"] for knob in told["spec"]["knobs"]] == [one.name for one in bench.knobs]
    assert told["values"] == pytest.approx(bench.start) and "NIS" in told["figures"]
    assert tab.session.pictures.nis.figure.yaxis[0].major_label_text_color == DARK.axis


def test_pictures_show_the_numbers_of_the_view(tab, bench):
    tab.ask("hello")
    q = bench.knobs[0].name
    told = tab.ask("view", values={q: bench.start[q] * 3.0})
    view = bench.view(bench.start | {q: bench.start[q] * 3.0}, SEEDS)
    shown = tab.session.pictures.states[1].columns
    np.testing.assert_allclose(shown["line"], view.estimate[0, :, 1], rtol=1e-6)
    np.testing.assert_allclose(shown["truth"], view.truth[0, :, 1], rtol=1e-6)
    np.testing.assert_allclose(shown["high"] - shown["low"], 2 * WITHIN * view.deviation[0, :, 1], rtol=1e-4)
    innovation = tab.session.pictures.innovations[0].columns
    np.testing.assert_allclose(innovation["line"], view.innovation[0, :, 0], rtol=1e-6)
    np.testing.assert_allclose(innovation["high"], WITHIN * view.innovation_deviation[0, :, 0], rtol=1e-6)
    scored = np.isfinite(view.nees).any(axis=0)
    nees = tab.session.pictures.nees[0].columns["line"]
    np.testing.assert_allclose(nees[scored], np.nanmean(view.nees[:, scored], axis=0), rtol=1e-6)
    for name, one in view.figures.items():
        assert told["figures"][name]["value"] == pytest.approx(one.value, nan_ok=True)
        assert told["figures"][name]["start"] == pytest.approx(bench.view(bench.start, SEEDS).figures[name].value)


def test_what_is_drawn_is_sent_in_one_array(tab):
    drawn = tab.ask("hello")["drawn"]
    sent, nis = np.frombuffer(base64.b64decode(drawn["numbers"]), "<f4"), tab.session.pictures.nis
    first, last = drawn["columns"]["nis lines"]["line"]
    np.testing.assert_array_equal(sent[first:last], as_sent(present(nis.columns["time"], nis.columns["line"])[1]))
    band = [sent[slice(*drawn["columns"]["nis band"][name])] for name in ("time", "high")]
    there = np.isfinite(nis.columns["high"])
    np.testing.assert_allclose(np.interp(nis.columns["time"][there], *band), nis.columns["high"][there], rtol=1e-6)
    assert set(drawn["axes"]["nis"]) == {"x", "y"}
    parts = [part for columns in drawn["columns"].values() for part in columns.values()]
    assert sum(last - first for first, last in parts) == len(sent)
    assert "nis" not in tab.ask("view", values={})["drawn"]["axes"]


def test_errors_of_all_runs_are_estimate_minus_truth(tab, bench):
    tab.ask("hello")
    tab.ask("plotted", states=[0], run=1, errors=True)
    view = tab.session.view
    signal = tab.session.pictures.states[0]
    np.testing.assert_allclose(signal.columns["line"], view.estimate[1, :, 0] - view.truth[1, :, 0], rtol=1e-4)
    assert len(signal.runs) == SEEDS - 1
    np.testing.assert_allclose(signal.runs[1], view.estimate[2, :, 0] - view.truth[2, :, 0], rtol=1e-4)
    assert not tab.session.pictures.states[1].figure.visible


def test_what_is_no_value_is_said_and_nothing_changes(tab, bench):
    tab.ask("hello")
    before = dict(tab.session.values)
    for value in (math.nan, math.inf, -1.0, "many", None, [1.0]):
        told = tab.ask("view", values={bench.knobs[0].name: value})
        assert told["error"] and told["answers"] == tab.number and tab.session.values == before
        assert "error" not in tab.ask("view", values={})


def test_a_wrong_question_is_answered_and_the_tab_lives_on(tab):
    tab.ask("hello")
    for question in (
        {"do": "__class__"},
        {"do": "nothing"},
        {"do": "filter", "filter": "no"},
        {"do": "map", "x": "no", "y": "Q11"},
        {"do": "map", "x": "Q11", "y": "Q11"},
        {"do": "study", "trials": 0},
        {"do": "study", "trials": "many"},
        {"do": "drop", "slot": 7},
        {"do": "export"},
        {"do": "plotted", "states": ["a"], "run": 0, "errors": False},
        {"do": "view", "values": {"os": 1}},
        {},
    ):
        tab.number += 1
        tab.session.wire.asked = json.dumps({"number": tab.number, **question})
        told = tab.told()
        assert told["answers"] == tab.number and ("error" in told or question["do"] == "drop"), question
        assert "figures" in tab.ask("view", values={})


def test_text_that_is_no_question_is_answered(tab):
    for text in ("", "[]", "7", '{"do": "view"', "nul"):
        tab.session.wire.asked = text + " "
        assert tab.told()["error"]


def test_four_configurations_are_held_in_colours_and_dropped(tab, bench):
    tab.ask("hello")
    assert [tab.ask("hold")["held"]["colour"] for _ in HELD] == list(HELD)
    assert "at most 4" in tab.ask("hold")["error"]
    held = tab.session.pictures.states[0]
    np.testing.assert_allclose(held.held[3].data["line"], tab.session.view.estimate[0, :, 0], rtol=1e-6)
    assert held._others[2].visible
    tab.ask("drop", slot=2)
    assert not held._others[2].visible and tab.ask("hold")["held"]["slot"] == 2


def test_a_map_is_drawn_with_its_rows_upwards_and_a_click_takes_values(tab, bench):
    tab.ask("hello")
    x, y = bench.knobs[0], next(knob for knob in bench.knobs if knob.group == "R")
    tab.session._mapped(bench.map(bench.start, x.name, y.name, size=3, seeds=2))
    found, data = tab.session.map.map, tab.session.map.image.data
    np.testing.assert_allclose(data["image"][0], found.score, rtol=1e-6)
    step = (np.log10(x.high) - np.log10(x.low)) / 2
    assert data["x"][0] == pytest.approx(np.log10(x.low) - step / 2) and data["dw"][0] == pytest.approx(3 * step)

    at = SimpleNamespace(x=np.log10(x.low) - 5.0, y=0.5 * np.log10(y.low * y.high))
    tab.session.map._click(at)
    assert tab.told()["values"][x.name] == x.low
    assert tab.told()["values"][y.name] == pytest.approx(np.sqrt(y.low * y.high))
    assert tab.session.map.here["y"] == [pytest.approx(at.y)]


def test_a_study_tells_its_trials_and_stops(tab):
    tab.ask("hello")
    tab.ask("study", trials=500)
    first = tab.wait_for("study")
    assert first["trial"] == 1 and first["trials"] == 500 and not first["done"]
    assert set(first["best"]["values"]) <= set(tab.session.values)
    tab.ask("stop")
    while not tab.wait_for("study")["done"]:
        pass
    assert len(tab.session.trials) < 500


@pytest.mark.parametrize("kind, begins", [("python", "from filters"), ("command", "thruster"), ("svg", "<?xml")])
def test_what_is_seen_is_exported(tab, kind, begins):
    tab.ask("hello")
    tab.ask("export", kind=kind)
    assert tab.wait_for("file")["text"].startswith(begins)


def test_numbers_that_json_has_not_become_nothing():
    numbers = _plain({"a": [math.nan, math.inf, 1, True, None, "x", np.float64(0.5)]})
    assert numbers == {"a": [None, None, 1, True, None, "x", 0.5]}


def test_names_of_a_problem_are_text_on_the_page():
    problem = LinearProblem(n=2, m=1)
    problem.name = "</title><script>alert(1)</script>"
    server = Server(page_of(Bench(problem, "kf"), SEEDS), ends_when_left=False).start()
    with urllib.request.urlopen(server.url, timeout=60) as answer:
        text = answer.read().decode()
    server.stop()
    assert "<script>alert" not in text and "&lt;script&gt;alert" in text and 'lang="en"' in text


def test_a_short_run_is_drawn_whole_and_a_long_one_from_its_first_step_to_its_last():
    assert drawn_steps(5, 5).tolist() == [0, 1, 2, 3, 4]
    values = np.array([1.0, np.nan, 3.0])
    assert extremes(values, drawn_steps(3, 10)) is values
    at = drawn_steps(1001, 101)
    assert at[0] == 0 and at[-1] == 1000 and set(np.diff(at)) == {10}


def test_a_stretch_shows_what_is_farthest_from_the_mean_and_a_level_one_its_ends():
    values = np.zeros(100)
    values[37], values[62] = 9.0, -4.0
    values[80:90] = np.nan
    at = np.arange(0, 100, 10)
    found = extremes(values, at)
    expected = np.zeros(10)
    expected[3], expected[6], expected[8] = 9.0, -4.0, np.nan
    np.testing.assert_array_equal(found, expected)
    low = np.array([np.nan, np.nan, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 2.0])
    high = np.array([np.nan, np.nan, 5.0, 5.0, 5.0, 5.0, 5.0, 6.0, 6.0])
    assert corners(low, high).tolist() == [0, 1, 2, 4, 5, 6, 7, 8]
    assert corners(np.ones(5)).tolist() == [0, 4] and corners(np.ones(1)).tolist() == [0]
