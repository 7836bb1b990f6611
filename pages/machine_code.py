"""Take the pieces of code of docs/machine_code.md from the program.

    python -m pages.machine_code [FOLDER]

The example is the extended Kalman filter of a body that its drag slows down.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence

from filters import StateSpaceModel
from filters.algebra.matrices import Matrix, in_order
from filters.differentiated.memory import Memory
from filters.differentiated.recursion import Wanted, stages_of
from filters.ensembles import ensemble as steps
from filters.ensembles import stochastic
from filters.ensembles import stochastic as deterministic
from filters.gaussian import extended
from filters.pages import kernels
from filters.pages.equations import Equations
from filters.pages.kernels import Stage, as_programs
from filters.pages.members import MembersMemory
from filters.pages.members import stages_of as stages_of_members
from filters.pages.page import RowMemory
from filters.pages.traced import MOST
from filters.particles import particle, weighted
from pages.page import make_page
from thruster_env.graphs.loops import cut
from thruster_env.graphs.programs import Place, Program

WANTED = Wanted(information=False, constants=True, tails=False)


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


def stages() -> tuple[list[Stage], Memory]:
    """The stages of a step of its filter (propagate, add process noise, update), and the memory layout."""
    model = body()
    memory = Memory(model.shape, extended.ExtendedKalmanFilter.page)
    equations = Equations(model.functions, memory, constants_move=True, trace=True)
    return stages_of(memory, equations, WANTED), memory


def block(text: str, language: str = "python") -> str:
    """A block of code in Markdown."""
    return f"```{language}\n{text}\n```"


def page() -> str:
    """The filter as it stands in a textbook."""
    functions = extended.propagate, extended.add_process_noise, extended.update
    return block("\n\n\n".join(inspect.getsource(function).rstrip() for function in functions))


def operation_lines(wanted: Sequence[Matrix], names: dict[Matrix, str]) -> list[str]:
    """The operations that compute some matrices, a line each."""
    lines = []
    for matrix in in_order(wanted):
        if matrix in names:
            continue
        if isinstance(matrix.operation, Place):
            names[matrix] = str(matrix.operation)
            continue
        names[matrix] = f"m{sum(name.startswith('m') for name in names.values())}"
        arguments = ", ".join(names[a] if isinstance(a, Matrix) else repr(a) for a in matrix.arguments)
        lines.append(f"{names[matrix]} = {matrix.operation.name.strip('_')}({arguments})")
    return lines


def names_of(memory: Memory) -> dict[Matrix, str]:
    """The page's names of its input matrices."""
    names = {memory.x: "x", memory.P: "P", memory.u: "u", memory.z: "z", memory.Q: "Q", memory.R: "R"}
    names |= {memory.scales: "s", memory.constants: "c", memory.constants_slope: "dc", memory.size: "size"}
    return names | {slope: f"d{names[matrix]}" for matrix, slope in memory.moves.items()}


def graph() -> str:
    """The update as a graph of matrices."""
    parts, memory = stages()
    return block("\n".join(operation_lines(list(parts[2].values.values()), names_of(memory))), "text")


def slopes() -> str:
    """The prediction's derivatives, beside what they share with its values."""
    parts, memory = stages()
    names = names_of(memory)
    values = operation_lines(list(parts[0].values.values()), names)
    derived = operation_lines(list(parts[0].slopes.values()), names)
    return block("\n".join([*values, "", *derived]), "text")


def numbers() -> str:
    """The prediction as programs: its values, and their derivatives."""
    parts, memory = stages()
    both = as_programs(parts[0], memory.length, MOST)
    texts = ("\n".join(_lines(program)) for program in (both.values, both.slopes))
    return block(
        "\n\n".join(f"# {title}\n{text}" for title, text in zip(("values", "slopes"), texts, strict=True))
    )


def program() -> str:
    """The prediction of the filter that runs, as a program."""
    model = body()
    memory = RowMemory(model.shape, extended.ExtendedKalmanFilter.page)
    equations = Equations(model.functions, memory, constants_move=False, trace=True)
    advanced = kernels.stages_of(extended.ExtendedKalmanFilter.page, memory, equations)[2]
    return block("\n".join(_lines(as_programs(advanced, 0, MOST).values)))


def members() -> str:
    """The ensemble Kalman filter as it stands in a textbook."""
    functions = steps.propagate, steps.add_process_noise, steps.compare, stochastic.update_stochastic
    return block("\n\n\n".join(inspect.getsource(function).rstrip() for function in functions))


def particles() -> str:
    """The bootstrap particle filter's update as it stands in a textbook."""
    return block(
        "\n\n\n".join(
            inspect.getsource(function).rstrip() for function in (weighted.expect, weighted.fit, particle.update)
        )
    )


def loops() -> str:
    """The loops over members in a deterministic ensemble's update."""
    model, kind = body(), deterministic.DeterministicEnsembleKalmanFilter
    memory = MembersMemory(model.shape, kind.page)
    equations = Equations(model.functions, memory, constants_move=False, trace=True)
    update = as_programs(stages_of_members(kind.page, memory, equations)["analyse"], 0, MOST).values
    ordered = [*(node for _, node in update.reads), *update.works]
    names = {node.place: f"t{k}" for k, node in enumerate(ordered)}
    texts = dict(line.split(" = ", 1) for line in _lines(update) if line.startswith("t"))
    parts = cut(update, model.n)
    lines = [f"{names[node.place]} = {source}" for source, node in parts.reads]
    for turn in parts.turns:
        once = (names[node.place] for node in turn.works if node.operation != "sum")
        lines += [f"{name} = {texts[name]}" for name in once]
        for loop in turn.bodies:
            lines.append("for each member:")
            inside = [f"{names[node.place]} = {source}" for source, node in loop.reads]
            inside += [f"{names[node.place]} = {texts[names[node.place]]}" for node in loop.works]
            inside += [f"{target} = {names[node.place]}" for target, node in loop.stores]
            inside += [f"{names[node.place]} += {names[node.of[0].place]}" for node in loop.sums]
            lines += [f"    {line}" for line in inside]
    return block("\n".join(lines), "text")


def _lines(program: Program) -> list[str]:
    """A program's lines, with constants in decimal digits."""
    lines = []
    for line in program.text:
        name, _, value = line.partition(" = float.fromhex(")
        lines.append(f"{name} = {float.fromhex(value[1:-2])!r}" if value else line)
    return lines


TABLES = {"page": page, "graph": graph, "program": program, "slopes": slopes, "numbers": numbers}
TABLES |= {"members": members, "loops": loops, "particles": particles}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("machine_code", "pages.machine_code", {}, TABLES, "The code of docs/machine_code.md.", arguments)


if __name__ == "__main__":
    main()
