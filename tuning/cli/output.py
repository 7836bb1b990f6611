"""Shared output of commands: tables on the terminal, JSON for programs.

Ctrl-C while results are printed: they become whole first. Tables of choices and their results, shared by
several commands. How commands name built-in and other problems.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from signal import SIGINT, getsignal, raise_signal, signal
from threading import current_thread, main_thread

import numpy as np
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from thruster_env.core.compiled import tell_when_compiling
from thruster_env.core.files import check_not_read, check_target, write_whole
from thruster_env.core.progress import listening
from thruster_env.core.text_tables import console, table
from thruster_env.logs.recorders.registry import ENDINGS
from thruster_env.logs.table import SUFFIXES
from thruster_env.logs.write import check_not_among, check_suffix
from thruster_env.thruster.plant import largest_known_voltage
from tuning.cli.main import leave
from tuning.cli.options import JsonOption, SeedOption  # noqa: F401 - for `demo`
from tuning.likelihood.gradient import GradientResult
from tuning.problems.find import built_in
from tuning.problems.problem import Problem
from tuning.reporting.units import number_rows
from tuning.search.among_types import TypeResult
from tuning.search.objectives import LIKELIHOOD, PROPER, reported, reported_name
from tuning.search.parameters import index_pairs
from tuning.search.plan import Plan
from tuning.search.space import Choice


@contextmanager
def printed_whole() -> Iterator[None]:
    """Within this context the first Ctrl-C waits for its end; the next one ends the process, as on a blocked pipe.

    Outside the main thread, where Python delivers no signals, this has no effect.
    """
    if current_thread() is not main_thread():
        yield
        return
    caught: list[int] = []

    def note(number, frame):
        caught.append(number)
        signal(SIGINT, leave)

    before = getsignal(SIGINT)
    signal(SIGINT, note)
    try:
        yield
    finally:
        signal(SIGINT, before)
        if caught:
            raise_signal(SIGINT)


PICTURES = (".png", ".svg", ".pdf")  # which figures are written as
progress_console = Console(stderr=True, markup=False, highlight=False)


def emit(parts: Sequence[RenderableType], data: dict, json_target: str | None) -> None:
    """Print tables and lines, unless JSON goes to standard output; write JSON where asked."""
    if json_target == "-":
        with printed_whole():
            sys.stdout.write(as_text(data))
            sys.stdout.flush()
        return
    _check_json(json_target)
    if json_target is not None:  # first: there may be nobody left who reads what is printed
        write_whole(json_target, as_text(data))
    with printed_whole():
        for part in parts:
            console.print(part)


def _check_json(target: str | None) -> None:
    """Raise ValueError for a path that would be a log, or the description of one."""
    if target is not None and Path(target).suffix in (*SUFFIXES, *ENDINGS, ".toml"):
        raise ValueError(f"--json must be no log, nor what is said of one, but got {target!r}")


def check_picture(path: Path, option: str) -> None:
    """Raise ValueError unless the name of a figure's file ends in one of PICTURES."""
    check_suffix(path, option, PICTURES)


def check_targets(targets: Iterable[str | Path | None], json_target: str | None, read: Iterable = ()) -> None:
    """Raise ValueError unless all files can be written, before long work, and none of those read is among them.

    Args:
        targets: paths to be written, None for those not requested.
        json_target: of `--json`.
        read: paths to be read, None for those not given.
    """
    named = [path for path in (*targets, None if json_target == "-" else json_target) if path is not None]
    inputs = [path for path in read if path is not None]
    for target in named:
        check_not_read(target, inputs)
    for target in named:
        check_not_among(target)
        check_target(target)
    _check_json(json_target)


def warn_beyond(preset: str, voltage: float) -> None:
    """Say on standard error that a preset is driven by a larger voltage [V] than it is valid for."""
    known = largest_known_voltage(preset)
    if abs(voltage) > known:
        message = f"{preset} is valid up to {known:g} V, but is driven by {abs(voltage):g} V: this is extrapolated"
        progress_console.print(f"thruster: warning: {message}")


@cache
def announce_compilation() -> None:
    """Say on standard error when this process has to compile; later ones find the result in a cache."""
    tell_when_compiling(
        lambda: progress_console.print("compiling numerical code: the first run only, some seconds per filter ...")
    )


@contextmanager
def working(text: str) -> Iterator[None]:
    """Say on standard error what is running, with its progress if known."""
    with progress_console.status(Text(f"{text} ...")) as status:  # names are a user's, and no markup
        with listening(lambda far: status.update(Text(f"{text}: {far}"))):
            yield


