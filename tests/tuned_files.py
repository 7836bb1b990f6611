"""Tuned files for tests, of filters that no study had to find."""

from __future__ import annotations

import json
from pathlib import Path

from filters.tuned_file import OLD_FORMAT, sealed
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import write_tuned
from tuning.plants.thruster import Scenario, find_scenario
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.study import StudyResult


def write_untuned(
    path: Path | str, scenario: Scenario | str = "nominal", name: str = "ekf", seeds: int = 2
) -> Path:
    """A tuned file of the untuned filter on a scenario."""
    found = find_scenario(scenario) if isinstance(scenario, str) else scenario
    choice = untuned_choice(name, found)
    result = StudyResult(choice, 1.0, [], [], 0.0, False)
    write_tuned(path, Plan(name, (found,)), result, [evaluate_held_out(choice, found, 0, seeds)], "s")
    return Path(path)


def rewrite(path: Path, change) -> Path:
    """Change what a tuned file holds, and seal it anew, as anyone can."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(sealed(content)))
    return path


def of_version(content: dict, version: int) -> None:
    """Change what a tuned file of this version holds to what one of an earlier version held."""
    content |= {"format": OLD_FORMAT, "version": version, "scenario": content.pop("problem")}
    scenarios = content.pop("problems")
    if version > 2:
        content["scenarios"] = scenarios
    for name in ("digest", "model", *(["plant"] if version == 2 else [])):
        del content[name]
