"""Joint estimation of state and parameters: a model whose unknown constants are states."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.angles import NAMES, short_way
from thruster_env.core.checks import finite, positive
from thruster_env.core.compiled import inlined
from thruster_env.core.derivatives import step_growth, step_of
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import Source, assembled, entrywise, joiner, tuple_of, vector_part, written_out
from thruster_env.model.quantities import Output, Quantity
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
    begin = ("s = states(x)", "t = parameters(x)")
    functions = {
        "transition": written_out("transition", "x, u, c", *begin, "join(f(s, u, fill(t, c)), t)", **names),
        "observe": written_out("observe", "x, c", "h(states(x), fill(parameters(x), c))", **names),
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
            name, f"x, {arguments}c", *lines, f"whole({values})", analytic=inlined(analytic), **names, **tools
        )

    if transition_jacobian is not None:
        functions["transition_jacobian"] = jacobian(
            "transition_jacobian", "f", transition_jacobian, n, "u, ", shape.state_angles, True
        )
    if observe_jacobian is not None:
        functions["observe_jacobian"] = jacobian(
            "observe_jacobian", "h", observe_jacobian, m, "", shape.measurement_angles, False
        )
    return functions