def as_text(data) -> str:
    """JSON of plain data, arrays and NamedTuples; numbers that are not finite become null."""
    return json.dumps(_plain(data), indent=2, allow_nan=False) + "\n"


def _plain(value):
    if isinstance(value, dict):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def choice_table(choices: Mapping[str, Choice], scenario: Problem) -> Table:
    """The parameters of filters of one type, a column each."""
    kind, caption = next(iter(choices.values())).name, None
    model = scenario.model()
    rows = number_rows(list(choices.values()), kind, scenario, _number)
    if kind == "kf" and model.operating_input is not None:
        pairs = zip(model.operating_input, model.input_quantities, strict=True)
        about = ", ".join(f"{value:g} {quantity.unit}".rstrip() for value, quantity in pairs)
        caption = f"kf: on the affine approximation about {about}"
    return table(f"Parameters of the {kind} filter", ["", *choices], rows, caption=caption)


def _number(value) -> str:
    return "default" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def front_table(plan: Plan, front: Sequence) -> Table:
    """The Pareto front of trials, the best in the first objective first."""
    names = list(dict.fromkeys(name for trial in front for name in trial.params))
    rows = [
        [str(trial.number + 1)]
        + [f"{reported(*pair):.4g}" for pair in zip(plan.objectives, trial.values, strict=True)]
        + [_number(trial.params.get(name, "")) for name in names]
        for trial in sorted(front, key=lambda trial: trial.values)
    ]
    caption = "No other trial is better in both objectives. The first one is the tuned filter."
    return table(
        f"Pareto front on the training {plan.scenarios[0].seed_word}",
        ["trial", *map(reported_name, plan.objectives), *names],
        rows,
        caption=caption,
    )


def kinds_table(kinds: Sequence[TypeResult], plan: Plan) -> Table:
    """Filter types that a study tried, the best first."""
    objective = plan.objectives[0]
    rows = [
        [kind.name, str(kind.trials), str(kind.pruned), str(kind.over_budget), kind.best(objective)]
        + ["" if kind.microseconds is None else f"{kind.microseconds:.3g}"]
        for kind in kinds
    ]
    columns = ["filter", "trials", "pruned", "over\nbudget", f"best\n{reported_name(objective)}", "us/step"]
    caption = (
        "us/step: time of the best trial, or of the fastest if none is complete. *: mean NIS outside its band."
    )
    best = [0] if len(rows) > 1 else []
    title = f"Filters that were tried, on the training {plan.scenarios[0].seed_word}"
    return table(title, columns, rows, caption=caption, best=best)


MOST_FACTORS = 4  # of a start, that fit into a caption


def gradient_table(result: GradientResult, seed_word: str = "seeds") -> Table:
    """Where each start led, and how well the data determine the optimum."""
    likeliest = result.objective == LIKELIHOOD
    starts = "; ".join(", ".join(f"{factor:g}" for factor in factors) for factors in result.starts)
    caption = f"starts: factors {starts} on the untuned values" if len(result.free) <= MOST_FACTORS else None
    rows = []
    for i, (parameter, error) in enumerate(zip(result.free, result.standard_errors.tolist(), strict=True)):
        of_factor = f"± {100 * error:.0f} %" if error < 1 else f"x/: {np.exp(error):.2g}"
        values = [f"{optimum.parameters[i]:.4g}" for optimum in result.optima]
        name = index_pairs(parameter.name) + (f" [{parameter.unit}]" if parameter.unit else "")
        rows.append([name, *values, of_factor if parameter.log else f"± {error:.2g}"])
    levels = [
        optimum.level if likeliest else reported(result.objective, optimum.level) for optimum in result.optima
    ]
    rows.append(
        [reported_name(result.objective), *(f"{level:{'.2f' if likeliest else '.6g'}}" for level in levels), ""]
    )
    rows.append(["evaluations", *(str(optimum.evaluations) for optimum in result.optima), ""])
    what = f"{'Maximum' if result.objective in PROPER else 'Minimum'} of {reported_name(result.objective)}"
    what = "Maximum of the innovations' likelihood" if likeliest else what
    titles = [f"start {i + 1}" for i in range(len(result.starts))]
    return table(f"{what} on the training {seed_word}", ["", *titles, "standard error"], rows, caption=caption)


PROBLEMS = (
    f"{', '.join(built_in())}, a .toml file, or module:object: a tuning.problems.problem.Problem, or a "
    "function that returns one."
)
