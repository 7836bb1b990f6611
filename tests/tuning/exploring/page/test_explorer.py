"""`tuning.explore` and `thruster explore`: where they begin, what they print, and what they refuse."""

import html
import re
import stat
import urllib.error
import urllib.request
import webbrowser

import pytest

pytest.importorskip("bokeh")

import tuning
from tests.linear_problem import LinearProblem
from tuning.api.explore import _forward
from tuning.exploring.page.session import Server


def test_a_notebook_shows_the_page_in_a_frame_until_it_is_closed():
    bench = tuning.explore(LinearProblem(n=2, m=1), filter="kf", seeds=2)
    shown = bench._repr_html_()
    url = html.unescape(re.search(r'src="([^"]+)"', shown)[1])
    assert url == bench.url and "kf on linear-2" in shown
    with urllib.request.urlopen(url, timeout=60) as answer:
        assert answer.status == 200
    bench.close()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(url, timeout=30)


def test_the_function_is_still_there_when_its_room_was_imported():
    import tuning.exploring.bench  # noqa: F401

    assert tuning.explore is tuning.explore and callable(tuning.explore)


def test_own_numbers_are_where_one_starts():
    problem = LinearProblem(n=2, m=1)
    bench = tuning.explore(problem, problem.model(process_noise_cov=[0.3, 0.4])).bench
    assert bench.filter == "ekf" and bench.start["Q11"] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (dict(problem="outliers", filter="open-loop"), "filter must be one that has a number to change"),
        (dict(problem="outliers", seeds=0), "seeds must be"),
        (dict(problem="tuned.json", filter="ekf"), "give either a tuned file or a filter"),
    ],
    ids=str,
)
def test_what_cannot_be_explored_is_refused(arguments, says):
    with pytest.raises(ValueError, match=says):
        tuning.explore(**arguments)


def test_the_browser_is_led_to_the_page_by_a_file_that_others_cannot_read(tmp_path):
    page = _forward(tmp_path, "http://127.0.0.1:1/token&x/")
    assert stat.S_IMODE(page.stat().st_mode) == 0o600
    assert "url=http://127.0.0.1:1/token&amp;x/" in page.read_text()


@pytest.mark.slow
def test_the_command_prints_the_address_and_opens_no_token_on_a_command_line(monkeypatch, capsys):
    opened, served = [], []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(Server, "run", lambda self: served.append(self.url))
    tuning.explore(LinearProblem(n=2, m=1), "kf", seeds=2).serve()
    (url,) = served
    assert url in capsys.readouterr().out and opened[0].startswith("file://") and url not in opened[0]
