"""A page: a filter as a textbook writes it, pure functions of a model and small matrices.

The model has f(x, u), F(x, u), h(x), H(x), Q and R of the equations. If the belief is a mean and a covariance, a
step is

    x, P = add_process_noise(model, *propagate(model, x, P, u)),  propagate once for each of the model's substeps
    x, P, v, S, log N(v; 0, S) = update(model, x, P, z)

Filters that propagate another representation of the belief, such as sigma points X, compute it in `represent`:

    x, P = add_process_noise(model, propagate(model, represent(model, x, P), u))

A filter may keep extras, such as an estimate of R: `initial(model)` returns them as a dictionary at the prior. The
functions read them from `model.extras`; as their last result they may return a dictionary of those that change.

The model that pages of filters get, and the slopes of its equations along a parameter.

A parameter moves the mean by dx and the constants by dc, and so

    df = F dx + f_c dc,   dF = F_x dx + F_c dc

If the model's functions can be traced, all of these follow from their graphs. Otherwise the functions are called:
Jacobians that the model has are used, and all other slopes are central differences.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Mapping
from copy import copy
from functools import cache
from math import prod
from typing import Any, NamedTuple, Self

import numpy as np

from filters.algebra.matrices import Matrix, Operation, input_matrix, never, plus, through
from filters.algebra.points import root
from filters.algebra.roots import zeros
from filters.algebra.tangents import columns_in_tangent, rows_in_tangent, unit
from filters.engine.belief import filter_offset, memory_offsets
from thruster_env.core.angles import NAMES, short_way
from thruster_env.core.derivatives import RELATIVE_STEP, step_growth, step_of
from thruster_env.core.sources import Source, entrywise, is_array, scaled_sum, tuple_of, vector_reader, written_out
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import (
    Functions,
    Shape,
    constants_are_array,
    observation_slopes,
    transition_slopes,
)
from thruster_env.model.traced import not_known, traced_model

ACTING = "acting_input"  # the extra of a model whose h takes the input: that of the last step


class Page(NamedTuple):
    """The functions of a filter, and the parameters that they read from `model.own`."""

    propagate: Callable  # in each of the model's substeps
    add_process_noise: Callable  # at the end of a step
    update: Callable
    represent: Callable | None = None
    initial: Callable | None = None
    own: tuple[tuple[str, tuple[int, ...]], ...] = ()  # parameters and their shapes
    fixed: tuple[tuple[str, Any], ...] = ()  # constants of the program, such as the number of iterations
    rejuvenate: Callable | None = None  # particle filters: after resampling
    lookahead: Callable | None = None  # particle filters that resample in the update: before resampling
    per_particle: tuple[str, ...] = ()  # names of extras that each particle has

    def started(self, model: Any) -> dict[str, Any]:
        """The filter's extras at the prior; no input acts there."""
        acting = {ACTING: zeros(model.Q, model.feed)} if model.feed else {}
        return {**acting, **({} if self.initial is None else self.initial(model))}

    def propagated(self, model: Any, *belief: Any, u: Any) -> tuple:
        """The results of `propagate`, with the extras that change: the input u acts from now on."""
        results = self.propagate(model, *belief, u)
        results = results if isinstance(results, tuple) else (results,)
        if not model.feed:
            return results
        *values, changed = results if isinstance(results[-1], dict) else (*results, {})
        return *values, {**changed, ACTING: u}

    def parameters(self, read: Callable[[int, tuple[int, ...]], Any]) -> Any:
        """`model.own` of pages: `read(offset, shape)` of each parameter, and the fixed values."""
        values = [
            read(at, shape) for at, (_, shape) in zip(self.parameter_offsets(0).values(), self.own, strict=True)
        ]
        names = tuple(name for name, _ in (*self.own, *self.fixed))
        return _own_class(names)(*values, *(value for _, value in self.fixed))

    def parameter_offsets(self, first: int) -> dict[str, int]:
        """The offset of each parameter, if the first has the offset `first`."""
        offsets = {}
        for name, shape in self.own:
            offsets[name], first = first, first + prod(shape)
        return offsets

    @property
    def own_size(self) -> int:
        """Number of floats that the parameters take."""
        return sum(prod(shape) for _, shape in self.own)


