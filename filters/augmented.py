"""Models with other states: unknown constants as states, a larger model's states, and unbounded states.

In order: `augmented_model` makes constants of a model states, for joint estimation of state and parameters;
`embedded_model` adds states that stay constant and take part in nothing; `transformed_model` replaces states with
bounds by their logarithms or logits, which have none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.angles import NAMES, short_way
from thruster_env.core.checks import finite, positive
from thruster_env.core.compiled import as_function, as_made
from thruster_env.core.derivatives import step_growth, step_of
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import (
    Source,
    as_value,
    assembled,
    entrywise,
    is_array,
    joiner,
    matrix_of,
    tuple_of,
    vector_part,
    written_out,
)
from thruster_env.model.affine import AffineModel, affine_model
from thruster_env.model.quantities import Bound, Output, Quantity, checked_bounds
from thruster_env.model.shape import constants_are_array
from thruster_env.model.state_space import StateSpaceModel


class Unknown(NamedTuple):
    """Prior of an unknown constant of a model; all in the constant's own unit.

    Attributes:
        std: standard deviation of the prior.
        walk_std: standard deviation of its change per step (random walk); 0 for a constant. It does not scale with
            dt.
        mean: of the prior; the model's value if None.
        unit: of the constant, for tables and figures.
    """

    std: float
    walk_std: float = 0.0
    mean: float | None = None
    unit: str = ""

    @classmethod
    def of_numbers(cls, std: float, walk_std: float = 0.0, mean: float | None = None) -> Unknown:
        """A prior of numbers alone, in their order; TypeError if there are more."""
        return cls(std, walk_std, mean)


def augmented_model(model: StateSpaceModel, parameters: Mapping[str | int, Unknown]) -> StateSpaceModel:
    """Make a model whose states include some constants of another model, so that any filter can estimate them.

        (x, theta)' = (f(x, u, c with theta), theta) + (w, walk),  z = h(x, c with theta) + v

    theta are the unknown constants, with a random walk of standard deviation `walk_std` per step. Jacobians are
    the model's own for its states, where it has them, and central differences for the new ones.

    Args:
        model: n states; its constants are a NamedTuple, or a tuple.
        parameters: the prior of each unknown constant, by its name in the NamedTuple, or its index in the tuple;
            the new states have this order.

    Returns:
        A model of n + len(parameters) states with the same inputs, measurements and outputs.

    Raises:
        ValueError: if a name is not one of the model's constants, or a standard deviation is not positive.

    Source: Kopp, Orford (1963), "Linear regression applied to system identification for adaptive control systems",
    AIAA Journal 1(10).
    """
    fields = getattr(model.constants, "_fields", range(len(model.constants)))
    positions, means, variances, walks = [], [], [], []
    for name, unknown in parameters.items():
        if name not in fields:
            known = ", ".join(map(str, fields))
            raise ValueError(f"a parameter must be one of the model's constants {known}, but got {name!r}")
        unknown = Unknown(*unknown)
        position = list(fields).index(name)
        mean = model.constants[position] if unknown.mean is None else unknown.mean
        positions.append(position)
        means.append(finite(f"mean of {name}", mean))
        variances.append(positive(f"std of {name}", unknown.std) ** 2)
        walks.append(positive(f"walk_std of {name}", unknown.walk_std, zero_allowed=True) ** 2)
    if not positions:
        raise ValueError("parameters must name at least one constant, but got none")
    functions: dict[str, Any] = _augmented_functions(*model.functions, model.shape, tuple(positions))
    spread = np.sqrt(np.add(variances, walks))
    further: dict[str, Any] = {
        "operating_state": means,
        "state_low": np.subtract(means, 2.0 * spread),
        "state_high": np.add(means, 2.0 * spread),
    }
    original = {name: getattr(model, name) for name in further}
    helpful: dict[str, Any] = {
        name: None if value is None else np.append(value, further[name]) for name, value in original.items()
    }
    further_states = [Quantity(str(name), str(name), Unknown(*prior).unit) for name, prior in parameters.items()]
    return StateSpaceModel(
        **functions,
        process_noise_cov=_block_diagonal(model.process_noise_cov, walks),
        measurement_noise_cov=model.measurement_noise_cov,
        prior_mean=np.append(model.prior_mean, means),
        prior_cov=_block_diagonal(model.prior_cov, variances),
        inputs=model.inputs,
        constants=(*map(float, model.constants), *map(float, spread)),
        substeps=model.substeps,
        operating_input=model.operating_input,
        bounds=model.bounds,
        bounded_by=model.bounded_by,
        states=(*model.states, *further_states),
        input_quantities=model.input_quantities,
        measurements=model.measurements,
        outputs={
            symbol: Output(output.quantity, partial(_output, output.function, model.shape, tuple(positions)))
            for symbol, output in model.outputs.items()
        },
        **helpful,
    )


def _output(function: Callable, shape, positions: tuple[int, ...], x, c):
    values = list(c[: shape.constants])
    for q, position in enumerate(positions):
        values[position] = x[shape.n + q]
    tuples = isinstance(shape.form, int) or constants_are_array(shape.form)
    return function(x[: shape.n], tuple(values) if tuples else shape.form(*values))


def _block_diagonal(cov: np.ndarray, variances: list[float]) -> np.ndarray:
    n = len(cov)
    combined = np.diag(np.append(np.zeros(n), variances))
    combined[:n, :n] = cov
    return combined


@cache
def _filler(form, count: int, positions: tuple[int, ...]) -> Callable:
    """Return `fill(t, c)`: the model's constants, t at these positions and c at the others."""
    if constants_are_array(form):
        lines = (f"filled = c[:{count}].copy()", *(f"filled[{i}] = t[{q}]" for q, i in enumerate(positions)))
        return written_out("fill", "t, c", *lines, "filled")
    values = [f"t[{positions.index(i)}]" if i in positions else f"c[{i}]" for i in range(count)]
    source = tuple_of(values) if isinstance(form, int) else f"Constants({', '.join(values)})"
    return written_out("fill", "t, c", source, Constants=form)


