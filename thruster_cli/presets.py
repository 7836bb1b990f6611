"""`--preset` of commands on scenarios: the same scenario of another thruster."""

from __future__ import annotations

<<<<<<< HEAD
from typing import Annotated

import typer

from thruster_env.parameters import PRESETS
from tuning.thruster.logs import of_preset

__all__ = ["OfPresetOption", "of_preset"]

OfPresetOption = Annotated[
    str | None,
    typer.Option(
        "--preset", help=f"The scenario of another thruster: {', '.join(PRESETS)}, or a FILE.toml of `identify`."
    ),
]
=======
from tuning.problems.files import FILE_SEQUENCES
from tuning.problems.problem import Problem
from tuning.thruster.scale import computed_scale
from tuning.thruster.scenario import Scenario


def of_preset(problem: Problem, preset: str | None, sequences: int = FILE_SEQUENCES) -> Problem:
    """A scenario of another thruster, whose scale is computed anew; the problem itself where no preset is given.

    Args:
        problem: a scenario.
        preset: a preset's name or file.
        sequences: of inputs, that the scale is made of.

    Raises:
        ValueError: for a problem that is no scenario of a thruster that moves by its equations.
    """
    if preset is None:
        return problem
    if not isinstance(problem, Scenario) or problem.system is not None:
        raise ValueError(f"--preset must come with scenarios of the thruster's equations, but got {problem.name}")
    name = f"{problem.name} ({preset})"
    made = problem.replace(preset=preset, name=name, scale=problem.scale)
    return made.replace(scale=tuple(float(one) for one in computed_scale(made, sequences)))
>>>>>>> cli
