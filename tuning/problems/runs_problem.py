"""`RunsProblem`: a list of runs of your own, of any lengths, for filters that assume a model."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from filters.starts import PRIOR
from thruster_env.core.checks import as_floats, short_repr
from thruster_env.logs.columns import STATE
from thruster_env.logs.log import Log
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.data import FIRST_SCORED_STEP, checked_first_scored_step
from tuning.problems.log_problem import LogProblem
from tuning.problems.parameter import Parameter

PARTS = ("inputs", "measurements", "states")


class RunsProblem(LogProblem):
    """Runs as arrays, each of which begins where the model's prior does; the seed of a run is its number.

    Every third run of three or more is held out; of those with truth every third of the others is for the choice
    of an ensemble size. Each run counts in full: errors are pooled over all scored steps of all runs.

    Args:
        runs: a mapping each with `measurements` (K + 1, m), NaN where missing, `inputs` (K, p), unless the model
            has none, and `states` (K + 1, n) where they are known, NaN in rows where they are not, which are not
            scored; or these as a tuple (inputs, measurements) or (inputs, measurements, states). K may differ.
        model: the model that filters assume, or a function of `parameters` that makes it.
        first_scored_step: rows at the beginning of each run that are not scored.
        held_out: numbers of the held-out runs, from 0.
        start: that of `LogProblem`.
        dt: sample time [s].
        scale, parameters, untuned, name, about: those of `LogProblem`.

    Raises:
        ValueError: states the rule and the value.
    """

    seed_word = "runs"

    def __init__(
        self,
        runs: Sequence[Mapping | Sequence],
        model: StateSpaceModel | Callable[..., StateSpaceModel],
        *,
        first_scored_step: int = 0,
        held_out: Collection[int] | None = None,
        dt: float = 1.0,
        start: str = PRIOR,
        scale: Sequence[float] | None = None,
        parameters: Sequence[Parameter] | None = None,
        untuned: Mapping | None = None,
        name: str = "some runs",
        about: str = "",
    ):
        """Check the arrays; see the class for the arguments."""
        if not isinstance(runs, Sequence) or isinstance(runs, str) or not runs:
            raise ValueError(
                f"runs must be a list of runs, each a mapping or a tuple of arrays, but got {short_repr(runs)}"
            )
        assumed = model if isinstance(model, StateSpaceModel) else _made(model, parameters)
        logs = [log_of(run, assumed, dt, f"run {i}") for i, run in enumerate(runs)]
        super().__init__(
            logs,
            model,
            lead=checked_first_scored_step(first_scored_step, max(log.steps for log in logs)),
            blocks=1,
            held_out=None if held_out is None else [f"run {i}" for i in held_out],
            shortest=1,
            start=start,
            scale=scale,
            parameters=parameters,
            untuned=untuned,
            name=name,
            about=about,
        )

    @property
    def counts_start_up(self) -> bool:
        """Whether the first steps are scored, on which P_0 has an effect."""
        return self.first_scored_step < FIRST_SCORED_STEP and bool(self.model().prior_cov.any())


def _made(model: Any, parameters: Sequence[Parameter] | None) -> StateSpaceModel:
    """The model of a function at the starts of its parameters, of which inputs and measurements are needed."""
    assumed = (
        model(**{parameter.name: parameter.start for parameter in parameters or ()}) if callable(model) else model
    )
    if not isinstance(assumed, StateSpaceModel):
        raise ValueError(
            f"model must be a StateSpaceModel, or a function that makes one, but got {short_repr(model)}"
        )
    return assumed


def log_of(run: Mapping | Sequence, model: StateSpaceModel, dt: float = 1.0, name: str = "run") -> Log:
    """A run of arrays as a `Log`, whose channels are those of a model.

    Args:
        run: as `RunsProblem` takes it.
        model: whose inputs, measurements and states they are.
        dt: sample time [s].
        name: of the run.

    Raises:
        ValueError: states the rule and the value.
    """
    if not isinstance(run, Mapping):
        parts = tuple(run) if isinstance(run, Sequence) and not isinstance(run, str) else ()
        if len(parts) not in (2, 3):
            raise ValueError(
                f"{name} must be (inputs, measurements) or (inputs, measurements, states), "
                f"but got {short_repr(run)}"
            )
        run = dict(zip(PARTS, parts, strict=False))
    unknown = [key for key in run if key not in PARTS]
    if unknown or run.get("measurements") is None:
        got = short_repr(unknown[0]) if unknown else "no measurements"
        raise ValueError(f"{name} must have measurements, and may have inputs and states, but got {got}")
    measurements = _columns("measurements", run["measurements"], model.m, name)
    user_inputs = run.get("inputs")
    inputs = (
        np.zeros((len(measurements) - 1, 0))
        if user_inputs is None
        else _columns("inputs", user_inputs, model.inputs, name)
    )
    references, referred = {}, {}
    if run.get("states") is not None:
        states = _columns("states", run["states"], model.n, name)
        for i, state in enumerate(model.states):
            references[f"{STATE}:{state.symbol}"], referred[f"{STATE}:{state.symbol}"] = states[:, i], state
    if inputs.shape != (len(measurements) - 1, model.inputs):
        raise ValueError(
            f"inputs of {name} must have one row fewer than its measurements and one column per input, "
            f"{(len(measurements) - 1, model.inputs)}, but got {inputs.shape}"
        )
    return Log(name, dt, inputs, measurements, model.input_quantities, model.measurements, references, referred)


def _columns(what: str, values: Any, count: int, name: str) -> np.ndarray:
    """Numbers as (rows, count); a single column may be (rows,)."""
    array = as_floats(values)
    array = array[:, None] if array.ndim == 1 and count == 1 else array
    if array.ndim != 2 or array.shape[1] != count:
        raise ValueError(f"{what} of {name} must have {count} columns, as the model has, but got {array.shape}")
    return array