@cache
def _difference_quotient(size: int, angles: tuple[bool, ...]) -> Callable:
    """Return `difference(above, below, h)`: a column (size, 1) of slopes, angles the short way round."""
    source = Source("difference", "above, below, h", result=(size, 1), above=(size,), below=(size,))

    def slope(i, j):
        return short_way(f"(above[{i}] - below[{i}])", i, angles) + " / (2.0 * h)"

    return source.function(source.matrix(size, 1, slope), **NAMES)


@makes_functions
def _augmented_functions(
    transition, transition_jacobian, observe, observe_jacobian, shape, positions
) -> dict[str, Callable | None]:
    """Functions of the augmented model; its constants are the model's own, then the spread of each parameter."""
    n, m, form, count, added = shape.n, shape.m, shape.form, shape.constants, len(positions)
    names: dict[str, Any] = {
        "f": transition,
        "h": observe,
        "fill": _filler(form, count, positions),
        "states": vector_part(n, n + added),
        "parameters": vector_part(added, n + added, n),
        "join": joiner(n, added),
    }
    begin, u = ("s = states(x)", "t = parameters(x)"), "u, " * shape.feeds
    functions = {
        "transition": written_out("transition", "x, u, c", *begin, "join(f(s, u, fill(t, c)), t)", **names),
        "observe": written_out("observe", f"x, {u}c", f"h(states(x), {u}fill(parameters(x), c))", **names),
        "transition_jacobian": None,
        "observe_jacobian": None,
    }

    def jacobian(name, function, analytic, size, arguments, angles, identity):
        spreads = tuple_of(f"c[{count + q}]" for q in range(added))
        lines = [*begin, f"far = step_growth(t, {spreads})", f"a = analytic(s, {arguments}fill(t, c))"]
        for q in range(added):
            lines.append(f"step{q} = step_of(t[{q}], c[{count + q}], far)")
            for side, sign in (("above", "+"), ("below", "-")):
                shifted = tuple_of(f"t[{r}] {sign} step{q}" if r == q else f"t[{r}]" for r in range(added))
                lines.append(f"{side}{q} = {function}(s, {arguments}fill({shifted}, c))")
        parts = {"a": ((size, n), 0, 0)}
        slopes = {f"slope{q}": ((size, 1), 0, n + q) for q in range(added)}
        ones = {f"one{q}": ((1, 1), n + q, n + q) for q in range(added) if identity}
        for q in range(added):
            lines.append(f"slope{q} = difference(above{q}, below{q}, step{q})")
        tools: dict[str, Any] = {
            "step_of": step_of,
            "step_growth": step_growth(added),
            "difference": _difference_quotient(size, angles),
            "one": entrywise("one", "", (1, 1), lambda i, j: "1.0"),
            "whole": assembled(
                "whole",
                ", ".join([*parts, *slopes, *ones]),
                (size + len(ones), n + added),
                {**parts, **slopes, **ones},
            ),
        }
        values = ", ".join(["a", *slopes, *["one()"] * len(ones)])
        return written_out(
            name, f"x, {arguments}c", *lines, f"whole({values})", analytic=analytic, **names, **tools
        )

    if transition_jacobian is not None:
        functions["transition_jacobian"] = jacobian(
            "transition_jacobian", "f", transition_jacobian, n, "u, ", shape.state_angles, True
        )
    if observe_jacobian is not None:
        functions["observe_jacobian"] = jacobian(
            "observe_jacobian", "h", observe_jacobian, m, u, shape.measurement_angles, False
        )
    return functions


