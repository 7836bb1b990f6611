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
    model: StateSpaceModel, whole: StateSpaceModel, moments: Mapping[int, tuple[float, float]] | None = None
) -> StateSpaceModel:
    """Make a model with the states of a larger one, of which those that `model` lacks keep their values.

        own states:  x' = f(x, u) + w;   further states:  s' = s;   z = h(x) + v

    Q, the prior's covariance and the Jacobians are zero between own and further states, so that what a Kalman
    filter says of the former, it says of `model` itself. Bounds and operating points are left out.

    Args:
        model: its states are among those of `whole`, by their symbols.
        whole: says which states there are, in which order, and the prior of those that `model` lacks.
        moments: mean and variance of such states by their place in `whole`, in place of that prior.

    Raises:
        ValueError: for a state that is not one of the larger model's.
    """
    places = places_within(model.states, whole.states)
    further, n = [i for i in range(whole.n) if i not in places], whole.n
    mean, prior_cov, q = whole.prior_mean.copy(), np.zeros((n, n)), np.zeros((n, n))
    prior_cov[np.ix_(further, further)] = whole.prior_cov[np.ix_(further, further)]
    for place, (value, variance) in (moments or {}).items():
        if place in further:
            mean[place], prior_cov[place], prior_cov[:, place] = value, 0.0, 0.0
            prior_cov[place, place] = variance
    own = np.ix_(places, places)
    mean[list(places)], prior_cov[own], q[own] = model.prior_mean, model.prior_cov, model.process_noise_cov
    given: dict[str, Any] = {
        "process_noise_cov": q,
        "measurement_noise_cov": model.measurement_noise_cov,
        "prior_mean": mean,
        "prior_cov": prior_cov,
        "states": whole.states,
        "input_quantities": model.input_quantities,
        "measurements": model.measurements,
    }
    if isinstance(model, AffineModel):
        return _embedded_matrices(model, places, n, given)
    operating = None if model.operating_state is None else mean.copy()
    if operating is not None:
        operating[list(places)] = model.operating_state
    return StateSpaceModel(
        **_embedded_functions(*model.functions, model.n, model.m, n, places),
        **given,
        inputs=model.inputs,
        constants=model.constants,
        substeps=model.substeps,
        operating_state=operating,
        operating_input=model.operating_input,
    )


def places_within(states: tuple[Quantity, ...], among: tuple[Quantity, ...]) -> tuple[int, ...]:
    """Where some states are among others, by their symbols; as many states with symbols of their own keep order.

    Raises:
        ValueError: for states that are not among them, or with which an angle goes with what is none.
    """
    known, own = [one.symbol for one in among], [one.symbol for one in states]
    if len(own) == len(known) and not set(own) & set(known):
        places = tuple(range(len(known)))
    elif set(own) <= set(known):
        places = tuple(known.index(symbol) for symbol in own)
    else:
        rule = f"states of a mode must be some of the model's, {', '.join(known)}, or as many of other names"
        raise ValueError(f"{rule}, but got {', '.join(own)}")
    for one, place in zip(states, places, strict=True):
        if one.angle != among[place].angle:
            kinds = "an angle" if among[place].angle else "no angle"
            raise ValueError(f"{one.symbol} of a mode must be {kinds}, as in the model, but got angle={one.angle}")
    return places


def _embedded_matrices(
    model: AffineModel, places: tuple[int, ...], n: int, given: Mapping[str, Any]
) -> AffineModel:
    """The affine model that is one, whose filters need no operating point."""
    a, b, offset, c, shift = model.matrices()
    whole_a, whole_b, whole_offset, whole_c = (
        np.eye(n),
        np.zeros((n, b.shape[1])),
        np.zeros(n),
        np.zeros((model.m, n)),
    )
    at = list(places)
    whole_a[np.ix_(at, at)], whole_b[at], whole_offset[at], whole_c[:, at] = a, b, offset, c
    return affine_model(
        a=whole_a, b=whole_b, c=whole_c, state_offset=whole_offset, measurement_offset=shift, **given
    )


@makes_functions
def _embedded_functions(
    transition, transition_jacobian, observe, observe_jacobian, count: int, m: int, n: int, places: tuple[int, ...]
) -> dict[str, Callable | None]:
    """Functions of the embedded model of `count` states at some places among n."""
    own = tuple_of(f"x[{place}]" for place in places)
    names: dict[str, Any] = {
        "f": transition,
        "h": observe,
        "df": transition_jacobian,
        "dh": observe_jacobian,
        "np": np,
    }
    part = f"np.array({own})" if is_array(count) else own
    after = [f"y[{places.index(i)}]" if i in places else f"x[{i}]" for i in range(n)]

    def slope(i: int, j: int, rows: tuple[int, ...]) -> str:
        if i in rows and j in places:
            return f"a[{rows.index(i)}][{places.index(j)}]"
        return "1.0" if i == j and rows is places else "0.0"

    def matrix(size: int, rows: tuple[int, ...], begun: str) -> tuple[str, ...]:
        """Lines that return slopes, of size rows."""
        if not is_array(size, n):
            return (matrix_of(size, n, lambda i, j: slope(i, j, rows)),)
        entries = (f"found[{i}, {j}] = a[{q}][{r}]" for q, i in enumerate(rows) for r, j in enumerate(places))
        return begun, *entries, "found"

    functions: dict[str, Callable | None] = {
        "transition": written_out("transition", "x, u, c", f"y = f({part}, u, c)", tuple_of(after), **names),
        "observe": written_out("observe", "x, c", f"h({part}, c)", **names),
        "transition_jacobian": None,
        "observe_jacobian": None,
    }
    if transition_jacobian is not None:
        lines = f"a = df({part}, u, c)", *matrix(n, places, f"found = np.eye({n})")
        functions["transition_jacobian"] = written_out("transition_jacobian", "x, u, c", *lines, **names)
    if observe_jacobian is not None:
        lines = f"a = dh({part}, c)", *matrix(m, tuple(range(m)), f"found = np.zeros(({m}, {n}))")
        functions["observe_jacobian"] = written_out("observe_jacobian", "x, c", *lines, **names)
    return functions
