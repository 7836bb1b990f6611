"""Channels: a sensor's measurement of a plant, defined once for the plant's step and for a filter's model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from thruster_env.core.compiled import inlined
from thruster_env.core.results import as_array
from thruster_env.core.tuples import tuple_of, written_out
from thruster_env.model.quantities import Quantity


class Channel(NamedTuple):
    """A measured quantity h(x, y, u, c): of the state x, the plant's outputs y at x, its input u and constants c.

    The functions work on tuples of components (floats or arrays) and can be compiled. A channel that does not
    depend on u has slopes: the state alone predicts it, so that a state-space model may contain it.

    Attributes:
        quantity: the measured quantity, with its unit.
        variance: default variance of the channel's Gaussian noise [unit^2].
        code: unique integer that identifies the channel in compiled code; it never changes, so the order of
            channels has no meaning.
        read: h(x, y, u, c).
        slopes: `slopes(x, dy, c)`, the n derivatives dh/dx, where row i of dy is the gradient of output i; None if
            the channel depends on the input.
        affine: whether h is affine in x and y, so that a linear plant's model can have it.
    """

    quantity: Quantity
    variance: float
    code: int
    read: Callable
    slopes: Callable | None = None
    affine: bool = True


def reader_of(channels: Sequence[Channel], of_copy: Callable[[Callable], Callable], arguments: str) -> Callable:
    """Return `read(code, *arguments)`, which reads the channel of a code for one copy of a plant.

    Args:
        channels: data for compiled code.
        of_copy: `of_copy(read)` makes a function of the arguments that finds the inputs of a channel's `read` in a
            copy, and reads it; so compiled code computes only what this channel needs.
        arguments: their names, "memory, b, j".

    Raises:
        ValueError: if two channels have one code.
    """
    codes = sorted(channel.code for channel in channels)
    if len(set(codes)) < len(codes):
        raise ValueError(f"codes of channels must differ from one another, but got {codes}")
    functions: dict[str, Any] = {
        f"read_{channel.code}": inlined(of_copy(inlined(channel.read))) for channel in channels
    }
    source = f"read_{codes[0]}({arguments})"
    for code in codes[1:]:
        source = f"read_{code}({arguments}) if code == {code} else {source}"
    return written_out("read", f"code, {arguments}", source, **functions)


def functions_of(
    channels: Sequence[Channel], outputs: Callable, outputs_jacobian: Callable, states: int
) -> tuple[Callable, Callable]:
    """`observe(x, c)` of a model that has these channels, and its Jacobian by rows.

    Args:
        channels: the measured channels, in order; each with slopes.
        outputs: `outputs(x, c)`, the plant's outputs y.
        outputs_jacobian: `outputs_jacobian(x, c)`, their derivatives by rows.
        states: number of components of x.

    Raises:
        ValueError: if a channel depends on the input.
    """
    reads: dict[str, Any] = {f"read_{i}": inlined(channel.read) for i, channel in enumerate(channels)}
    slopes: dict[str, Any] = {}
    for i, channel in enumerate(channels):
        if channel.slopes is None:
            raise ValueError(
                f"a channel of a model must not depend on the input, but {channel.quantity.name} does"
            )
        slopes[f"slopes_{i}"] = inlined(channel.slopes)
    readings = tuple_of(f"{name}(x, y, (), c)" for name in reads)
    rows = tuple_of(f"{name}(x, dy, c)" for name in slopes)
    observe = written_out("observe", "x, c", "y = outputs(x, c)", readings, outputs=outputs, **reads)
    jacobian = written_out(
        "observe_jacobian", "x, c", "dy = slopes(x, c)", rows, slopes=outputs_jacobian, **slopes
    )
    count = len(channels)
    return as_array(observe, "x, c", count), as_array(jacobian, "x, c", count, states)