def embedded_model(
    model: StateSpaceModel, larger: StateSpaceModel, moments: Mapping[int, tuple[float, float]] | None = None
) -> StateSpaceModel:
    """Extend a model to the states of a larger one; the states that `model` lacks keep their values.

        own states:  x' = f(x, u) + w;   further states:  s' = s;   z = h(x) + v

    Q, the prior's covariance and the Jacobians are zero between own and further states, so a Kalman filter
    estimates the own states exactly as with `model` itself. Bounds and operating points are left out.

    Args:
        model: its states are among those of `larger`, by their symbols.
        larger: defines all states, their order, and the prior of those that `model` lacks.
        moments: mean and variance of such states by their index in `larger`, in place of that prior.

    Raises:
        ValueError: for a state that is not one of the larger model's.
    """
    positions = places_within(model.states, larger.states)
    further, n = [i for i in range(larger.n) if i not in positions], larger.n
    mean, prior_cov, q = larger.prior_mean.copy(), np.zeros((n, n)), np.zeros((n, n))
    prior_cov[np.ix_(further, further)] = larger.prior_cov[np.ix_(further, further)]
    for position, (value, variance) in (moments or {}).items():
        if position in further:
            mean[position], prior_cov[position], prior_cov[:, position] = value, 0.0, 0.0
            prior_cov[position, position] = variance
    block = np.ix_(positions, positions)
    mean[list(positions)], prior_cov[block], q[block] = model.prior_mean, model.prior_cov, model.process_noise_cov
    parts: dict[str, Any] = {
        "process_noise_cov": q,
        "measurement_noise_cov": model.measurement_noise_cov,
        "prior_mean": mean,
        "prior_cov": prior_cov,
        "states": larger.states,
        "input_quantities": model.input_quantities,
        "measurements": model.measurements,
    }
    if isinstance(model, AffineModel):
        return _embedded_matrices(model, positions, n, parts)
    operating = None if model.operating_state is None else mean.copy()
    if operating is not None:
        operating[list(positions)] = model.operating_state
    return StateSpaceModel(
        **_embedded_functions(*model.functions, model.n, model.m, n, positions, model.shape.observe_arguments),
        **parts,
        inputs=model.inputs,
        constants=model.constants,
        substeps=model.substeps,
        operating_state=operating,
        operating_input=model.operating_input,
    )


def places_within(states: tuple[Quantity, ...], among: tuple[Quantity, ...]) -> tuple[int, ...]:
    """Indices of states among others, by symbol; as many states with other symbols keep their order.

    Raises:
        ValueError: for states that are not among them, and if only one of a pair is an angle.
    """
    known, symbols = [state.symbol for state in among], [state.symbol for state in states]
    if len(symbols) == len(known) and not set(symbols) & set(known):
        positions = tuple(range(len(known)))
    elif set(symbols) <= set(known):
        positions = tuple(known.index(symbol) for symbol in symbols)
    else:
        rule = f"states of a mode must be some of the model's, {', '.join(known)}, or as many of other names"
        raise ValueError(f"{rule}, but got {', '.join(symbols)}")
    for state, position in zip(states, positions, strict=True):
        if state.angle != among[position].angle:
            kinds = "an angle" if among[position].angle else "no angle"
            rule = f"{state.symbol} of a mode must be {kinds}, as in the model"
            raise ValueError(f"{rule}, but got angle={state.angle}")
    return positions


