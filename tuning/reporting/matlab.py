"""A tuned filter as a MATLAB function: its model, Q, R and, where it is an extended Kalman filter, its step.

The code runs in MATLAB and in GNU Octave without a toolbox. The functions f and h take columns, as
`extendedKalmanFilter` and `unscentedKalmanFilter` of MATLAB's toolboxes want them.

They are written from the graphs of the model's functions, from which C and machine code are made, too.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.core.files import read_toml
from thruster_env.graphs.graphs import COMPARISONS, UNARY, Graph, Number, needed_by
from thruster_env.model.affine import AffineModel
from thruster_env.model.shape import constants_form
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.traced import traced_function, why_not_traced
from tuning.problems.assumed import within
from tuning.problems.find import built_in
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Problem
from tuning.reporting.page import Code, Section, Words
from tuning.search.space import Choice

EXPRESSIONS = {
    **{name: f"{name}({{}})" for name in (*UNARY, "abs")},
    **{f"arc{name}": f"a{name}({{}})" for name in "tan tanh sinh cosh".split()},
    **{operation: f"{{}} {operation} {{}}" for operation in (*"+-*/", *COMPARISONS)},
    "!=": "{} ~= {}",
    "and": "{} & {}",
    "or": "{} | {}",
    "pow": "{} ^ {}",
    "negative": "-{}",
    "cbrt": "nthroot({}, 3)",
    "exp2": "2 ^ {}",
    "arctan2": "atan2({}, {})",
    "hypot": "hypot({}, {})",
    "fmod": "rem({}, {})",
    "copysign": "abs({}) * (2 * ({} >= 0) - 1)",
    "rint": "round({0}) - (abs({0} - fix({0})) == 0.5) * mod(round({0}), 2) * sign({0})",  # halves to even numbers
    "where": "choose({}, {}, {})",
}
"""What MATLAB has for the operations of graphs."""


def lines_of(function: Callable, arguments: Sequence[Sequence[str]], constants: Any, count: int) -> list[str]:
    """Lines "t1 = a + b;" of a function and, last, "[t7; t9]", its results.

    Args:
        function: of a model, which takes vectors and the constants last.
        arguments: names of the components of each vector.
        constants: of the model.
        count: of its results.

    Raises:
        ValueError: in one line, with that of the function, where it cannot be traced.
    """
    graph, sizes = Graph(), (*map(len, arguments), len(constants))
    vectors = [np.array([*map(graph.given, names), None], dtype=object)[:-1] for names in arguments]
    try:
        traced = traced_function(function, sizes, constants_form(constants), (count,))
        results = [graph.number(result) for result in traced(*vectors, np.array(constants, dtype=object))]
    except Exception as error:  # whatever a user's function raises if it gets Numbers
        rule = "a function that is written out must be traced, but"
        raise ValueError(f"{rule} {why_not_traced(function, error)}") from None
    names: dict[int, str] = {}
    lines: list[str] = []
    for number in needed_by(results):
        names[number.place] = _known(number) or f"t{len(lines) + 1}"
        if not _known(number):
            parts = (names[part.place] for part in number.of)
            lines.append(f"{names[number.place]} = {EXPRESSIONS[number.operation].format(*parts)};")
    return [*lines, f"[{'; '.join(names[result.place] for result in results)}]"]


def _known(number: Number) -> str:
    """The text of an argument or a constant; empty for others."""
    if number.value is None:
        return str(number.arguments[0]) if number.operation == "given" else ""
    return f"{number.value:.17g}" if number.value >= 0.0 else f"({number.value:.17g})"


STEPPED = ("kf", "ekf")  # of which there is a step
LONGEST = 1500  # lines of f or h
TEXTS = read_toml(Path(__file__).with_name("lines_to_copy.toml"), "texts of lines to copy")
PYTHON, MATLAB = TEXTS["python"], TEXTS["matlab"]


def matlab_function(choice: Choice, model: StateSpaceModel, problem: str, dt: float | None) -> str:
    """The text of NAME.m, whose function gives a tuned filter's model and, of a Kalman filter, its step.

    Args:
        choice: the tuned filter.
        model: what it assumes.
        problem: what it was tuned on.
        dt: sample time [s], if it has one.
    """
    name = function_name(choice.name, problem)
    try:
        (pieces, fields), why = _functions(model), ""
    except ValueError as error:
        pieces, fields, why = "", [], str(error)
    steps = choice.name in STEPPED and pieces and (choice.name == "ekf" or isinstance(model, AffineModel))
    head, update = MATLAB["head"] + (MATLAB["step" if steps else "toolbox"] if pieces else ""), MATLAB["update"]
    for plain, fed in MATLAB["fed"] if model.feeds else ():
        head, update = head.replace(plain, fed), update.replace(plain, fed)
    text = head.format(
        name=name,
        shout=name.upper(),
        filter=choice.name,
        problem=problem,
        more=", m.A, m.B, m.C" if isinstance(model, AffineModel) else "",
        states=_listed(model.states),
        inputs=_listed(model.input_quantities),
        measurements=_listed(model.measurements),
        inputs_count=model.inputs,
    )
    if not pieces:
        text = text.replace(": m.f(x, u), m.h(x), ", ": ").replace(": m.f(x, u), m.h(x, before), ", ": ")
        text += (
            f"%   f and h are code that cannot be written out: m.f and m.h are yours to add.\n%   Why: {why}.\n"
        )
    lines = [f"m.dt = {dt:.17g};"] if dt else []
    lines += [f"m.Q = {_matrix(model.process_noise_cov)};", f"m.R = {_matrix(model.measurement_noise_cov)};"]
    lines += [f"m.x0 = {_matrix(model.prior_mean[:, None])};", f"m.P0 = {_matrix(model.prior_cov)};", *fields]
    if pieces:
        lines += ["m.f = @transition;", "m.h = @measurement;"]
    text += "\n".join(lines) + "\nif nargin == 0, x = m; return; end\n"
    turns = [j + 1 for j, channel in enumerate(model.measurements) if channel.angle]
    wrap = f"\n    e({turns}) = mod(e({turns}) + pi, 2 * pi) - pi;  % the short way round" if turns else ""
    refused = "error('the step of this filter is not written out');\nend\n"
    return text + (update.replace("{wrap}", wrap) if steps else refused) + pieces


def function_name(*parts: str) -> str:
    """A name that MATLAB takes for a function, made of some parts."""
    words = re.sub(r"\W+", "_", "_".join(parts)).strip("_")[:50]
    return words if words[:1].isalpha() else f"f_{words}"


def _functions(model: StateSpaceModel) -> tuple[str, list[str]]:
    """Functions f and h, and more fields of the struct; ValueError if they cannot be written out."""
    if isinstance(model, AffineModel):
        a, b, offset, c, shift = model.matrices()
        transition = f"y = {_matrix(a)} * x + {_matrix(offset[:, None])}"
        transition += f" + {_matrix(b)} * u(:);" if model.inputs else ";"
        d = model.feedthrough
        read = f"z = {_matrix(c)} * x + {_matrix(shift[:, None])}"
        read += ";" if d is None else f" + {_matrix(d)} * u(:);"
        fields = [f"m.A = {_matrix(a)};", f"m.B = {_matrix(b)};", f"m.C = {_matrix(c)};"]
        fields += [] if d is None else [f"m.D = {_matrix(d)};"]
        return _written(transition, read, model), fields
    x, u = [f"x({i + 1})" for i in range(model.n)], [f"u({i + 1})" for i in range(model.inputs)]
    f = lines_of(model.transition, (x, u), model.constants, model.n)
    h = lines_of(model.observe, (x, *model.shape.fed(u)), model.constants, model.m)
    if max(len(f), len(h)) > LONGEST:
        raise ValueError(f"f and h must have at most {LONGEST} lines, but they have {len(f)} and {len(h)}")
    substep = "\n".join(f"    {line}" for line in (*f[:-1], f"x = {f[-1]};"))
    loop = f"for part = 1:{model.substeps}\n{substep}\nend\ny = x;"
    measurement = "\n".join((*h[:-1], f"z = {h[-1]};"))
    text = _written(loop, measurement, model)
    return text + MATLAB["choose"] * ("choose(" in text), []


def _written(transition: str, measurement: str, model: StateSpaceModel) -> str:
    arguments = "x, u" if model.feeds else "x"
    head = f"\nfunction y = transition(x, u)\n{transition}\nend\n"
    return f"{head}\nfunction z = measurement({arguments})\n{measurement}\nend\n"


def _matrix(values: np.ndarray) -> str:
    values = np.asarray(values, dtype=float)
    if values.shape == (1, 1):
        return f"{values[0, 0]:.17g}"
    if values.ndim == 2 and values.shape[0] == values.shape[1] and not (values - np.diag(values.diagonal())).any():
        return f"diag([{', '.join(f'{value:.17g}' for value in values.diagonal())}])"
    return f"[{'; '.join(', '.join(f'{value:.17g}' for value in row) for row in values)}]"


def _listed(quantities) -> str:
    return ", ".join(quantity.label for quantity in quantities) or "none"


UNSAVED = "TUNED.json"  # a name to be replaced


def lines_section(choice: Choice, problem: Problem, file: str | None) -> Section:
    """Lines that use the tuned filter.

    Args:
        choice: the tuned filter.
        problem: what it was tuned on.
        file: the tuned file; None where the report is of a study, which has none yet.
    """
    name = Path(file).name if file else UNSAVED
    model = problem.model(**choice.model)
    lines = PYTHON["on_log" if isinstance(within(problem), LogProblem) else "on_env"]
    python = lines.format(file=name, problem=_found_by(problem)) + PYTHON["by_hand"]
    noise = {"process_noise_cov": model.process_noise_cov, "measurement_noise_cov": model.measurement_noise_cov}
    entry = {"name": choice.name, "numbers": dict(choice.numbers)}
    entry["model"] = {key: value.tolist() for key, value in noise.items()} | dict(choice.model)
    command = f"`study.save({UNSAVED!r})` or `thruster tune --out {UNSAVED}`"
    remarks = [] if file else [Words([f"{command} writes the tuned file that these lines read."])]
    matlab = matlab_function(choice, model, problem.name, problem.dt)
    return Section(
        "Lines to copy",
        [
            *remarks,
            Code("Python", python),
            Code("JSON: the filter, as in the tuned file", json.dumps(entry, indent=2, default=str)),
            Code("MATLAB or GNU Octave: a function that needs no toolbox", matlab, folded=True),
        ],
    )


def _found_by(problem: Problem) -> str:
    """Lines that load a problem: by its name or, if it is the user's code, from its module."""
    if problem.name in built_in() or problem.name.endswith(".toml"):
        return f"from tuning.problems.find import find_problem\n\nproblem = find_problem({problem.name!r})"
    module, colon, name = problem.name.partition(":")
    if colon and module.replace(".", "").isidentifier() and name.isidentifier():
        statement = f"from {module} import {name}" + ("" if name == "problem" else " as problem")
        return f"{statement}  # if it is a function: problem = problem()\n"
    return "from your_module import problem  # the object that it was tuned on\n"
