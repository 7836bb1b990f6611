"""Progress in a notebook: one output that is drawn anew, with ipywidgets or without."""

import io
import subprocess
import sys
from types import SimpleNamespace

import pytest
from rich.console import Console
from rich.progress import Progress

from tuning.api import progress
from tuning.api.progress import NotebookLine


@pytest.fixture
def outputs(monkeypatch):
    """What a notebook shows: a list of texts for each output, in order."""
    shown = []

    def display(content, raw, display_id):
        assert raw and display_id
        shown.append([content["text/plain"]])
        return SimpleNamespace(update=lambda new, raw: shown[-1].append(new["text/plain"]))

    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=display))
    return shown


def test_the_last_line_stands_in_one_output(outputs):
    line = NotebookLine()
    texts = "\r\x1b[2K\x1b[32mone\x1b[0m 1/3", "\r\x1b[2Kone 1/3", "\x1b[?25l", "\r\x1b[2Kone 2/3\n"
    for text in (*texts, "\r\x1b[1A\x1b[2K"):
        assert line.write(text) == len(text)
    assert outputs == [["one 1/3", "one 2/3", ""]]


def test_a_bar_of_rich_is_drawn_there(outputs):
    console = Console(file=NotebookLine(), force_terminal=True, force_jupyter=False, color_system=None, width=60)
    with Progress(console=console, auto_refresh=False) as bar:
        task = bar.add_task("tuning", total=4)
        for _ in range(4):
            bar.advance(task)
            bar.refresh()
    (texts,) = outputs
    assert [text.split()[0] for text in texts] == ["tuning"] * len(texts) and "100%" in texts[-1]


@pytest.mark.parametrize(
    "terminal, jupyter, asked, quiet",
    [
        (False, False, None, True),
        (True, False, None, False),
        (False, True, None, False),
        (False, False, True, False),
        (True, True, False, True),
    ],
)
def test_who_shows_progress(terminal, jupyter, asked, quiet, monkeypatch):
    def console(**options):
        given = {"file": io.StringIO(), "force_terminal": terminal, "force_jupyter": jupyter} | options
        given.pop("stderr", None)
        return Console(**given)

    monkeypatch.setattr(progress, "Console", console)
    found = progress.console_for(asked)
    assert found.quiet == quiet
    if jupyter and progress.importlib.util.find_spec("ipywidgets") is None:
        assert isinstance(found.file, NotebookLine)


def test_a_notebook_without_widgets_hears_nothing_of_tqdm():
    code = "import tuning, warnings; warnings.warn('IProgress not found. Please update jupyter and ipywidgets.')"
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)