def _embedded_matrices(
    model: AffineModel, positions: tuple[int, ...], n: int, parts: Mapping[str, Any]
) -> AffineModel:
    """The embedded model of an affine model: affine itself, so its filters need no operating point."""
    (a, b, offset, c, shift), d = model.matrices(), model.feedthrough
    whole_a, whole_b = np.eye(n), np.zeros((n, b.shape[1]))
    whole_offset, whole_c = np.zeros(n), np.zeros((model.m, n))
    at = list(positions)
    whole_a[np.ix_(at, at)], whole_b[at], whole_offset[at], whole_c[:, at] = a, b, offset, c
    return affine_model(
        a=whole_a, b=whole_b, c=whole_c, d=d, state_offset=whole_offset, measurement_offset=shift, **parts
    )


@makes_functions
def _embedded_functions(
    transition,
    transition_jacobian,
    observe,
    observe_jacobian,
    count: int,
    m: int,
    n: int,
    positions: tuple[int, ...],
    arguments_of_h: str,
) -> dict[str, Callable | None]:
    """Functions of the embedded model; its `count` own states have these positions among n."""
    part_of_x = tuple_of(f"x[{position}]" for position in positions)
    names: dict[str, Any] = {
        "f": transition,
        "h": observe,
        "df": transition_jacobian,
        "dh": observe_jacobian,
        "np": np,
    }
    part = f"np.array({part_of_x})" if is_array(count) else part_of_x
    after = [f"y[{positions.index(i)}]" if i in positions else f"x[{i}]" for i in range(n)]

    def slope(i: int, j: int, rows: tuple[int, ...]) -> str:
        if i in rows and j in positions:
            return f"a[{rows.index(i)}][{positions.index(j)}]"
        return "1.0" if i == j and rows is positions else "0.0"

    def matrix(size: int, rows: tuple[int, ...], begun: str) -> tuple[str, ...]:
        """Lines that return slopes, of size rows."""
        if not is_array(size, n):
            return (matrix_of(size, n, lambda i, j: slope(i, j, rows)),)
        entries = (f"found[{i}, {j}] = a[{q}][{r}]" for q, i in enumerate(rows) for r, j in enumerate(positions))
        return begun, *entries, "found"

    functions: dict[str, Callable | None] = {
        "transition": written_out("transition", "x, u, c", f"y = f({part}, u, c)", tuple_of(after), **names),
        "observe": written_out("observe", f"x, {arguments_of_h}", f"h({part}, {arguments_of_h})", **names),
        "transition_jacobian": None,
        "observe_jacobian": None,
    }
    if transition_jacobian is not None:
        lines = f"a = df({part}, u, c)", *matrix(n, positions, f"found = np.eye({n})")
        functions["transition_jacobian"] = written_out("transition_jacobian", "x, u, c", *lines, **names)
    if observe_jacobian is not None:
        lines = f"a = dh({part}, {arguments_of_h})", *matrix(m, tuple(range(m)), f"found = np.zeros(({m}, {n}))")
        functions["observe_jacobian"] = written_out("observe_jacobian", f"x, {arguments_of_h}", *lines, **names)
    return functions


