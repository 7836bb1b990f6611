"""A user's problem argument as a `Problem`: a name, a problem itself, or a model and recorded runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from filters.estimators.foreign import is_foreign, is_trained
from filters.registry import FILTERS, filter_type
from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import short_repr
from thruster_env.logs.log import Log
from thruster_env.logs.recorders.registry import ENDINGS
from thruster_env.logs.table import SUFFIXES
from tuning.api.read_logs import RecordedRuns, read_logs
from tuning.logs.problem import problems_in
from tuning.problems import find
from tuning.problems.assumed import augmented, unknowns_of
from tuning.problems.check import checked_problem
from tuning.problems.find import built_in, logs_package
from tuning.problems.problem import Problem
from tuning.series.column import is_numbers

RULE = (
    "a problem must be a name, a file that ends in .toml, 'module:object', a Problem, what read_logs "
    "returns, or a pair (model, data) of a model and recorded runs"
)

OF_NUMBERS = (
    "tuning.fit(z, dt=0.1) finds the model, Q and R of numbers, and tuning.tune(tuning.read_logs(z, model='auto', "
    "dt=0.1)) tunes any filter of such a model"
)


def find_problem(
    problem: Any, *, preset: str | Path | None = None, augment: Sequence[str] | Mapping[str, Any] = ()
) -> Problem:
    """A problem by its name, of another thruster, or with constants that the filter estimates in addition.

        study = tuning.tune(tuning.find_problem("mismatch", augment={"voltage_gain": (60.0, 0.5)}))

    Args:
        problem: as for `tuning.tune`.
        preset: the problem of another thruster, by name or file.
        augment: constants of the model, such as "voltage_gain", that the filter also estimates, as further states
            whose random walks are tuned with Q: texts NAME[:STD[:WALK]], or by name an `Unknown` or (std, walk).

    Raises:
        ValueError: states the rule and the value.
    """
    return augmented(problem_of(problem, preset), unknowns_of(augment))


def problem_of(argument: Any, preset: str | Path | None = None) -> Problem:
    """The problem for a user's argument.

    Args:
        argument: a name, such as "mismatch" or "auv:motion", a .toml file, or "module:object"; a `Problem`; what
            `read_logs` returns, or a pair (model, data) for it; or a thruster's log.
        preset: the problem of another thruster, by name or file.

    Raises:
        ValueError: states the rule and the value.
    """
    if isinstance(argument, tuple) and len(argument) == 2:
        model, logs = argument
        argument = read_logs(logs, model=model)
    elif is_numbers(argument):
        raise ValueError(f"numbers must come with a model, but got {short_repr(argument)} alone: {OF_NUMBERS}")
    elif isinstance(argument, Log | Mapping) or hasattr(argument, "columns") or _is_log_file(argument):
        argument = read_logs(argument)
    if isinstance(argument, RecordedRuns):
        if preset is not None:
            raise ValueError(f"preset must be given to read_logs, but got {short_repr(preset)} beside {argument}")
        return argument.problem()
    if isinstance(argument, str | Path):
        problem = find.find_problem(str(argument))
    elif isinstance(argument, Problem):
        problem = checked_problem(_told_apart(argument))
    else:
        raise ValueError(f"{RULE}, but got {short_repr(argument)}")
    return logs_package().of_preset(problem, preset)


def problems_of(argument: Any, preset: str | Path | None = None) -> tuple[Problem, ...]:
    """One problem, or several in a list; arguments as in `problem_of`. A second "a" is named "a (2)"."""
    arguments = argument if isinstance(argument, list) and not is_numbers(argument) else [argument]
    if not arguments:
        raise ValueError(f"{RULE}, or a list of them, but got an empty list")
    problems = [problem_of(each, preset) for each in arguments]
    names = [problem.name for problem in problems]
    for i, name in enumerate(names):
        if name in names[:i]:  # tables and files know problems by their names
            problems[i] = find.named(problems[i], f"{name} ({names[: i + 1].count(name)})")
    return tuple(problems)


def given_for(
    file: str | Path,
    problem: Any = None,
    model: Any = None,
    preset: str | Path | None = None,
) -> list[Problem]:
    """The problems of a tuned file: those given by the user, and logs that the file names.

    Names in a file are never imported: a problem or a model that is code has to be given.
    """
    problems = [] if problem is None else list(problems_of(problem))
    stored = read_tuned_file(file)["problems"]
    if any(candidate.name in stored for candidate in problems):
        return problems
    return [*problems, *problems_in(Path(file), model, preset)]


def is_filter(argument: Any) -> bool:
    """Whether something is a filter or an estimator, not a tuned file (a `Path`, or a text that ends in .json).

    The file of a trained estimator is an estimator.

    Raises:
        ValueError: for an unknown name, or any other object.
    """
    if is_trained(argument):
        return True
    if isinstance(argument, Path) or (
        isinstance(argument, str) and argument not in FILTERS and _is_tuned_file(argument)
    ):
        return False
    if isinstance(argument, str) or is_foreign(argument):
        filter_type(argument)  # a clear error for an unknown name
        return True
    raise ValueError(
        f"a filter must be a name, a tuned file, a Study or an estimator, but got {short_repr(argument)}"
    )


def _is_log_file(argument: Any) -> bool:
    return isinstance(argument, str | Path) and Path(argument).suffix in (*SUFFIXES, *ENDINGS)


def _is_tuned_file(text: str) -> bool:
    return text.endswith(".json") or Path(text).is_file()


def _told_apart(problem: Problem) -> Problem:
    """A problem that a user changed, under another name than that of the package's: files know these by name."""
    known = built_in()
    if problem.name in known and known[problem.name].digest != problem.digest:
        return find.named(problem, f"{problem.name} (changed)")
    return problem
