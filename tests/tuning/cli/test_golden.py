"""The surface that users meet is a contract: each command's help, output, JSON keys, files and page, frozen.

A change is deliberate: rewrite the files by `python -m tests.tuning.cli.test_golden`, read their difference,
and give it a line in CHANGELOG.md. Numbers have two digits, so that all processors agree; clocks stand still.
"""

import contextlib
import difflib
import io
import json
import os
import re
import shlex
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

from thruster_env.core.text_tables import console
from tuning.cli.app import COMMANDS
from tuning.cli.main import main

GOLDEN = Path(__file__).resolve().with_name("golden")
WIDTH = "100"
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*[a-zA-Z_/(])")
STEPS = {  # in this order, in one folder: what a command writes, the next ones read
    "simulate": ["simulate --out run{}.csv --steps 120 --seed {}".format(*[n] * 2) for n in (1, 2, 3)],
    "fit": ["fit run1.csv --column measured_thrust_N --model constant --code fit.md", "fit run1.csv"],
    "tune": [
        "tune --filter ekf --problem nominal --trials 2 --out tuned.json --study both --seed 1",
        "tune --filter ekf --log run1.csv --log run2.csv --blocks 3 --trials 1 --study logs --out logs.json",
        "tune --filter ekf --problem nominal --method noise-estimation --trials 1 --study alone --out alone.json",
    ],
    "evaluate": [
        "evaluate tuned.json --seeds 6",
        "evaluate --filter ekf --seeds 6 --consistency consistent.png",
        "evaluate tuned.json --filter ekf",
    ],
    "estimate": [
        "estimate run1.csv tuned.json --monitor 1000 --out estimates.csv --plot estimates.svg",
        "estimate run1.csv --filter ekf --smoother",
        "estimate run1.csv --filter ekf --isolate",
    ],
    "identify": [
        "identify run1.csv run2.csv run3.csv --free motor_damping --hold-noise --starts 1 --out mine.toml",
        "identify",
    ],
    "compare": ["compare tuned.json --filter ekf --filter kf --problem nominal --seeds 6", "compare nominal"],
    "report": ["report tuned.json --storage out/studies.journal --out page"],
    "verify": ["verify logs.json"],
    "export": ["export tuned.json --out exported --single"],
    "explore": ["explore tuned.json --filter ekf"],
    "train": ["train --tuned tuned.json --untuned"],
    "train-estimator": ["train-estimator --report page.txt"],
    "score": ["score --preset t200 nowhere"],
}
DRAW = "tuning.reporting.page.figure_svg"  # slow
CLOCK = SimpleNamespace(perf_counter=lambda: 0.0, process_time=lambda: 0.0)
CLOCKS = ("evaluation.compare", "search.study", "search.trials", "methods.task", "likelihood.identify")


def masked(text):
    """A text with two digits a number, single spaces and no lines of tables, which depend on other digits."""
    text = re.sub(r"[─━]+", "--", re.sub(r"[ \t]+", " ", text))
    text = re.sub(r"(0x)?[0-9a-f]{12,}", "DIGEST", text)
    text = re.sub(r" Least determined is [^$]*?\.(?=\n)", "", text)  # whether it stands there depends on digits
    lines = [NUMBER.sub(_rounded, line).strip() for line in text.splitlines()]
    return "\n".join(line for line in lines if line)


def _rounded(match):
    text = match[0]
    return text if text.lstrip("+-").isdigit() and len(text) < 6 else f"{float(text):.2g}"


def keys(file):
    """Keys and types in a JSON file, one line a key of the document."""
    document = shape(json.loads(Path(file).read_text()))
    return [f"{file}: {len(document)} keys", *(f"  {key}: {_compact(part)}" for key, part in document.items())]


def _compact(part):
    return json.dumps(part).replace('"', "")