@cache
def _own_class(names: tuple[str, ...]) -> type:
    return type("Own", (namedtuple("Own", names),), {"__slots__": (), "__getattr__": _not_a_field})


def _not_a_field(own: Any, name: str) -> Any:
    fields = ", ".join(own._fields) or "none"
    raise AttributeError(f"model.own must be asked for one of the filter's fields ({fields}), not {name!r}")


def acting_places(extras: Mapping[str, Matrix]) -> tuple[int, ...]:
    """Places in a row of the input that acts, if a filter keeps it."""
    if ACTING not in extras:
        return ()
    first = extras[ACTING].operation.at
    return tuple(range(first, first + len(extras[ACTING])))


class NumbersMemory:
    """Matrices read from `numbers`: Q, R, scales, constants, and the filter's parameters.

    Attributes:
        own: parameters, as pages read them.
        kept: the filter's extras, by name.
        end: the first free offset in a filter's row, after the extras.
        constants_slope, size: along a parameter that moves constants, if there are any.
        ratio: the last input as a number, if it is the step ratio.
        belief: places of mean and covariance.
        outputs: places of the innovation, its covariance and its log density.
    """

    def __init__(self, shape: Shape, page: Page, x: Matrix, p: Matrix, first_parameter: int):
        n, m, t = shape.n, shape.m, shape.t
        layout, row = shape.offsets, memory_offsets(n, m, t)
        self.belief = Place("rows", row.mean), Place("rows", row.cov)
        self.outputs = tuple(Place("rows", at) for at in (row.innovation, row.innovation_cov, row.log_likelihood))
        self.shape, self.x, self.P = shape, x, p
        self.Q = self.read("numbers", layout.q, t, t, symmetric=True)
        self.R = self.read("numbers", layout.r, m, m, symmetric=True)
        self.Q_root = self.read("numbers", layout.q_root, t, t)
        self.R_root = self.read("numbers", layout.r_root, m, m)
        self.prior_mean = self.read("numbers", layout.prior_mean, n)
        self.prior_root = self.read("numbers", layout.prior_root, t, t)
        self.scales = self.read("numbers", layout.scales, n)
        # Tensors are found by place: without constants this must not be the place of the filter's first parameter.
        at = layout.constants if shape.constants else layout.substeps
        self.constants = self.read("numbers", at, shape.constants)
        self.own = page.parameters(lambda offset, size: self.read("numbers", first_parameter + offset, *size))
        self.extras: Mapping[str, Matrix] = {}
        self.end = row.extras
        self.constants_slope: Matrix | None = None
        self.ratio: Matrix | None = None
        self.size: Matrix | None = None

    def ratio_in(self, array: str, inputs: int) -> Matrix | None:
        """The last of the inputs, which begin at offset `inputs` of an array, if it is the step ratio."""
        return self.read(array, inputs + self.shape.inputs - 1) if self.shape.step_ratio else None

    def read(self, array: str, first: int, *shape: int, symmetric: bool = False) -> Matrix:
        """A matrix stored in an array from the offset `first` on."""
        return input_matrix(Place(array, first), shape, symmetric=symmetric, like=self.x)

    def keep(self, started: Mapping[str, Any]) -> Mapping[str, Matrix]:
        """Lay out the extras of a filter in its row, and return them as matrices read from there."""
        self.extras = {name: self.another(value, symmetric=value.symmetric) for name, value in started.items()}
        return self.extras

    def another(self, like: Matrix, *, symmetric: bool = False) -> Matrix:
        """A matrix of the same shape at the first free offset of the row."""
        matrix = self.read("rows", self.end, *like.shape, symmetric=symmetric)
        self.end += prod(like.shape)
        return matrix


