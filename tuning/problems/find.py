"""Problems by name, by file or by `module:object`."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from thruster_env.core.checks import FEW, any_case, meant, short_repr
from thruster_env.core.modules import error_line, is_code, object_named
from tuning.problems.augmented import augmented, name_and_unknown
from tuning.problems.check import checked_problem
from tuning.problems.files import read_scenario
from tuning.problems.plant_packages import built_in
from tuning.problems.problem import Problem


def find_problem(name: str) -> Problem:
    """A problem by its name, from a FILE.toml, or by "module:object": the object, or a function's result.

    After "+" stands a constant of the model that filters also estimate, as in "mismatch+voltage_gain". Modules are
    looked for on Python's path, then in the working folder.

    Raises:
        ValueError: states the rule and the value, where there is no such problem, or the object is not a problem.
    """
    name, unknown = name_and_unknown(name) if isinstance(name, str) else (name, {})
    if unknown:
        return augmented(find_problem(name), unknown)
    known = built_in()  # whose names may have a colon, too
    known_name = any_case(name, known)
    if isinstance(known_name, str) and known_name in known:
        return known[known_name].find_scenario(known_name)
    if is_code(name):
        return _from_module(name)
    if isinstance(name, str) and name.endswith(".toml"):
        return read_scenario(name)
    rule = f"problem must be one of {', '.join([*known][:FEW])} and {len(known) - FEW} more"
    rule += " (thruster tune --help lists all), a file that ends in .toml, or module:object"
    raise ValueError(f"{rule}, but got {short_repr(name)}{_module_meant(name) or meant(name, known)}")


def _module_meant(name: Any) -> str:
    """The end of a message on the name of a module in the working folder; empty if there is none."""
    plain = name.removesuffix(".py") if isinstance(name, str) else ""
    exists = plain.isidentifier() and Path(f"{plain}.py").is_file()
    return f"; did you mean '{plain}:problem'?" if exists else ""


def find_same(name: str, digest: str) -> Problem:
    """A problem by its name, which must be the same as in another process: ValueError for another digest."""
    problem = find_problem(name)
    if problem.digest != digest:
        raise ValueError(
            f"problem {name} must be the same in all processes, of digest {digest}, but here it has "
            f"{problem.digest}"
        )
    return problem


def find_given(name, problems: Sequence[Problem], where: str | Path) -> Problem:
    """A problem that a file or a storage names: one of the user's or, unless it is code, one found by its name.

    Nothing is imported that a file or a storage names.

    Args:
        name: the problem's name.
        problems: those of the user.
        where: the source of the name, for errors.

    Raises:
        ValueError: if there is no such problem, or it is code that is not given.
    """
    for problem in problems:
        if problem.name == name:
            return problem
    plain, unknown = name_and_unknown(name) if isinstance(name, str) else (name, {})
    if unknown:
        return augmented(find_given(plain, problems, where), unknown)
    known = built_in()
    if isinstance(name, str) and (any_case(name, known) in known or name.endswith(".toml")):
        return find_problem(name)
    if isinstance(name, str) and not is_code(name):
        raise ValueError(
            f"{where} was tuned on {name!r}, an object of yours: pass problem=... (--problem module:object)"
        )
    raise ValueError(
        f"a problem that is code must be given, but {where} only names {short_repr(name)}: "
        f"use --problem {name}, if you trust it"
    )


def _from_module(name: str) -> Problem:
    problem = object_named(name, "problem")
    if not isinstance(problem, Problem) and callable(problem):
        try:
            problem = problem()
        except Exception as error:
            raise ValueError(
                f"a function must return a problem without arguments, but {name!r} raised {error_line(error)}"
            ) from error
    return named(checked_problem(problem, name), name)


def named(problem: Problem, name: str) -> Problem:
    """A problem under the name by which it was found."""
    if problem.name == name:
        return problem
    other = copy.copy(problem)
    object.__setattr__(other, "name", name)
    return other
