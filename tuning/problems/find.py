"""Problems by name, by file or by `module:object`."""

from __future__ import annotations

import copy
import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

from numerics.checks import shown
from numerics.modules import is_code, object_named, said
from tuning.problems.check import checked_problem
from tuning.problems.problem import Problem

# Modules of the rooms that know a plant, imported when a name is looked for: each has NAMES of problems,
# find_scenario(name or file) and from_mapping(content, name, file).
ROOMS = ("tuning.thruster.find",)
FILES_ARE_OF = ROOMS[0]  # whose files .toml are, and what tuned files keep as data


def built_in() -> dict[str, ModuleType]:
    """Names of the problems that come with the package, and the room of each."""
    rooms = [importlib.import_module(room) for room in ROOMS]
    return {name: room for room in rooms for name in room.NAMES}


def find_problem(name: str) -> Problem:
    """A problem by its name, from a FILE.toml, or by "module:object": the object, or what a function gives.

    Modules are looked for where Python looks, then in the working folder.

    Raises:
        ValueError: states the rule and the value, where there is no such problem, or what is there is none.
    """
    if is_code(name):
        return _from_module(name)
    if isinstance(name, str) and name.endswith(".toml"):
        return importlib.import_module(FILES_ARE_OF).find_scenario(name)
    known = built_in()
    if not isinstance(name, str) or name not in known:
        rule = f"problem must be one of {', '.join(known)}, a file that ends in .toml, or module:object"
        raise ValueError(f"{rule}, but got {shown(name)}")
    return known[name].find_scenario(name)


def find_same(name: str, digest: str) -> Problem:
    """A problem by its name, which has to be what another process has: ValueError for another digest."""
    found = find_problem(name)
    if found.digest != digest:
        raise ValueError(
            f"problem {name} must be the same in all processes, of digest {digest}, but here it has {found.digest}"
        )
    return found


def find_given(name, given: Sequence[Problem], where: str | Path) -> Problem:
    """A problem that a file or a storage names, of those that the user gives or, if it is no code, by its name.

    Nothing is imported that a file or a storage names.

    Args:
        name: the problem's.
        given: by the user.
        where: the name comes from, for errors.

    Raises:
        ValueError: if there is no such problem, or it is code that is not given.
    """
    for one in given:
        if one.name == name:
            return one
    if not is_code(name):
        return find_problem(name)
    raise ValueError(
        f"a problem that is code must be given, but {where} only names {shown(name)}: "
        f"say --problem {name}, if you trust it"
    )


def problem_from_mapping(content: Mapping, name: str, file: str | Path) -> Problem:
    """The problem of which a tuned file keeps `Problem.as_mapping`; ValueError with the file if it is none."""
    return importlib.import_module(FILES_ARE_OF).from_mapping(content, name, file)


def _from_module(name: str) -> Problem:
    found = object_named(name, "problem")
    if not isinstance(found, Problem) and callable(found):
        try:
            found = found()
        except Exception as error:
            raise ValueError(
                f"a problem's function must give it without arguments, but {name!r} raised {said(error)}"
            ) from error
    return named(checked_problem(found, name), name)


def named(problem: Problem, name: str) -> Problem:
    """A problem under the name by which it was found, by which others find it again."""
    if problem.name == name:
        return problem
    other = copy.copy(problem)
    object.__setattr__(other, "name", name)
    return other