class RowMemory(NumbersMemory):
    """The memory of a filter that runs.

    rows     the row of `filters.engine.belief`, with the filter's extras, then scratch
    given    u or z
    numbers  the model's, then the filter's own
    """

    def __init__(self, shape: Shape, page: Page):
        """Take the sizes. Extras and other representations of the belief are laid out once they are known."""
        row = memory_offsets(shape.n, shape.m, shape.t)
        x = input_matrix(Place("rows", row.mean), (shape.n,))
        p = input_matrix(Place("rows", row.cov), (shape.t, shape.t), symmetric=True, like=x)
        super().__init__(shape, page, x, p, filter_offset(shape))
        self.u, self.z = self.read("given", 0, shape.inputs), self.read("given", 0, shape.channels)
        self.ratio = self.ratio_in("given", 0)


@cache
def called_parts(functions: Functions, shape: Shape, which: str, constants_move: bool) -> tuple[Callable, ...]:
    """An equation y(x, ..., c), its Jacobian Y(x, scales, ..., c), and the slopes of both.

        y_c dc = [y(c + h dc) - y(c - h dc)]/2h
        dY = [Y(x + h dx, c + h dc) - Y(x - h dx, c - h dc)]/2h

    y_c dc is a function of (x, scales, ..., c, dc, size), where size is the relative size of dc, and dY one of (x,
    scales, ..., c, dx, dc, size), without the last two if constants do not move. Far from zero steps grow with
    `step_growth`, because values are rounded more coarsely. If constants do not move, a large Jacobian F is
    differentiated by each component of x, because there are fewer components than directions: then two more
    functions follow, the derivative (columns, rows, columns) and its contraction with dx.

    Args:
        functions: of the model.
        shape: its sizes.
        which: "motion" for f, or "sight" for h.
        constants_move: whether parameters move its constants.
    """
    if which == "motion":
        value, matrix = functions.transition, transition_slopes(functions, shape)
        rows, angles, inputs = shape.n, shape.state_angles, "u, c"
    else:
        value, matrix = functions.observe, observation_slopes(functions, shape)
        rows, angles, inputs = shape.channels, shape.measurement_angles, shape.observe_arguments
    by_constants = _by_constants(value, rows, shape, angles, inputs)
    size = rows, shape.n
    entry = "(a[{0}][{1}] - b[{0}][{1}]) / (2.0 * h)"
    difference = entrywise("difference", "a, b, h", size, lambda i, j: entry.format(i, j), a=size, b=size)
    parts = value, matrix, by_constants, slope_of(matrix, difference, shape, inputs, constants_move)
    large = is_array(rows, shape.n) and which == "motion" and not constants_move
    return (*parts, _curvature(matrix, rows, shape.n, inputs), _contraction(rows, shape.n)) if large else parts


def _by_constants(value: Callable, rows: int, shape: Shape, angles: tuple[bool, ...], inputs: str) -> Callable:
    sides = [inputs.replace("c", f"shift(c, {sign}h, dc)") for sign in ("", "-")]
    lines = (
        f"h = {RELATIVE_STEP} * step_growth(x, scales) / max(size, 1e-300)",
        f"above, below = {', '.join(f'value(x, {side})' for side in sides)}",
        "difference(above, below, h)",
    )
    names: dict[str, Any] = {
        "value": value,
        "shift": _constants_shift(shape),
        "difference": difference_of_values(rows, angles),
        "step_growth": step_growth(shape.n),
    }
    return written_out("by_constants", f"x, scales, {inputs}, dc, size", *lines, **names)


def difference_of_values(rows: int, angles: tuple[bool, ...]) -> Callable:
    """`difference(above, below, h)`: (above - below)/2h, where differences of angles are in (-pi, pi]."""
    source = Source("difference", "above, below, h", result=(rows,), above=(rows,), below=(rows,))
    entries = source.vector(rows, lambda i: short_way(f"(above[{i}] - below[{i}])", i, angles) + " / (2.0 * h)")
    return source.function(entries, **NAMES)


def slope_of(
    function: Callable, difference: Callable, shape: Shape, inputs: str, constants_move: bool
) -> Callable:
    """`slope(x, scales, ..., c, dx)` of a function (x, scales, ..., c); with dc and its size if constants move."""
    sides = [
        (sign, inputs.replace("c", f"shift(c, {sign}h, dc)") if constants_move else inputs) for sign in ("", "-")
    ]
    calls = (f"function(move(x, {sign}h, dx), scales, {side})" for sign, side in sides)
    lines = (
        f"h = step(x, scales, dx, {'size' if constants_move else '0.0'})",
        f"above, below = {', '.join(calls)}",
        "difference(above, below, h)",
    )
    names: dict[str, Any] = {
        "function": function,
        "step": _step(shape.n),
        "move": scaled_sum(shape.n),
        "shift": _constants_shift(shape),
        "difference": difference,
    }
    return written_out("slope", f"x, scales, {inputs}, dx" + ", dc, size" * constants_move, *lines, **names)


