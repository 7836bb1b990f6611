"""The docs' programs run and their commands are understood; what cannot run stands here with its reason."""

import re
import shlex
import sys
from pathlib import Path

import pytest
import typer

from tuning.cli.app import app

ROOT = Path(__file__).parents[2]
PAGES = {str(path.relative_to(ROOT / "docs")): path.read_text() for path in sorted((ROOT / "docs").rglob("*.md"))}
PAGES["README.md"] = (ROOT / "README.md").read_text()
FENCE = re.compile(r"```(\w*)\n(.*?)```", flags=re.DOTALL)
LINE = re.compile(r"^(?: {4})?thruster ((?:.*\\\n)*.+)$", flags=re.MULTILINE)

ELSEWHERE = {  # pages whose programs another test runs
    "plant.md": "test_docs.py",
    "filters.md": "test_docs.py",
    "machine_code.md": "test_machine_code_page.py",
    "policies.md": "../tuning/experiments/test_policies_page.py",
    "boat.md": "test_boat_page.py",
    **{page: "test_examples.py" for page in PAGES if page.startswith("howto/")},
}
NOT_RUN = {  # programs, by page and what is in them
    ("identify.md", "other_logs"): "a fragment: logs and model are the reader's",
    (
        "identify.md",
        "mine.toml",
    ): "its file comes from a minute's search: tests/tuning/test_identify.py",
    ("ranking.md", "kalman_filter"): "a fragment on FilterPy: tests/filters/test_estimator_libraries.py",
    ("real_data.md", "mine.toml"): "needs what the page's identification writes: tests/tuning/cli",
    ("real_data.md", "import spring"): "the same, of a model of one's own",
    ("benchmarks.md", "experiments"): "needs the tuned files of the page's studies: tests/tuning/experiments",
    ("extending.md", "ScaleError"): "a fragment: the effect is the reader's",
    ("extending.md", "scale_error"): "its test",
    ("extending.md", "fading"): "the same, of a filter that there is: tests/filters",
    ("extending.md", "Tank"): "the same, of a plant: tests/thruster_env",
    ("extending.md", "tank_model"): "the same",
    ("other_packages.md", "UnobservedComponents"): "needs statsmodels: tests/filters/test_estimator_libraries.py",
    ("size.md", "lorenz_96"): "a fragment of a model",
    ("workers.md", "SLURMCluster"): "needs a cluster; executors: tests/thruster_env/core/test_parallel.py",
    ("workers.md", "KubeCluster"): "the same",
    ("design.md", "def update"): "a part of the package: test_docs.py compares it",
    ("policies.md", "VecNormalize"): "needs Stable-Baselines3, as howto/stable_baselines.md does, which runs",
}
QUICK = (
    ("trials=30", "trials=3"),
    ("trials=50", "trials=3"),
    ("runs=200, steps=1000", "runs=24, steps=8"),
    ('.file], "outliers"', '.file], "outliers", seeds=4'),
)  # smaller numbers
SHOWN_ONLY = ("FOLDER", "...", "10.77.5.1")  # in commands: what the reader has to fill in


def programs(page):
    """A page's Python, one text a program."""
    return [code for language, code in FENCE.findall(PAGES[page]) if language in ("python", "py")]


def reason(page, code):
    """Why a program is not run; empty if it is."""
    return next((why for (where, part), why in NOT_RUN.items() if where == page and part in code), "")


LONG, SLOW = (
    {"problems.md", "auv.md", "learned.md", "gallery.md"},
    pytest.mark.slow,
)  # they compile models of their own
OWN = [page for page in PAGES if page not in ELSEWHERE and any(not reason(page, code) for code in programs(page))]


@pytest.mark.parametrize("page", [pytest.param(page, marks=SLOW if page in LONG else ()) for page in OWN])
def test_the_programs_of_a_page_run_one_after_the_other(page, thruster, tmp_path, capsys):
    if page == "logs.md":
        assert thruster("simulate", "--out", "run1.csv", "--steps", 300, "--seed", 1).returncode == 0
    names = {"__name__": "page"}
    for number, code in enumerate(programs(page)):
        for long, short in QUICK:
            code = code.replace(long, short)
        if not reason(page, code):
            file = tmp_path / f"program_{number}.py"
            file.write_text(code)
            exec(compile(code, str(file), "exec"), names)
    assert "nan" not in re.sub(r"\w*nan\w+", "", capsys.readouterr().out)


def test_every_program_is_run_or_has_its_reason():
    for page in PAGES:
        if page in ELSEWHERE:
            source = (Path(__file__).parent / ELSEWHERE[page]).read_text()
            assert Path(page).parent.name + '"' in source or Path(page).name in source, page
    for (page, part), why in NOT_RUN.items():
        assert why and any(part in code for code in programs(page)), (page, part)
    assert {"problems.md", "auv.md", "logs.md"} <= set(OWN)


COMMANDS = [
    pytest.param(line, id=f"{page}: {line[:60]}")
    for page, text in PAGES.items()
    for line in (found.replace("\\\n", " ") for found in LINE.findall(text))
    if not any(part in line for part in SHOWN_ONLY)
]


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_of_a_page_is_understood(line, tmp_path, monkeypatch):
    """Down to the last option and the kind of its value; what it would do is not done."""
    monkeypatch.chdir(tmp_path)
    program, arguments = typer.main.get_command(app), shlex.split(line, comments=True)
    context = program.make_context("thruster", [], resilient_parsing=True)
    name, command, rest = program.resolve_command(context, arguments)
    while hasattr(command, "resolve_command"):
        context = command.make_context(name, [], resilient_parsing=True)
        name, command, rest = command.resolve_command(context, rest)
    assert command.make_context(name, rest).command is command


JOURNEYS = {  # pages whose commands are run as they stand, one after the other, with fewer trials
    "problems.md": (("--trials 50", "--trials 3"),),
    "logs.md": (("--trials 100", "--trials 3"), ("--steps 1000", "--steps 400")),
}


@pytest.mark.slow
@pytest.mark.parametrize("page", JOURNEYS)
def test_the_commands_of_a_page_lead_from_one_to_the_next(page, thruster, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("my_pendulum", None)  # of another folder
    if page == "problems.md":
        (tmp_path / "my_pendulum.py").write_text(programs(page)[0])
    if page == "logs.md":
        for seed in (2, 3, 4):  # "likewise run2, run3, run4"
            assert thruster("simulate", "--out", f"run{seed}.csv", "--steps", 400, "--seed", seed).returncode == 0
    lines = [line for line in LINE.findall(PAGES[page]) if "run.csv" not in line]  # that has columns of its own
    assert len(lines) >= 3
    for line in lines:
        for long, short in JOURNEYS[page]:
            line = line.replace(long, short)
        done = thruster(*shlex.split(line, comments=True))
        assert done.returncode in (0, 3), (line, done.stderr)  # 3: no trial of so few was consistent
    sys.modules.pop("my_pendulum", None)
