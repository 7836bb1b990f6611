"""Scenarios in TOML files: what a user may write, and one clear line about what is wrong with it."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path

from numerics.checks import shown
from tuning.thruster.scale import computed_scale
from tuning.thruster.scenario import Scenario

FILE_SEQUENCES = 200  # voltage sequences for the scale of a file that gives none
KEYS = ("base", *(entry.name for entry in fields(Scenario) if entry.name != "name"))


def read_scenario(path: str | Path, find_base: Callable[[str], Scenario]) -> Scenario:
    """A scenario from a TOML file, named by the path.

    Its keys are the fields of `Scenario` but for the name, and `base`: the scenario whose fields are taken where
    the file has none of its own, "nominal" if it is left out. Where the file has no `scale`, it is computed
    (`scale.computed_scale`).

        base = "outliers"
        about = "outliers under a binary sequence, with a flow that the filter does not know"
        excitation = {name = "prbs", amplitude = 8.0, hold = 40}
        flow = [{name = "gusts", std = 0.5}]

    Args:
        path: the file.
        find_base: gives the scenario that `base` names.

    Raises:
        ValueError: states the rule and the value, with the path.
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"a scenario file must be readable, but {path} is not: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # not TOML, nested too deeply, or not even text
        raise ValueError(f"a scenario file must be TOML, but {path} is not: {error}") from None
    unknown = sorted(set(content) - set(KEYS))
    if unknown:
        raise ValueError(f"keys of a scenario must be among {', '.join(KEYS)}, but {path} has {unknown}")
    scale = content.pop("scale", None)

    def make() -> Scenario:
        base = find_base(content.pop("base", "nominal"))
        changes = {"about": "", **content, "name": str(path)}
        scenario = _checked(base.replace(**changes, scale=base.scale if scale is None else scale))
        return (
            scenario.replace(scale=tuple(computed_scale(scenario, FILE_SEQUENCES))) if scale is None else scenario
        )

    return _made(make, content, path)


def scenario_of(content, name: str, file: str | Path) -> Scenario:
    """The scenario of which `Scenario.as_mapping` is the content, as a tuned file keeps it.

    Args:
        content: the mapping.
        name: of the scenario.
        file: where the content comes from, for errors.

    Raises:
        ValueError: states the rule and the value, with the file.
    """
    known = [key for key in KEYS if key != "base"]
    if not isinstance(content, Mapping) or not set(content) <= set(known):
        raise ValueError(
            f"a scenario in a file must be a mapping of {', '.join(known)}, but {file} has {shown(content)}"
        )
    return _made(lambda: _checked(Scenario(name=name, **content)), content, file)


def _checked(scenario: Scenario) -> Scenario:
    scenario.model()  # which makes the plant: the rest is checked there
    return scenario


def _made(make: Callable[[], Scenario], content: Mapping, path: str | Path) -> Scenario:
    """What `make` makes of a file's content; a ValueError with the path where that cannot be."""
    try:
        return make()
    except ValueError as error:
        raise ValueError(f"{error} (in {path})") from None
    except (TypeError, AttributeError) as error:  # a value of another kind than the plant takes
        raise ValueError(
            f"values of a scenario must be such as `Scenario` takes, but got {shown(content)} in {path}: {error}"
        ) from None