@cache
def _step(count: int) -> Callable:
    """Return `step(x, scales, d, size)`: the step h along d, and along a relative change of constants."""
    source = Source("step", "x, scales, d, size", x=(count,), scales=(count,), d=(count,))
    source.line("far = step_growth(x, scales)")
    source.line("h = max(1e-300, size / far)")
    for i in source.range(count):
        source.line(f"h = max(h, {RELATIVE_STEP} * abs(d[{i}]) / step_of(x[{i}], scales[{i}], far))")
    return source.function(f"{RELATIVE_STEP} / h", step_of=step_of, step_growth=step_growth(count))


@cache
def _constants_shift(shape: Shape) -> Callable:
    """Return `shift(c, h, dc)`: the constants c + h dc, as the model's functions take them."""
    if constants_are_array(shape.form):
        return written_out("shift", "c, h, dc", "c + h * dc")
    values = [f"c[{i}] + h * dc[{i}]" for i in range(shape.constants)]
    if isinstance(shape.form, int):
        return written_out("shift", "c, h, dc", tuple_of(values))
    return written_out("shift", "c, h, dc", f"Constants({', '.join(values)})", Constants=shape.form)


def _curvature(matrix: Callable, rows: int, columns: int, inputs: str) -> Callable:
    """`curved(x, scales, ..., c)`: a Jacobian's derivative by each component of x, (columns, rows, columns)."""
    lines = (
        f"out, unit = np.empty(({columns}, {rows}, {columns})), np.zeros({columns})",
        "far = step_growth(x, scales)",
        f"for k in range({columns}):",
        "    unit[k] = 1.0",
        "    h = step_of(x[k], scales[k], far)",
        "    d = read(unit)",
        f"    above = matrix(move(x, h, d), scales, {inputs})",
        f"    below = matrix(move(x, -h, d), scales, {inputs})",
        f"    for i in range({rows}):",
        f"        for j in range({columns}):",
        "            out[k, i, j] = (above[i, j] - below[i, j]) / (2.0 * h)",
        "    unit[k] = 0.0",
        "out",
    )
    names: dict[str, Any] = {"matrix": matrix, "move": scaled_sum(columns), "read": vector_reader(columns)}
    names |= {"np": np, "step_of": step_of, "step_growth": step_growth(columns)}
    return written_out("curved", f"x, scales, {inputs}", *lines, **names)


def _contraction(rows: int, columns: int) -> Callable:
    """`slope(curvature, dx)`: a Jacobian's derivative along dx, from its derivatives by each component of x."""
    lines = (
        f"out = np.zeros(({rows}, {columns}))",
        f"for k in range({columns}):",
        f"    for i in range({rows}):",
        f"        for j in range({columns}):",
        "            out[i, j] += dx[k] * curvature[k, i, j]",
        "out",
    )
    return written_out("slope", "curvature, dx", *lines, np=np)


@cache
def called_at_points(
    functions: Functions, shape: Shape, which: str, constants_move: bool, points: int
) -> tuple[Callable, Callable]:
    """An equation Y(X, ..., c) of points X (n, points), and its slope dY(X, scales, ..., c, dX), by columns.

        dy = [y(x + h dx, c + h dc) - y(x - h dx, c - h dc)]/2h

    If parameters move constants, the slope takes (X, scales, ..., c, dX, dc, size). Other arguments are those of
    `called_parts`.
    """
    if which == "motion":
        value, rows, angles, inputs = functions.transition, shape.n, shape.state_angles, "u, c"
    else:
        value, rows, inputs = functions.observe, shape.channels, shape.observe_arguments
        angles = shape.measurement_angles
    plain = written_out("plain", f"x, scales, {inputs}", f"value(x, {inputs})", value=value)
    slope = slope_of(plain, difference_of_values(rows, angles), shape, inputs, constants_move)
    behind = ", dc, size" if constants_move else ""
    size = shape.n, points
    return (
        _by_columns(value, f"x, {inputs}", rows, x=size),
        _by_columns(slope, f"x, scales, {inputs}, dx{behind}", rows, x=size, dx=size),
    )


