"""A tuned filter as a MATLAB function: its model, Q, R and, where it is an extended Kalman filter, its step.

The code runs in MATLAB and in GNU Octave without a toolbox. The functions f and h take columns, as
`extendedKalmanFilter` and `unscentedKalmanFilter` of MATLAB's toolboxes want them.

It accepts functions made of + - * / // % abs ** min max and the elementary functions of `math` and numpy, and
their callees. A function that branches on a value cannot be traced.
"""

from __future__ import annotations

import builtins
import linecache
import math
import re
import types
from collections.abc import Callable, Sequence
from functools import partial, reduce
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.core.user_functions import needs_floats
from thruster_env.model.affine import AffineModel
from thruster_env.model.state_space import StateSpaceModel
from tuning.search.space import Choice

# Symbols that stand for numbers, and the functions of `math` and numpy on them, as MATLAB writes them.


ONE = {  # functions of one number: names in `math` and numpy, and what MATLAB has for them
    **{name: f"{name}({{}})" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "expm1", "log1p")},
    **{name: f"{name}({{}})" for name in ("log2", "log10", "sqrt", "floor", "ceil", "sign", "erf", "erfc")},
    **{f"arc{name}": f"a{name}({{}})" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{f"a{name}": f"a{name}({{}})" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "log": "log({})",
    "gamma": "gamma({})",
    "abs": "abs({})",
    "absolute": "abs({})",
    "fabs": "abs({})",
    "trunc": "fix({})",
    "fix": "fix({})",
    "cbrt": "nthroot({}, 3)",
    "exp2": "2 ^ {}",
    "square": "{0} * {0}",
    "reciprocal": "1 / {}",
    "lgamma": "gammaln({})",
    **{name: "{} * pi / 180" for name in ("radians", "deg2rad")},
    **{name: "{} * 180 / pi" for name in ("degrees", "rad2deg")},
}
TWO = {  # of two
    **{name: "atan2({}, {})" for name in ("atan2", "arctan2")},
    **{name: "{} ^ {}" for name in ("pow", "power")},
    **{name: "min({}, {})" for name in ("minimum", "fmin")},
    **{name: "max({}, {})" for name in ("maximum", "fmax")},
    "hypot": "hypot({}, {})",
    "fmod": "rem({}, {})",
    "remainder": "{0} - {1} * round({0} / {1})",  # that of `math`; numpy's is `mod`
    "mod": "mod({}, {})",
    "copysign": "abs({0}) * (2 * ({1} >= 0) - 1)",
}
MODULES = (math, np)


class Branch(TypeError):
    """A symbol is asked for its value."""


class Tape:
    """Operations in their order, none of them twice."""

    def __init__(self):
        """Nothing is on it yet."""
        self._places: dict[str, str] = {}
        self._used: dict[str, tuple[str, ...]] = {}

    def note(self, expression: str, *parts: str) -> Symbol:
        """The symbol of an operation on some parts."""
        name = self._places.setdefault(expression, f"t{len(self._places) + 1}")
        self._used[name] = parts
        return Symbol(self, name)

    def lines(self, results: Sequence[str]) -> list[tuple[str, str]]:
        """Names and expressions of what some results need, in the order of computing."""
        needed, rest = set(), list(results)
        while rest:
            name = rest.pop()
            if name in self._used and name not in needed:
                needed.add(name)
                rest += self._used[name]
        return [(name, expression) for expression, name in self._places.items() if name in needed]


def _both(form: str) -> tuple[Callable, Callable]:
    """An operator with a symbol on its left, and with one on its right."""

    def note(tape: Tape, first: Any, second: Any) -> Symbol:
        a, b = text(first), text(second)
        return tape.note(form.format(a, b), a, b)

    return lambda self, other: note(self.tape, self, other), lambda self, other: note(self.tape, other, self)


def _compared(self, other: Any) -> bool:
    """Nobody knows."""
    raise Branch("compares a value")


class Symbol:
    """What stands for a number."""

    __hash__ = None  # type: ignore[assignment]  # equality is not known either

    def __init__(self, tape: Tape, name: str):
        """A symbol of a name on a tape."""
        self.tape, self.name = tape, name

    __add__, __radd__ = _both("{} + {}")
    __sub__, __rsub__ = _both("{} - {}")
    __mul__, __rmul__ = _both("{} * {}")
    __truediv__, __rtruediv__ = _both("{} / {}")
    __pow__, __rpow__ = _both("{} ^ {}")
    __mod__, __rmod__ = _both("mod({}, {})")  # of the sign of the divisor, as Python's
    __floordiv__, __rfloordiv__ = _both("floor({} / {})")
    __lt__ = __le__ = __gt__ = __ge__ = __eq__ = __ne__ = _compared

    def __neg__(self) -> Symbol:
        """Minus a symbol."""
        return self.tape.note(f"-{self.name}", self.name)

    def __pos__(self) -> Symbol:
        """The symbol itself."""
        return self

    def __abs__(self) -> Symbol:
        """Absolute value of a symbol."""
        return self.tape.note(f"abs({self.name})", self.name)

    def __bool__(self) -> bool:
        """Nobody knows."""
        raise Branch("asks whether a value is true")

    def __getattr__(self, name: str) -> Callable:
        """What numpy's functions call on objects."""
        if name not in ONE and name not in TWO:
            raise AttributeError(name)
        return partial(applied, name, self)


def text(value: Any) -> str:
    """A symbol's name, or a number as it is written in a product."""
    if isinstance(value, Symbol):
        return value.name
    number = float(value)
    return f"{number:.17g}" if number >= 0 else f"({number:.17g})"


def applied(name: str, *arguments: Any) -> Symbol:
    """A function of `ONE` or `TWO` on what are not all numbers."""
    form, count = (ONE[name], 1) if name in ONE and len(arguments) == 1 else (TWO.get(name, ""), 2)
    if not form or len(arguments) != count:
        raise TypeError(f"calls {name} with {len(arguments)} values")
    parts = [text(argument) for argument in arguments]
    tape = next(argument.tape for argument in arguments if isinstance(argument, Symbol))
    return tape.note(form.format(*parts), *parts)


def _stands_in(name: str, function: Callable) -> Callable:
    """A function of numbers that also takes symbols."""

    def call(*arguments: Any) -> Any:
        if not any(isinstance(argument, Symbol) for argument in arguments):
            return function(*arguments)
        if name == "log" and len(arguments) == 2:
            return applied("log", arguments[0]) / call(arguments[1])
        if name == "clip":
            return applied("minimum", applied("maximum", arguments[0], arguments[1]), arguments[2])
        return applied(name, *arguments)

    return call


def _least(name: str, function: Callable) -> Callable:
    """`min` or `max` of any numbers, or of a sequence, also of symbols."""

    def call(*arguments: Any) -> Any:
        operands = tuple(arguments[0]) if len(arguments) == 1 else arguments
        if not any(isinstance(operand, Symbol) for operand in operands):
            return function(operands)
        return reduce(lambda a, b: _stands_in(name, function)(a, b), operands)

    return call


class _Module:
    """A module whose elementary functions take symbols."""

    def __init__(self, module: types.ModuleType):
        """Take the module."""
        self._module = module

    def __getattr__(self, name: str) -> Any:
        """A function that takes symbols if there is one, otherwise the module's."""
        return on_symbols(getattr(self._module, name))


def on_symbols(value: Any) -> Any:
    """What stands in for a value of a function's surroundings while it is run on symbols; else the value."""
    if any(value is module for module in MODULES):
        return _Module(value)
    if value is builtins.min or value is builtins.max:
        return _least("minimum" if value is builtins.min else "maximum", value)
    name = "mod" if value is np.remainder else getattr(value, "__name__", "")
    if callable(value) and (name in ONE or name in TWO or name == "clip"):
        if any(getattr(module, name, None) is value for module in MODULES):
            return _stands_in(name, value)
    return value


# A function of a model as lines of another language, obtained by running it on symbols.


OWN = (__file__, __file__)


def traced(function: Callable, arguments: Sequence[Sequence[str]], constants: Any) -> list[str]:
    """Lines "t1 = a + b;" of a function and, last, "[t7; t9]", its results.

    Args:
        function: of a model, which takes tuples of components and the constants last.
        arguments: names of the components of each tuple.
        constants: of the model.

    Raises:
        ValueError: in one line, with that of the function, where it cannot be traced.
    """
    rule = "a function to be written out must be made of operators and elementary functions, but"
    if reason := needs_floats(function):
        raise ValueError(f"{rule} {reason}")
    tape = Tape()
    try:
        run = _rebound(function, {})
        outputs = run(*(tuple(Symbol(tape, name) for name in names) for names in arguments), constants)
        results = [text(output) for output in outputs]
    except (TypeError, AttributeError, ValueError, ArithmeticError, LookupError) as error:
        what = str(error) if isinstance(error, Branch) else f"cannot be run on symbols ({_first_line(error)})"
        raise ValueError(f"{rule} {_place(error, function)} {what}") from None
    return [*(f"{name} = {expression};" for name, expression in tape.lines(results)), f"[{'; '.join(results)}]"]


def _rebound(value: Any, rebound: dict[int, Any]) -> Any:
    """A function with what it calls by name, and the functions in its closure, put on symbols; else the value."""
    if not isinstance(value, types.FunctionType):
        return on_symbols(value)
    if id(value) in rebound:
        return rebound[id(value)]
    code, names = value.__code__, dict(value.__globals__)
    cells = None if value.__closure__ is None else tuple(types.CellType() for _ in value.__closure__)
    other = types.FunctionType(code, names, value.__name__, value.__defaults__, cells)
    other.__kwdefaults__ = value.__kwdefaults__
    rebound[id(value)] = other
    for name in _names(code):
        if name in names:
            names[name] = _rebound(names[name], rebound)
        elif hasattr(builtins, name):
            names[name] = on_symbols(getattr(builtins, name))
    for cell, before in zip(cells or (), value.__closure__ or (), strict=True):
        try:
            cell.cell_contents = _rebound(before.cell_contents, rebound)
        except ValueError:  # an empty one
            continue
    return other


def _names(code: types.CodeType) -> set[str]:
    inner = [_names(constant) for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return set(code.co_names).union(*inner)


def _place(error: BaseException, function: Callable) -> str:
    """The last line of the user's that an error came through."""
    innermost, at = None, error.__traceback__
    while at is not None:
        if at.tb_frame.f_code.co_filename not in OWN:
            innermost = at
        at = at.tb_next
    if innermost is None:
        return getattr(function, "__name__", "a function")
    file = innermost.tb_frame.f_code.co_filename
    line = linecache.getline(file, innermost.tb_lineno).strip()
    return f"{Path(file).name}, line {innermost.tb_lineno},{f' {line!r},' if line else ''}"


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


STEPPED = ("kf", "ekf")  # of which there is a step
LONGEST = 1500  # lines of f or h
HEAD = """function [x, P, e, S] = {name}(x, P, z, u)
%{shout}  The {filter} filter tuned on {problem}, model, Q and R included.
%   m = {name}() gives the model: m.f(x, u), m.h(x), m.Q, m.R, m.x0, m.P0{more}.
%   Covariances are per step and do not scale with dt.
%   States: {states}
%   Inputs: {inputs}
%   Measurements: {measurements}
"""
STEP = """%   [x, P, e, S] = {name}(x, P, z, u) updates with what was measured (NaN: missing), z, which gives the
%   estimate that x and P hold after it, the innovation e and its covariance S, and where u is given it then
%   predicts over one step. Begin with x = m.x0, P = m.P0.
%
%   m = {name}(); x = m.x0; P = m.P0;
%   for k = 1:size(z, 2)
%       [x, P, e, S] = {name}(x, P, z(:, k));
%       estimate(:, k) = x;
%       if k < size(z, 2), [x, P] = {name}(x, P, [], u(:, k)); end
%   end
"""
TOOLBOX = """%   With MATLAB's toolboxes, here as an unscented Kalman filter:
%   o = unscentedKalmanFilter(m.f, m.h, m.x0, 'StateCovariance', m.P0, ...
%       'ProcessNoise', m.Q, 'MeasurementNoise', m.R);
%   for k = 1:size(z, 2), estimate(:, k) = correct(o, z(:, k)); predict(o, u(:, k)); end
"""
UPDATE = """
e = []; S = [];
if ~isempty(z)
    there = ~isnan(z(:));
    e = z(:) - m.h(x);{wrap}
    H = slopes(m.h, x);
    S = H * P * H' + m.R;
    S = (S + S') / 2;
    if any(there)
        K = P * H(there, :)' / S(there, there);
        x = x + K * e(there);
        I = eye(numel(x)) - K * H(there, :);
        P = I * P * I' + K * m.R(there, there) * K';
    end
end
if nargin > 3
    F = slopes(@(y) m.f(y, u), x);
    x = m.f(x, u);
    P = F * P * F' + m.Q;
    P = (P + P') / 2;
end
end

function J = slopes(g, x)  % central differences
J = zeros(numel(g(x)), numel(x));
for j = 1:numel(x)
    d = zeros(numel(x), 1);
    d(j) = 1e-6 * max(1, abs(x(j)));
    J(:, j) = (g(x + d) - g(x - d)) / (2 * d(j));
end
end
"""


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
    head = HEAD + (STEP if steps else TOOLBOX if pieces else "")
    text = head.format(
        name=name,
        shout=name.upper(),
        filter=choice.name,
        problem=problem,
        more=", m.A, m.B, m.C" if isinstance(model, AffineModel) else "",
        states=_listed(model.states),
        inputs=_listed(model.input_quantities),
        measurements=_listed(model.measurements),
    )
    if not pieces:
        text = text.replace(": m.f(x, u), m.h(x), ", ": ")
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
    return (
        text
        + (
            UPDATE.replace("{wrap}", wrap)
            if steps
            else "error('the step of this filter is not written out');\nend\n"
        )
        + pieces
    )


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
        read = f"z = {_matrix(c)} * x + {_matrix(shift[:, None])};"
        fields = [f"m.A = {_matrix(a)};", f"m.B = {_matrix(b)};", f"m.C = {_matrix(c)};"]
        return (
            f"\nfunction y = transition(x, u)\n{transition}\nend\n\nfunction z = measurement(x)\n{read}\nend\n",
            fields,
        )
    x, u = [f"x({i + 1})" for i in range(model.n)], [f"u({i + 1})" for i in range(model.inputs)]
    f = traced(model.transition, (x, u), model.given_constants)
    h = traced(model.observe, (x,), model.given_constants)
    if max(len(f), len(h)) > LONGEST:
        raise ValueError(f"f and h must have at most {LONGEST} lines, but they have {len(f)} and {len(h)}")
    substep = "\n".join(f"    {line}" for line in (*f[:-1], f"x = {f[-1]};"))
    loop = f"for part = 1:{model.substeps}\n{substep}\nend\ny = x;"
    measurement = "\n".join((*h[:-1], f"z = {h[-1]};"))
    return f"\nfunction y = transition(x, u)\n{loop}\nend\n\nfunction z = measurement(x)\n{measurement}\nend\n", []


def _matrix(values: np.ndarray) -> str:
    """A matrix as MATLAB writes it."""
    values = np.asarray(values, dtype=float)
    if values.shape == (1, 1):
        return f"{values[0, 0]:.17g}"
    if values.ndim == 2 and values.shape[0] == values.shape[1] and not (values - np.diag(values.diagonal())).any():
        return f"diag([{', '.join(f'{value:.17g}' for value in values.diagonal())}])"
    return f"[{'; '.join(', '.join(f'{value:.17g}' for value in row) for row in values)}]"


def _listed(quantities) -> str:
    return ", ".join(quantity.label for quantity in quantities) or "none"