def transformed_model(model: StateSpaceModel, bounds: Mapping[str | int, tuple] | None = None) -> StateSpaceModel:
    """Make a model whose states with bounds are logarithms or logits s = T(x), so that every estimate keeps them.

        s' = T(f(X(s), u)) + w,   z = h(X(s)) + v,   X the inverse of T
        T = log(x - low) above a bound,  -log(high - x) below one,  log((x - low)/(high - x)) between two

    Noise of s is relative noise of x: 0.02 is 2 % of the distance from the bound. Q and the prior's covariance
    become G Q G and G P G, G = dT/dx at the prior mean, whose image is the new one: the median of the state. Give
    others by `replace`. The states themselves are outputs of the new model, by their own symbols.

    Args:
        model: n states; operating points are left out, and Jacobians are found anew.
        bounds: (low, high) of states by symbol or index, as `StateSpaceModel` has them; the model's own if None.

    Raises:
        ValueError: for wrong bounds or none, and a prior mean that is not within.

    Source: Limpert, Stahel, Abbt (2001), "Log-normal distributions across the sciences".
    """
    all_bounds = model.bounds if bounds is None else checked_bounds(bounds, model.states)
    if not all_bounds:
        raise ValueError("a model is transformed by bounds of its states, but it has none: pass bounds=...")
    x, n = model.prior_mean, model.n
    slopes, states = np.ones(n), list(model.states)
    for i, low, high in all_bounds:
        if not low < x[i] < high:
            raise ValueError(f"prior_mean of {states[i].symbol} must be within its bounds, but got {x[i]}")
        slopes[i] = (low > -np.inf) / (x[i] - low) + (high < np.inf) / (high - x[i])
        kind, word = ("logit", "logit") if np.isfinite([low, high]).all() else ("log", "logarithm")
        state = states[i]
        states[i] = Quantity(f"{word} of {state.name}", f"{kind}_{state.symbol}")
    of_model, arguments_of_h = model.functions, model.shape.observe_arguments
    functions = dict(_functions(of_model.transition, of_model.observe, n, all_bounds, arguments_of_h))
    to_new, to_old = functions.pop("to_new"), functions.pop("to_old")
    outputs = {
        symbol: Output(output.quantity, _OfStates(to_old, output.function))
        for symbol, output in model.outputs.items()
    }
    for i, *_ in all_bounds:
        outputs[model.states[i].symbol] = Output(model.states[i], _OfStates(to_old, i))
    remaining = [bound for bound in model.bounds if bound.place not in {other.place for other in all_bounds}]
    helpful: dict[str, Any] = {}
    for name in ("operating_state", "state_low", "state_high"):
        value = getattr(model, name)
        with np.errstate(all="ignore"):
            image = None if value is None else np.array(to_new(as_value(value)))
        helpful[name] = image if image is not None and np.isfinite(image).all() else None
    return StateSpaceModel(
        **functions,
        process_noise_cov=slopes[:, None] * model.process_noise_cov * slopes,
        measurement_noise_cov=model.measurement_noise_cov,
        prior_mean=to_new(as_value(x)),
        prior_cov=slopes[:, None] * model.prior_cov * slopes,
        inputs=model.inputs,
        constants=model.constants,
        analytic=model.analytic,
        substeps=model.substeps,
        operating_input=None if helpful["operating_state"] is None else model.operating_input,
        bounds=remaining,
        bounded_by=model.bounded_by,
        states=states,
        input_quantities=model.input_quantities,
        measurements=model.measurements,
        outputs=outputs,
        **helpful,
    )


@dataclass(frozen=True)
class _OfStates:
    """An output as a function of the new states: that of the old ones, or the one at a place."""

    to_old: Callable
    which: Callable | int

    def __call__(self, x, c):
        old = self.to_old(x)
        return old[self.which] if isinstance(self.which, int) else self.which(old, c)

    def __getstate__(self) -> dict:
        """A recipe in place of the function that was written out."""
        return {name: as_made(value) for name, value in vars(self).items()}

    def __setstate__(self, state: dict) -> None:
        vars(self).update({name: as_function(value) for name, value in state.items()})


@makes_functions
def _functions(
    transition: Callable, observe: Callable, n: int, bounds: tuple[Bound, ...], arguments_of_h: str
) -> dict[str, Callable]:
    bound_of = {bound.place: bound for bound in bounds}

    def entry(logit: str, above: str, below: str) -> Callable:
        def component(i: int) -> str:
            if i not in bound_of:
                return f"x[{i}]"
            _, low, high = bound_of[i]
            text = above if high == np.inf else below if low == -np.inf else logit
            return text.format(x=f"x[{i}]", low=repr(low), high=repr(high), width=repr(high - low))

        return component

    of_bounded = entry("log(({x} - {low}) / ({high} - {x}))", "log({x} - {low})", "-log({high} - {x})")
    of_free = entry("{low} + {width} / (1.0 + exp(-{x}))", "{low} + exp({x})", "{high} - exp(-{x})")
    form = "array({})" if is_array(n) else "{}"
    new, old = (form.format(tuple_of(map(of, range(n)))) for of in (of_bounded, of_free))
    to_new = written_out("to_new", "x", new, log=np.log, array=np.array)
    to_old = written_out("to_old", "x", old, exp=np.exp, array=np.array)
    names: dict[str, Any] = {"f": transition, "h": observe, "new": to_new, "old": to_old}
    return {
        "to_new": to_new,
        "to_old": to_old,
        "transition": written_out("transition", "x, u, c", "new(f(old(x), u, c))", **names),
        "observe": written_out("observe", f"x, {arguments_of_h}", f"h(old(x), {arguments_of_h})", **names),
    }