def shape(value):
    """Keys and types of a part of JSON; of a list those of its first item."""
    if isinstance(value, dict):
        return {key: shape(part) for key, part in value.items()}
    if isinstance(value, list):
        return [shape(value[0])] if value else []
    return "number" if isinstance(value, float | int) and not isinstance(value, bool) else type(value).__name__


def run(line, json_file=None):
    """Exit code and output of a command line; with a file, its JSON goes there."""
    sys.argv = ["thruster", *shlex.split(line), *(["--json", json_file] if json_file else [])]
    said, complained, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(complained):
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
    return code, said.getvalue(), complained.getvalue() if code == 2 else ""


def helps():
    """The help of each command, by file."""
    for name in COMMANDS:
        code, text, _ = run(f"{name} --help")
        assert code == 0
        usage, rest = re.split(r"\n\s*\n", text.lstrip(), maxsplit=1)  # which names the program as it was called
        lines = [" Usage: thruster" + " ".join(usage.split()).partition("thruster")[2], "", *rest.splitlines()]
        yield f"help/{name}.txt", "\n".join(map(str.rstrip, lines)) + "\n"


def outputs(name):
    """What a command's lines print, with the shape of their JSON and of the files that they write."""
    parts = []
    for line in STEPS[name]:
        code, said, complained = run(line, None if name == "explore" else "result.json")
        parts += [f"$ thruster {line}", masked(said + complained), f"exit code {code}"]
        if code == 0:
            parts += keys("result.json")
        out = re.search(r"--out (\S+)", line)
        if out and code == 0 and Path(out[1]).suffix == ".json":
            parts += keys(out[1])
        elif out and code == 0 and out[1] == "page":
            (page,) = Path("page").rglob("*.html")
            parts += map(masked, re.findall(r"<(?:h\d|figure|table|svg)[^>]*>(?:[^<]*</h\d>)?", page.read_text()))
            parts.append(masked(re.sub(r"\|[ -|:]+\|\n", "", page.with_suffix(".md").read_text())))
    return "\n".join(parts) + "\n"


def outcomes(patch):
    """What all commands print and write, by file, in an empty folder."""
    patch.setattr(DRAW, lambda _, name: (f"<svg data-name='{name}'></svg>", ""))
    for module in CLOCKS:
        patch.setattr(import_module(f"tuning.{module}"), "time", CLOCK)
    for name in STEPS:
        yield f"{name}.txt", outputs(name)


def differing(texts):
    """Differences of files whose text is another one, also of files that nothing makes any more."""
    texts = dict(texts)
    folder = (GOLDEN / next(iter(texts))).parent
    stored = {path.relative_to(GOLDEN).as_posix(): path.read_text() for path in folder.glob("*.txt")}
    pairs = {name: (stored.get(name, ""), texts.get(name, "")) for name in sorted(texts.keys() | stored.keys())}
    return [
        "\n".join(difflib.unified_diff(before.splitlines(), after.splitlines(), name, name, n=0, lineterm=""))
        for name, (before, after) in pairs.items()
        if before != after
    ]


@pytest.fixture
def patch(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", WIDTH)
    monkeypatch.setattr(console, "_width", int(WIDTH))  # it may have read another number when it was made
    monkeypatch.setattr(sys, "argv", [])
    return monkeypatch


@pytest.mark.usefixtures("patch")
def test_each_help_is_the_frozen_one():
    assert differing(helps()) == []


@pytest.mark.slow
def test_output_json_files_and_page_are_the_frozen_ones(patch):
    assert differing(outcomes(patch)) == []


if __name__ == "__main__":
    os.environ["COLUMNS"] = WIDTH
    with pytest.MonkeyPatch.context() as of_main, tempfile.TemporaryDirectory() as scratch:
        of_main.setattr(console, "_width", int(WIDTH))
        os.chdir(scratch)
        texts = [] if sys.argv[1:] == ["help"] else outcomes(of_main)  # a run sets sys.argv
        for name, text in (*helps(), *texts):
            (GOLDEN / name).parent.mkdir(parents=True, exist_ok=True)
            (GOLDEN / name).write_text(text)
