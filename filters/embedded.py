"""A model of fewer states within a larger one: further states are kept as they are, and take part in nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import is_array, matrix_of, tuple_of, written_out
from thruster_env.model.affine import AffineModel, affine_model
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel


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
        **_embedded_functions(*model.functions, model.n, model.m, n, positions),
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
    a, b, offset, c, shift = model.matrices()
    whole_a, whole_b = np.eye(n), np.zeros((n, b.shape[1]))
    whole_offset, whole_c = np.zeros(n), np.zeros((model.m, n))
    at = list(positions)
    whole_a[np.ix_(at, at)], whole_b[at], whole_offset[at], whole_c[:, at] = a, b, offset, c
    return affine_model(
        a=whole_a, b=whole_b, c=whole_c, state_offset=whole_offset, measurement_offset=shift, **parts
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
        "observe": written_out("observe", "x, c", f"h({part}, c)", **names),
        "transition_jacobian": None,
        "observe_jacobian": None,
    }
    if transition_jacobian is not None:
        lines = f"a = df({part}, u, c)", *matrix(n, positions, f"found = np.eye({n})")
        functions["transition_jacobian"] = written_out("transition_jacobian", "x, u, c", *lines, **names)
    if observe_jacobian is not None:
        lines = f"a = dh({part}, c)", *matrix(m, tuple(range(m)), f"found = np.zeros(({m}, {n}))")
        functions["observe_jacobian"] = written_out("observe_jacobian", "x, c", *lines, **names)
    return functions
