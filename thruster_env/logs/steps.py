"""Models of steps of any length: the length of a step is one more input.

    x_{k+1} = f(x_k, u_k, r_k dt) + w_k,  w_k ~ N(0, r_k Q);   r_k dt is the length of step k

The Q of a model is that of a step of dt; another one's is in proportion (`continuous.noise_for_dt`). A log on
its own stamps is then rows of numbers, and what takes such rows takes the log.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from thruster_env.core.compiled import inlined
from thruster_env.core.derivatives import by_complex_step
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.logs.findings import Recording
from thruster_env.logs.grid import count_steps
from thruster_env.logs.log import Log
from thruster_env.model.continuous import same_dt
from thruster_env.model.quantities import Quantity
from thruster_env.model.shape import Shape
from thruster_env.model.state_space import StateSpaceModel

RATIO = Quantity("length of a step over dt", "step_ratio")


class AnyStepModel(StateSpaceModel):
    """A model whose last input is the step ratio; see `in_any_steps`.

    Attributes:
        plain: the model of a step of dt, which is what tuned files are for.
    """

    plain: StateSpaceModel

    def replace(self, **changes) -> AnyStepModel:
        """A copy with some fields of the plain model changed; ValueError as for a new model."""
        return in_any_steps(self.plain.replace(**changes))

    @property
    def shape(self) -> Shape:
        """Sizes, with the flag that pages multiply Q by the last input."""
        return super().shape._replace(step_ratio=True)


def in_any_steps(model: StateSpaceModel, dt: float | None = None) -> AnyStepModel:
    """The model with the step ratio r as one more input, for filters with a page and their likelihood.

    Args:
        model: whose sample time is one of its constants, `dt`, or `substep` for a part of it.
        dt: that of the logs [s], which must be the model's; None if it is known to be.

    Raises:
        ValueError: for a model of one sample time, or of another one than the logs.
    """
    index, parts = sample_time_place(model, "a filter on a log's own stamps")
    model_dt = float(model.constants[index]) * parts
    if dt is not None and not same_dt(model_dt, dt):
        raise ValueError(f"the dt of logs on their own stamps must be the model's {model_dt:g} s, but is {dt:g} s")
    fields: dict[str, Any] = {name: getattr(model, name) for name in StateSpaceModel.__dataclass_fields__}
    form, count, inputs = type(model.constants), len(model.constants), model.inputs
    fields["transition"] = with_ratio(model.transition, form, count, index, inputs)
    slopes = model.transition_jacobian
    if slopes is not None:
        exact = by_complex_step(slopes)  # which is found anew
        fields["transition_jacobian"] = None if exact else with_ratio(slopes, form, count, index, inputs)
    if model.operating_input is not None:
        fields["operating_input"] = np.append(model.operating_input, 1.0)
    fields |= {
        "inputs": inputs + 1,
        "input_quantities": (*model.input_quantities, RATIO),
        "operating_points": None,
    }
    any_step = AnyStepModel(**fields)
    object.__setattr__(any_step, "plain", model)
    return any_step


def of_one_step(model: StateSpaceModel) -> StateSpaceModel:
    """The plain model of one of any steps; any other model itself."""
    return model.plain if isinstance(model, AnyStepModel) else model


@makes_functions
def with_ratio(function: Callable, form: type, count: int, index: int, inputs: int) -> Callable:
    """`function(x, u, c)` with constant `index` multiplied by the last input, u[inputs]."""
    constants = (f"c[{i}] * u[{inputs}]" if i == index else f"c[{i}]" for i in range(count))
    names: dict[str, Any] = {"function": inlined(function), "form": form}
    return written_out("stepped", "x, u, c", f"function(x, u[:{inputs}], form{tuple_of(constants)})", **names)


def as_rows(log: Log) -> Log:
    """A log on its own stamps as one of rows with step ratios; true states and other references are left out."""
    inputs, measurements = in_steps(log)
    quantities = (*log.input_quantities, RATIO)
    fields: dict[str, Any] = {"inputs": inputs, "measurements": measurements, "input_quantities": quantities}
    fields |= {"references": {}, "referred": {}, "source": {}, "stamps": None, "recording": Recording()}
    return dataclasses.replace(log, **fields)


def in_steps(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (K', p + 1) with step ratios, and measurements (K' + 1, m), of a log on its own stamps.

    A longer step than dt is divided into equal ones that are at most as long, as `filters.live` does it; there
    is no measurement between them.
    """
    lengths = np.diff(log.times)
    counts = np.array([count_steps(length, log.dt, log.resolution) for length in lengths.tolist()], dtype=int)
    ratios = np.repeat(lengths / counts / log.dt, counts)
    measurements = np.full((len(ratios) + 1, log.measurements.shape[1]), np.nan)
    measurements[np.concatenate([[0], np.cumsum(counts)])] = log.measurements
    return np.column_stack([np.repeat(log.inputs, counts, axis=0), ratios]), measurements


def sample_time_place(model: StateSpaceModel, what: str) -> tuple[int, int]:
    """Index of the constant that is the sample time, and the number of substeps in a step.

    Args:
        model: any.
        what: needs it, for the message.

    Raises:
        ValueError: for a model without one, or with both of them, or whose other constants follow from it.
    """
    names = getattr(model.constants, "_fields", ())
    called = "needs" if what == "set_dt" else "must be of"
    if "of_one_dt" in names:
        rule = f"{what} {called} a model whose other constants do not follow from dt"
        raise ValueError(f"{rule}, but got those of lagging sensors")
    if "dt" in names and "substep" in names:
        raise ValueError(f"{what} {called} a model with one of the constants dt and substep, but got both")
    for name, parts in (("dt", 1), ("substep", model.substeps)):
        if name in names:
            return names.index(name), parts
    raise ValueError(
        f"{what} {called} a model with a constant dt, but got {', '.join(names) or 'none'}: write f(x, u, c) "
        "with c.dt, for a filter such as 'ekf'"
    )
