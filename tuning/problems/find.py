"""Problems by name, by file or by `module:object`; an error in a scenario's TOML file is reported in one line."""

from __future__ import annotations

import copy
import importlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from thruster_env.core.checks import FEW, any_case, meant, one_of, short_repr
from thruster_env.core.files import read_toml
from thruster_env.core.modules import error_line, is_code, object_named
from tuning.problems.assumed import augmented, name_and_unknown
from tuning.problems.check import checked_problem
from tuning.problems.problem import Problem
from tuning.problems.scenario import FILE_SEQUENCES, PlantScenario

# Modules that know a plant, named as text: they are imported when a scenario is looked up. Each has the class
# Scenario, a `PlantScenario`, SCENARIOS by name, and the name of the NOMINAL one.
PLANT_PACKAGES = {"thruster": "tuning.plants.thruster", "auv": "tuning.plants.auv"}
PLANTS = "tuning.plants"  # group of entry points: such modules of other packages, by the plant
LOGS = "tuning.plants.thruster_logs"
PLANT = "plant"  # the key that names the plant
BASE = "base"
S = TypeVar("S", bound=PlantScenario)


@cache
def plant_packages() -> dict[str, ModuleType]:
    """The modules of scenarios by plant: those of this package, and of the entry points `tuning.plants`.

    One that cannot be imported is left out with a warning.
    """
    packages = {plant: importlib.import_module(module) for plant, module in PLANT_PACKAGES.items()}
    for point in entry_points(group=PLANTS):
        try:
            package = point.load()
            if not issubclass(package.Scenario, PlantScenario) or package.NOMINAL not in package.SCENARIOS:
                raise TypeError("its Scenario is no PlantScenario, or its NOMINAL none of its SCENARIOS")
        except Exception as error:  # whatever its lines raise
            rule = f"a module of the entry points {PLANTS} must offer Scenario, SCENARIOS and NOMINAL"
            warnings.warn(f"{rule}, but {point.value} does not: {error_line(error)}", stacklevel=2)
            continue
        packages.setdefault(point.name, package)
    return packages


def logs_package() -> ModuleType:
    """The package of the plant of logs without a model, `tuning.plants.thruster_logs`."""
    return importlib.import_module(LOGS)


def built_in() -> dict[str, PlantScenario]:
    """The scenarios of all plants by name."""
    return {name: scenario for room in plant_packages().values() for name, scenario in room.SCENARIOS.items()}


def read_scenario(path: str | Path) -> PlantScenario:
    """A scenario from a TOML file, named by the path.

    Its keys are `plant`, one of `plant_packages` ("thruster" by default); the fields of that plant's `Scenario`
    without the name; and `base`, the scenario whose fields are used where the file has none of its own (the
    plant's nominal one by default). A `scale` that is not in the file is computed.

        base = "outliers"
        about = "outliers under a binary sequence, with a flow that is unknown to the filter"
        excitation = {name = "prbs", amplitude = 8.0, hold = 40}
        flow = [{name = "gusts", std = 0.5}]

    Args:
        path: the file.

    Raises:
        ValueError: states the rule and the value, with the path.
    """
    content = read_toml(path, "a scenario file")
    room = _room(content, path)
    known = (PLANT, BASE, *_fields(room.Scenario))
    unknown = sorted(set(content) - set(known))
    if unknown:
        raise ValueError(f"keys of a scenario must be among {', '.join(known)}, but {path} has {unknown}")
    scale = content.pop("scale", None)

    def make() -> PlantScenario:
        base = find_in(room.SCENARIOS, room.Scenario, content.pop(BASE, room.NOMINAL))
        changes = {"about": "", **content, "name": str(path)}
        scenario = _checked(base.replace(**changes, scale=scale))
        if scale is not None:
            return scenario
        return scenario.replace(scale=tuple(scenario.computed_scale(FILE_SEQUENCES)))

    return _made(make, content, path)


def find_in(known: Mapping[str, S], kind: type[S], name: str) -> S:
    """A scenario of one plant, by its name or from a file.

    Args:
        known: the plant's scenarios by name.
        kind: the class of the plant's scenarios.
        name: the name of one of them, or of a file that ends in .toml.

    Raises:
        ValueError: for an unknown name, a file that `read_scenario` refuses, or one of another plant.
    """
    if isinstance(name, str) and name.endswith(".toml"):
        scenario = read_scenario(name)
        if not isinstance(scenario, kind):
            raise ValueError(
                f"scenario must be of plant {kind.plant_kind!r}, but {name} is of plant {scenario.plant_kind!r}"
            )
        return scenario
    known_name = any_case(name, known)
    if not isinstance(known_name, str) or known_name not in known:
        rule = f"scenario must be one of {', '.join(known)}, or a file that ends in .toml"
        raise ValueError(f"{rule}, but got {short_repr(name)}{meant(name, known)}")
    return known[known_name]


def scenario_of(content, name: str, file: str | Path) -> PlantScenario:
    """The scenario whose `PlantScenario.as_mapping` is the content, as a tuned file stores it.

    Args:
        content: the mapping.
        name: of the scenario.
        file: where the content comes from, for errors.

    Raises:
        ValueError: states the rule and the value, with the file.
    """
    entries = dict(content) if isinstance(content, Mapping) else {}
    room = _room(entries, file)
    known = _fields(room.Scenario)
    if not isinstance(content, Mapping) or not set(entries) <= set(known):
        raise ValueError(
            f"a scenario in a file must be a mapping of {', '.join(known)}, but {file} has {short_repr(content)}"
        )
    return _made(lambda: _checked(room.Scenario(name=name, **entries)), entries, file)


def _room(content: dict, path: str | Path):
    """The package of the plant of a scenario file; removes the key from the content."""
    try:
        known = plant_packages()
        return known[one_of("plant of a scenario", content.pop(PLANT, next(iter(known))), tuple(known))]
    except ValueError as error:
        raise ValueError(f"{error} (in {path})") from None


def _fields(scenario: type[PlantScenario]) -> list[str]:
    return [entry.name for entry in fields(scenario) if entry.name != "name"]


def _checked(scenario: PlantScenario) -> PlantScenario:
    scenario.model()  # makes the plant, which checks the other fields
    return scenario


def _made(make: Callable[[], PlantScenario], content: Mapping, path: str | Path) -> PlantScenario:
    """The scenario that `make` makes from a file's content; a ValueError with the path if it fails."""
    try:
        return make()
    except ValueError as error:
        raise ValueError(f"{error} (in {path})") from None
    except (TypeError, AttributeError) as error:  # a value of another type than the plant takes
        raise ValueError(
            f"values of a scenario must be valid for `Scenario`, but got {short_repr(content)} in {path}: {error}"
        ) from None


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
        return known[known_name]
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