def _by_columns(function: Callable, arguments: str, rows: int, **matrices: Any) -> Callable:
    """A function of vectors, with results (rows,), applied to each column of matrices: (rows, points)."""
    n, points = matrices["x"]
    source = Source("by_columns", arguments, result=(rows, points), **matrices)
    out = source.local("out", rows, points)
    for j in source.range(points):
        columns = {
            name: f"column({source.array_of(name)}, {j})"
            if source.loops
            else tuple_of(f"{name}[{i}][{j}]" for i in range(n))
            for name in matrices
        }
        operands = (columns.get(name, name) for name in arguments.split(", "))
        source.line(f"y = function({', '.join(operands)})")
        if source.loops:
            source.line(f"store(out, {j}, y)")
        else:
            source.line(f"{tuple_of(out[i, j] for i in range(rows))} = y")
    store = Source("store", "out, j, y", y=(rows,))
    for i in store.range(rows):
        store.line(f"out[{i}, j] = y[{i}]")
    column = entrywise("column", "x, j", (n,), lambda i: f"x[{i}, j]")
    return source.function(source.all_entries(out), function=function, column=column, store=store.function())


class PagedModel:
    """Attributes of the model that pages get, besides its equations f, F, h and H.

    Attributes:
        Q, R: its covariances; Q of a model with a step ratio is that of the step's length.
        Q_root, R_root, prior_root: lower triangular roots of Q, R and the prior covariance.
        prior_mean: of the state.
        own: the filter's parameters.
        extras: what the filter keeps besides mean and covariance, by name.
        feed: number of inputs that h takes, all or none.
        state_angles, measurement_angles: flags of components that are angles.
        turns, measured_turns: rotations among the states, and among the measurements.
    """

    def __init__(self, memory: NumbersMemory):
        shape, self._constants = memory.shape, memory.constants
        self.feed = shape.feed
        self.state_angles, self.measurement_angles = shape.state_angles, shape.measurement_angles
        self.turns, self.measured_turns = shape.turns, shape.measured_turns
        self.Q, self.R, self.Q_root, self.R_root = memory.Q, memory.R, memory.Q_root, memory.R_root
        if shape.step_ratio and memory.ratio is not None:
            self.Q = memory.Q * memory.ratio
            self.Q_root = root(self.Q)
        self.prior_mean, self.prior_root = memory.prior_mean, memory.prior_root
        self.own, self.extras = memory.own, memory.extras

    def at(self, constants: Matrix) -> Self:
        """The same model with other constants."""
        other = copy(self)
        other._constants = constants
        return other

    def at_measurement(self, z: Matrix) -> tuple[Self, Matrix]:
        """Model and measurement z in the tangent at z: see `filters.algebra.tangents.about`."""
        return self, z

    def _seen(self) -> tuple[Matrix, ...]:
        """The arguments of h besides x: the input that acts, if it takes that, and the constants."""
        return (self.extras[ACTING], self._constants) if self.feed else (self._constants,)


