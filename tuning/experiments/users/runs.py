"""Tune filters on a panel of problems; what is done is kept in files, and never repeated."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tuning
from filters.consistency.intervals import Interval
from thruster_env.core.files import write_whole
from tuning.api.run import short_name
from tuning.evaluation.baselines import TUNED
from tuning.evaluation.evaluate import Evaluation, score_ratio
from tuning.experiments.users.significance import chance_if_no_worse
from tuning.problems.find import find_problem
from tuning.problems.problem import Problem

PANEL = tuple(
    f"tests.users.{name}:problem"
    for name in (
        "altitude",
        "battery",
        "chain",
        "compartments",
        "geared_motor",
        "heat_exchanger",
        "lateral",
        "lidar",
        "lorenz63",
        "pendulum",
        "range_bearing",
        "reactor",
    )
)
FILTERS = ("ekf", "ukf", "enkf", "ekf-robust")
TRIALS = 50
QUICK_TRIALS = 4


class Panel(NamedTuple):
    """What is tuned on what."""

    problems: tuple[str, ...] = PANEL
    filters: tuple[str, ...] = FILTERS
    trials: int = TRIALS
    seed: int = 0


QUICK = Panel(PANEL[:2], ("ekf",), QUICK_TRIALS)


class Paired(NamedTuple):
    """A tuned filter beside one baseline on the held-out seeds."""

    ratio: Interval  # score of the tuned filter over the baseline's, paired by run
    chance: float  # one-sided p-value of "the tuned filter is no worse"


class Case(NamedTuple):
    """A filter that was tuned on a problem, or the error that it ended in."""

    problem: str
    filter: str
    score: float  # mean over states of RMSE over scale, held out
    nis: float  # mean NIS over the number of channels
    restarts: int
    gave_way: str  # the baseline that the study took in place of its best trial; empty where it took a trial
    baselines: Mapping[str, Paired]
    seconds: float
    error: str = ""


KINDS: dict[str, type] = {  # of a file's entries
    **dict.fromkeys(("problem", "filter", "gave_way", "error"), str),
    **dict.fromkeys(("score", "nis", "seconds"), float),
    "restarts": int,
}
OnCase = Callable[[str, int, int], None]  # what begins, cases that are done, all cases


def found_problems(names: Sequence[str]) -> list[Problem]:
    """The problems of a panel, by "module:object" or by name.

    Raises:
        ValueError: for a problem that is not there, or has no truth to be judged by.
    """
    problems = []
    for name in names:
        try:
            problem = find_problem(name)
        except ValueError as error:
            if name not in PANEL:
                raise
            raise ValueError(
                f"the panel's problems must be found in tests/users of the working folder, a checkout of the "
                f"project (others by --problem), but {error}"
            ) from error
        if problem.scale is None:
            raise ValueError(f"a problem of the panel must have true states, but {name} has none")
        problems.append(problem)
    return problems


def run_panel(panel: Panel, folder: Path, on_case: OnCase = lambda text, done, count: None) -> list[Case]:
    """Tune every filter of a panel on every problem, and compare it with its baselines on held-out seeds.

    A case whose file is in the folder is not done again, unless its problem, trials or seed are others. Ctrl-C
    loses the case that is going on.

    Args:
        panel: what is tuned on what.
        folder: for a file per case.
        on_case: called before each case.

    Raises:
        ValueError: for problems that cannot be found, or a damaged file.
        KeyboardInterrupt: on Ctrl-C.
    """
    problems = found_problems(panel.problems)
    pairs = [(problem, name) for problem in problems for name in panel.filters]
    cases = []
    for done, (problem, name) in enumerate(pairs):
        on_case(f"{name_of(problem)}, {name}", done, len(pairs))
        key = {"problem": problem.digest, "filter": name, "trials": panel.trials, "seed": panel.seed}
        file = folder / f"{name_of(problem)}-{name}-{panel.trials}-seed{panel.seed}.json"
        case = _read(file, key)
        if case is None:
            case = tuned_case(problem, name, panel.trials, panel.seed)
            file.parent.mkdir(parents=True, exist_ok=True)
            write_whole(file, json.dumps({"of": key, **case._asdict()}, indent=1))
        cases.append(case)
    return cases


def tuned_case(problem: Problem, name: str, trials: int, seed: int) -> Case:
    """Tune a filter on a problem, and hold it against its baselines; an error of either is kept in the case."""
    started = time.perf_counter()
    try:
        study = tuning.tune(problem, filter=name, trials=trials, seed=seed, progress=False)
    except ValueError as error:
        nothing = float("nan")
        seconds = time.perf_counter() - started
        return Case(name_of(problem), name, nothing, nothing, 0, "", {}, seconds, str(error))
    if study.interrupted:
        raise KeyboardInterrupt
    validation = getattr(study.tuning.result, "validation", None)
    gave_way = validation.chosen if validation is not None and validation.gave_way else ""
    seconds = time.perf_counter() - started
    return compared(name_of(problem), name, study.held_out.comparison.evaluations, seconds, gave_way)


def compared(
    problem: str, name: str, evaluations: Mapping[str, Evaluation], seconds: float, gave_way: str = ""
) -> Case:
    """A case from the evaluations of the tuned filter and its baselines on the same held-out seeds."""
    tuned = evaluations[TUNED]
    paired = {
        label: Paired(score_ratio(tuned, other), chance_if_no_worse(tuned, other))
        for label, other in evaluations.items()
        if label != TUNED
    }
    nis = tuned.nis.value / tuned.expected_nis
    return Case(problem, name, tuned.score.value, nis, tuned.divergences, gave_way, paired, seconds)


def name_of(problem: Problem) -> str:
    """A problem's name in tables and files: "geared_motor" of "tests.users.geared_motor:problem"."""
    module, _, what = problem.name.partition(":")
    return module.rpartition(".")[2] if what == "problem" else short_name(problem)


def _read(file: Path, key: Mapping) -> Case | None:
    """The case of a file; None unless there is one of the same problem, filter, trials and seed."""
    if not file.is_file():
        return None
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if content.pop("of") != key:
            return None
        paired = {
            name: Paired(Interval(*map(float, ratio)), float(chance))
            for name, (ratio, chance) in content.pop("baselines").items()
        }
        entries: dict[str, Any] = {name: KINDS[name](value) for name, value in content.items()}
        return Case(baselines=paired, **entries)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file} must be a whole file of results, but cannot be read: {error}") from None
