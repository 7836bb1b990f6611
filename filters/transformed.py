"""Models in which states that have bounds are replaced by their logarithms or logits, which have none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import as_value, is_array, tuple_of, written_out
from thruster_env.core.user_functions import as_function, as_made
from thruster_env.model.quantities import Output, Quantity
from thruster_env.model.state_bounds import Bound, checked_bounds
from thruster_env.model.state_space import StateSpaceModel


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
    functions = dict(_functions(model.functions.transition, model.functions.observe, n, all_bounds))
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
def _functions(transition: Callable, observe: Callable, n: int, bounds: tuple[Bound, ...]) -> dict[str, Callable]:
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
        "observe": written_out("observe", "x, c", "h(old(x), c)", **names),
    }