class Equations(PagedModel):
    """A model whose functions take Matrices.

    Attributes:
        called: the functions that evaluate the model's operations, if these are calls.
    """

    def __init__(
        self,
        functions: Functions,
        memory: NumbersMemory,
        *,
        constants_move: bool,
        trace: bool,
        partly: bool = False,
    ):
        """Take the model's functions, the matrices of its numbers, and whether parameters move its constants.

        The functions are traced if `trace`, otherwise called. A function that cannot be traced raises TypeError:
        here, or with `partly` only if a matrix that depends on it is evaluated.
        """
        shape = memory.shape
        super().__init__(memory)
        self._scales = memory.scales
        self._moves = (memory.constants_slope, memory.size) if constants_move and shape.constants else ()
        self.called: dict[Operation, Callable] = {}
        chosen = functions, shape
        parts: list[tuple[Callable, ...]]
        if trace:
            traced = traced_model(functions, shape, partly)
            parts = [function.parts for function in traced]
            self._parts_at_points: Callable = lambda which, points: traced[which == "sight"].of_points
        else:
            parts = [called_parts(*chosen, which, bool(self._moves)) for which in ("motion", "sight")]
            self._parts_at_points = lambda which, points: called_at_points(
                *chosen, which, bool(self._moves), points
            )
        self._f, self._F = self._operations("f", parts[0], shape.n, shape.n, trace)
        self._h, self._H = self._operations("h", parts[1], shape.channels, shape.n, trace)
        self._traced, self._rows = trace, {"motion": shape.n, "sight": shape.channels}
        self._of_points: dict[tuple[str, int], Operation] = {}

    def f(self, x: Matrix, u: Matrix) -> Matrix:
        """The state, a substep after x; of points (n, points) that of each."""
        f = self._f if len(x.shape) == 1 else self._at_points("motion", x)
        return unit(f(x, u, self._constants), self.turns)

    def F(self, x: Matrix, u: Matrix) -> Matrix:  # noqa: N802
        """df/dx, of a state with rotations in the tangents at x and f(x, u), (t, t)."""
        F = self._F(x, self._scales, u, self._constants)
        if not self.turns:
            return F
        return rows_in_tangent(columns_in_tangent(F, x, self.turns), self._f(x, u, self._constants), self.turns)

    def h(self, x: Matrix) -> Matrix:
        """What is measured at x; of points (n, points) at each."""
        return (self._h if len(x.shape) == 1 else self._at_points("sight", x))(x, *self._seen())

    def H(self, x: Matrix) -> Matrix:  # noqa: N802
        """dh/dx, of a state with rotations in the tangent at x, (channels, t)."""
        return columns_in_tangent(self._H(x, self._scales, *self._seen()), x, self.turns)

    def _operations(
        self, name: str, parts: tuple[Callable, ...], rows: int, n: int, trace: bool
    ) -> tuple[Operation, Operation]:
        """An equation (x, ..., c) and its Jacobian (x, scales, ..., c); their derivatives are operations, too."""
        shapes = (rows,), (rows, n), (rows,), (rows, n), (n, rows, n), (rows, n)
        operations = [
            Operation(part if trace else not_known, lambda *_, shape=shape: shape, never)
            for part, shape in zip(parts, shapes, strict=False)
        ]
        value, matrix, by_constants, slope, *curved = operations
        value.name, matrix.name = name, name.upper()
        by_constants.name, slope.name = f"{name}_c", f"d{name.upper()}"
        if not trace:
            self.called |= dict(zip(operations, parts, strict=True))

        @value.derivative
        def of_value(result, arguments, slopes):
            x, *inputs = arguments
            along_x = through(lambda dx: matrix(x, self._scales, *inputs) @ dx, slopes[0])
            return plus(along_x, by_constants(x, self._scales, *inputs, *self._moves) if self._moves else None)

        @matrix.derivative
        def of_matrix(result, arguments, slopes):
            if curved:
                curvature, contraction = curved
                return contraction(curvature(*arguments), slopes[0])
            return slope(*arguments, slopes[0], *self._moves)

        return value, matrix

    def _at_points(self, which: str, x: Matrix) -> Operation:
        """An equation (X, ..., c) of each column of X; its slope (X, scales, ..., c, dX) is an operation, too."""
        key = which, x.shape[1]
        if key in self._of_points:
            return self._of_points[key]
        parts, rows = self._parts_at_points(*key), self._rows[which]
        value, slope = (
            Operation(part if self._traced else not_known, lambda x, *_: (rows, x[1]), never) for part in parts
        )
        value.name, slope.name = f"{which}_of_points", f"d_{which}_of_points"
        self._of_points[key] = value
        if not self._traced:
            self.called |= {value: parts[0], slope: parts[1]}

        @value.derivative
        def of_value(result, arguments, slopes):
            x, *inputs = arguments
            return slope(x, self._scales, *inputs, slopes[0], *self._moves)

        return value
