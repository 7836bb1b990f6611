"""A user's problem argument as a `Problem`: a name, a problem itself, or a model and recorded runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from filters.estimators.find import is_foreign, is_trained
from filters.registry import FILTERS, filter_type
from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import short_repr
from thruster_env.core.modules import is_code
from tuning.api.read_logs import RecordedRuns
from tuning.logs.problem import log_problem, problems_in
from tuning.problems.check import checked_problem
from tuning.problems.find import find_problem, named
from tuning.problems.plant_packages import built_in, logs_package
from tuning.problems.problem import Problem

RULE = (
    "a problem must be a name, a file that ends in .toml, 'module:object', a Problem, or a pair (model, data) of "
    "a model and recorded runs"
)


def problem_of(argument: Any, preset: str | Path | None = None, **of_logs: Any) -> Problem:
    """The problem for a user's argument.

    Args:
        argument: a name, such as "mismatch" or "auv:motion", a .toml file, or "module:object"; a
            `Problem`; or a pair (model, data) for `log_problem`, where the model is a `StateSpaceModel`, an object
            that makes or offers one, "module:object", or a thruster's preset, and data are recorded runs.
        preset: the problem of another thruster, by name or file.
        **of_logs: options of `log_problem`, for a pair; None for those not given.

    Raises:
        ValueError: states the rule and the value.
    """
    options = {name: value for name, value in of_logs.items() if value is not None}
    if isinstance(argument, RecordedRuns):
        if preset is not None:
            raise ValueError(f"preset must be given to read_logs, but got {short_repr(preset)} beside {argument}")
        return argument.problem()
    if isinstance(argument, tuple) and len(argument) == 2:
        return _of_logs(*argument, preset, options)
    if options:
        raise ValueError(
            f"{next(iter(options))} must come with a pair (model, data), but got {short_repr(argument)}"
        )
    if isinstance(argument, str | Path):
        problem = find_problem(str(argument))
    elif isinstance(argument, Problem):
        problem = checked_problem(_told_apart(argument))
    else:
        raise ValueError(f"{RULE}, but got {short_repr(argument)}")
    return logs_package().of_preset(problem, preset)


def problems_of(argument: Any, preset: str | Path | None = None, **of_logs: Any) -> tuple[Problem, ...]:
    """One problem, or several in a list; arguments as in `problem_of`. A second "a" is named "a (2)"."""
    arguments = argument if isinstance(argument, list) else [argument]
    if not arguments:
        raise ValueError(f"{RULE}, or a list of them, but got an empty list")
    problems = [problem_of(each, preset, **of_logs) for each in arguments]
    names = [problem.name for problem in problems]
    for i, name in enumerate(names):
        if name in names[:i]:  # tables and files know problems by their names
            problems[i] = named(problems[i], f"{name} ({names[: i + 1].count(name)})")
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


def _is_tuned_file(text: str) -> bool:
    return text.endswith(".json") or Path(text).is_file()


def _of_logs(model: Any, data: Any, preset: str | Path | None, options: dict[str, Any]) -> Problem:
    if isinstance(model, str | Path) and not is_code(str(model)):
        if preset is not None:
            raise ValueError(
                f"a pair (model, data) of a preset must come without another, but got {short_repr(preset)}"
            )
        preset, model = model, None
    return log_problem(data, **_without_nothing({"preset": preset, "model": model}), **options)


def _without_nothing(options: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _told_apart(problem: Problem) -> Problem:
    """A problem that a user changed, under another name than that of the package's: files know these by name."""
    known = built_in()
    if problem.name in known and known[problem.name].find_scenario(problem.name).digest != problem.digest:
        return named(problem, f"{problem.name} (changed)")
    return problem
