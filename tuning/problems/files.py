"""Scenarios in TOML files, with a clear one-line error for a wrong file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TypeVar

from thruster_env.core.checks import any_case, meant, one_of, short_repr
from thruster_env.core.files import read_toml
from tuning.problems.plant_packages import PLANT_PACKAGES, plant_package
from tuning.problems.scenario import BaseScenario

FILE_SEQUENCES = 200  # input sequences for the scale of a file that gives none
PLANT = "plant"  # the key that names the plant
BASE = "base"
S = TypeVar("S", bound=BaseScenario)


def read_scenario(path: str | Path) -> BaseScenario:
    """A scenario from a TOML file, named by the path.

    Its keys are `plant`, one of `PLANT_PACKAGES` ("thruster" by default); the fields of that plant's `Scenario`
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

    def make() -> BaseScenario:
        base = room.find_scenario(content.pop(BASE, room.NOMINAL))
        changes = {"about": "", **content, "name": str(path)}
        scenario = _checked(base.replace(**changes, scale=base.scale if scale is None else scale))
        if scale is not None:
            return scenario
        return scenario.replace(scale=tuple(room.computed_scale(scenario, FILE_SEQUENCES)))

    return _made(make, content, path)


def find_in(known: Mapping[str, S], kind: type[S], owner: str, name: str) -> S:
    """A scenario of one plant, by its name or from a file.

    Args:
        known: the plant's scenarios by name.
        kind: the class of the plant's scenarios.
        owner: the plant in messages, such as "the thruster's".
        name: the name of one of them, or of a file that ends in .toml.

    Raises:
        ValueError: for an unknown name, a file that `read_scenario` refuses, or one of another plant.
    """
    if isinstance(name, str) and name.endswith(".toml"):
        scenario = read_scenario(name)
        if not isinstance(scenario, kind):
            raise ValueError(f"scenario must be {owner}, but {name} is of plant {scenario.plant_kind!r}")
        return scenario
    known_name = any_case(name, known)
    if not isinstance(known_name, str) or known_name not in known:
        rule = f"scenario must be one of {', '.join(known)}, or a file that ends in .toml"
        raise ValueError(f"{rule}, but got {short_repr(name)}{meant(name, known)}")
    return known[known_name]


def scenario_of(content, name: str, file: str | Path) -> BaseScenario:
    """The scenario whose `BaseScenario.as_mapping` is the content, as a tuned file stores it.

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
        return plant_package(
            one_of("plant of a scenario", content.pop(PLANT, next(iter(PLANT_PACKAGES))), tuple(PLANT_PACKAGES))
        )
    except ValueError as error:
        raise ValueError(f"{error} (in {path})") from None


def _fields(scenario: type[BaseScenario]) -> list[str]:
    return [entry.name for entry in fields(scenario) if entry.name != "name"]


def _checked(scenario: BaseScenario) -> BaseScenario:
    scenario.model()  # makes the plant, which checks the other fields
    return scenario


def _made(make: Callable[[], BaseScenario], content: Mapping, path: str | Path) -> BaseScenario:
    """The scenario that `make` makes from a file's content; a ValueError with the path if it fails."""
    try:
        return make()
    except ValueError as error:
        raise ValueError(f"{error} (in {path})") from None
    except (TypeError, AttributeError) as error:  # a value of another type than the plant takes
        raise ValueError(
            f"values of a scenario must be valid for `Scenario`, but got {short_repr(content)} in {path}: {error}"
        ) from None
