"""Take the pieces of code of docs/machine_code.md from the program.

The example is the extended Kalman filter of a body that its drag slows down.
"""

from __future__ import annotations

import inspect

from docs.scripts import by_name
from filters import StateSpaceModel
from filters.gaussian import extended
from filters.pages import kernels
from filters.pages.kernels import as_programs
from filters.pages.page import Equations, RowMemory
from thruster_env.graphs.programs import Program
from thruster_env.model.traced import MOST


def slowed(x, u, c):
    """The speed of a body a tenth of a second later: drag c[0] x |x|, and a force."""
    return (x[0] - 0.1 * (c[0] * x[0] * abs(x[0]) - u[0]),)


def speed(x, c):
    """Its speed."""
    return (x[0],)


def body() -> StateSpaceModel:
    """The body."""
    return StateSpaceModel(
        transition=slowed,
        observe=speed,
        constants=(0.5,),
        process_noise_cov=[0.01],
        measurement_noise_cov=[0.1],
        prior_mean=[1.0],
        prior_cov=[1.0],
        inputs=1,
    )


def block(text: str, language: str = "python") -> str:
    """A block of code in Markdown."""
    return f"```{language}\n{text}\n```"


def page() -> str:
    """The filter as it stands in a textbook."""
    functions = extended.propagate, extended.add_process_noise, extended.update
    return block("\n\n\n".join(inspect.getsource(function).rstrip() for function in functions))


def program() -> str:
    """The prediction of the filter that runs, as a program."""
    model = body()
    memory = RowMemory(model.shape, extended.ExtendedKalmanFilter.page)
    equations = Equations(model.functions, memory, constants_move=False, trace=True)
    advanced = kernels.stages_of(extended.ExtendedKalmanFilter.page, memory, equations)[2]
    return block("\n".join(_lines(as_programs(advanced, 0, MOST).values)))


def _lines(program: Program) -> list[str]:
    """A program's lines, with constants in decimal digits."""
    lines = []
    for line in program.text:
        name, _, value = line.partition(" = float.fromhex(")
        lines.append(f"{name} = {float.fromhex(value[1:-2])!r}" if value else line)
    return lines


TABLES = by_name(page, program)
