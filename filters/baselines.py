"""Baselines that any filter should beat: open loop, inversion of the measurement, low-pass with inversion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from filters.engine.belief import Kernels, filter_offset, memory_offsets
from filters.filter import Filter
from filters.pages.kernels import nothing_to_summarise
from thruster_env.core import matrices
from thruster_env.core.angles import angle_writer, with_wrapped_angles, wrapped
from thruster_env.core.checks import at_least, positive, short_repr
from thruster_env.core.sources import Source, vector_reader, vector_writer, written_out
from thruster_env.model.shape import (
    Functions,
    Shape,
    constants_reader,
    for_any_input,
    number_offsets,
)

INTERVALS = 100  # on either side, that are searched for a sign change
HALVINGS = 60  # of an interval; also the steps of the golden section, which each shorten it to 0.618
_GOLDEN = 0.6180339887498949


@lru_cache(maxsize=64)
def component_solver(observe: Callable, n: int, component: int, channel: int, angle: bool = False) -> Callable:
    """Return `solve(x, z, c, reach)`: x with one component changed so that channel h_i(x) = z.

    The result is the root nearest to the component's value. It is searched within `reach`, by sign changes between
    100 equal steps on either side. Without a root the result is the value at which h comes nearest to z, by a
    golden section around the nearest step. If the channel is an `angle`, h_i(x) - z is wrapped to (-pi, pi], and
    its jump at pi is no root.
    """
    source = Source("replaced", "x, v", result=(n,), x=(n,))
    replaced = source.function(source.vector(n, lambda i: source.if_same(i, component, "v", f"x[{i}]")))

    def misfit(x, v, z, c):
        off = observe(replaced(x, v), c)[channel] - z
        return wrapped(off) if angle else off

    def crossing(before, after):
        return (after > 0.0) != (before > 0.0) and (not angle or abs(after - before) < math.pi)

    def halved(x, z, c, near, far, misfit_near):
        for _ in range(HALVINGS):
            middle = 0.5 * (near + far)
            value = misfit(x, middle, z, c)
            if (value > 0.0) == (misfit_near > 0.0):
                near = middle
            else:
                far = middle
        return 0.5 * (near + far)

    def nearest_approach(x, z, c, low, high):
        for _ in range(HALVINGS):
            left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
            if abs(misfit(x, left, z, c)) < abs(misfit(x, right, z, c)):
                high = right
            else:
                low = left
        return 0.5 * (low + high)

    def solve(x, z, c, reach):
        start, step = x[component], reach / INTERVALS
        below = above = misfit(x, start, z, c)
        nearest, least = start, abs(below)
        for k in range(1, INTERVALS + 1):
            next_below, next_above = misfit(x, start - k * step, z, c), misfit(x, start + k * step, z, c)
            crossed_below, crossed_above = crossing(below, next_below), crossing(above, next_above)
            if crossed_below or crossed_above:
                inner = (k - 1) * step
                down = halved(x, z, c, start - inner, start - k * step, below) if crossed_below else start - reach
                up = halved(x, z, c, start + inner, start + k * step, above) if crossed_above else start + reach
                return replaced(x, down if start - down < up - start else up)
            if abs(next_below) < least:
                nearest, least = start - k * step, abs(next_below)
            if abs(next_above) < least:
                nearest, least = start + k * step, abs(next_above)
            below, above = next_below, next_above
        low, high = max(nearest - step, start - reach), min(nearest + step, start + reach)
        finer = nearest_approach(x, z, c, low, high)
        return replaced(x, finer if abs(misfit(x, finer, z, c)) < least else nearest)

    return solve


@lru_cache(maxsize=64)
def baseline_kernels(functions: Functions, shape: Shape, inverted: tuple[int, int] | None) -> Kernels:
    """Kernels of all baselines for a model's functions and shape.

    Args:
        functions: of the model.
        shape: of the model.
        inverted: (component, channel), or None for the open loop.

    Extras: the open loop's state (n,), the output of the low-pass filter, and 1 once that has a value; if h takes
    the input, that of the last step and that of the last measurement.
    """
    n, m, transition, observe = shape.n, shape.m, functions.transition, for_any_input(functions.observe, shape)
    layout, source, first_parameter = memory_offsets(n, m), number_offsets(n, m), filter_offset(shape)
    substeps_offset, step_offset, likelihood_offset = source.substeps, layout.step, layout.log_likelihood
    smooth_offset, known_offset, acting = (layout.extras + n + i for i in range(3))
    feed, acts = shape.feed, vector_reader(shape.feed, acting)
    at_last = vector_reader(feed, acting + feed)
    reach_offset, share_offset = first_parameter, first_parameter + 1
    read_open, store_open = vector_reader(n, layout.extras), vector_writer(n, layout.extras)
    read_mean, store_mean = vector_reader(n, layout.mean), angle_writer(layout.mean, shape.state_angles)
    store_innovation, cov, s = vector_writer(m, layout.innovation), layout.cov, layout.innovation_cov
    prior_mean, control = vector_reader(n, source.prior_mean), vector_reader(shape.inputs)
    constants = constants_reader(shape)
    subtract = matrices.innovation(m, 0)  # z - y, zero in channels that are NaN
    measured, difference = vector_reader(m), with_wrapped_angles(subtract, "z, y", shape.measurement_angles)
    component, channel = inverted or (0, 0)
    angle, inverts = shape.measurement_angles[channel], inverted is not None
    of_both = written_out("of_both", "x, both", "observe(x, both[0], both[1])", observe=observe)
    solve = component_solver(of_both, n, component, channel, angle)

    def blend(y, z, share):  # the low-pass filter; of angles from y the short way towards z
        return wrapped(y + (1.0 - share) * wrapped(z - y)) if angle else share * y + (1.0 - share) * z

    def estimate(row, numbers):
        x = read_open(row)
        store_mean(row, x)
        if inverts and row[known_offset] > 0.0:
            c = at_last(row), constants(numbers)
            store_mean(row, solve(x, row[smooth_offset], c, numbers[reach_offset]))

    def start(memory, numbers, size):
        row, _, _ = memory
        store_open(row, prior_mean(numbers))
        row[smooth_offset] = row[known_offset] = 0.0
        for i in range(feed):
            row[acting + i] = 0.0
        estimate(row, numbers)
        for i in range(n * n):
            row[cov + i] = 0.0

    def predict(memory, u, numbers, size):
        row, _, _ = memory
        v, c = control(u), constants(numbers)
        for _ in range(int(numbers[substeps_offset])):
            store_open(row, transition(read_open(row), v, c))
        for i in range(feed):
            row[acting + i] = u[i]
        estimate(row, numbers)
        row[step_offset] += 1.0

    def update(memory, z, numbers, size):
        row, _, _ = memory
        store_innovation(row, difference(measured(z), observe(read_mean(row), acts(row), constants(numbers))))
        for i in range(m * m):
            row[s + i] = 0.0
        row[likelihood_offset] = 0.0
        if inverts and z[channel] == z[channel]:
            share = numbers[share_offset] * row[known_offset]
            row[smooth_offset] = blend(row[smooth_offset], z[channel], share)
            row[known_offset] = 1.0
            for i in range(feed):
                row[acting + feed + i] = row[acting + i]
            estimate(row, numbers)

    works, offsets = (start, predict, update, nothing_to_summarise), tuple(range(acting, acting + feed))
    return Kernels(n, m, n, 0, *works, extras=n + 2 + 2 * feed, acting=offsets)


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenLoop(Filter):
    """The model alone, from the mean of the prior: x = f(x, u). It ignores measurements.

    It has no covariance (zeros) and no likelihood; the innovation is z - h(x).
    """

    name: ClassVar[str] = "open-loop"
    has_covariance: ClassVar[bool] = False
    gaussian_likelihood: ClassVar[bool] = False

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return baseline_kernels(self.kernel_model.functions, self.kernel_model.shape, self.inverted_pair)

    @property
    def inverted_pair(self) -> tuple[int, int] | None:
        """The component of the state that is solved for, and the channel that it is solved from."""
        return None

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """The reach of the search for a root, and the low-pass filter's share of its last output."""
        return 0.0, 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Inversion(OpenLoop):
    """Inversion of the measurement: the value of one state component x_i for which the model gives z.

        x = f(x, u), the open loop;  the estimate is x with x_i replaced by the root v of
        h(x with x_i = v) = z nearest to x_i, else by the v at which h comes nearest to z, an extremum

    It uses one channel of z and one component: for the thruster the flow velocity U_a follows from the thrust and
    the open loop's motor speed. While measurements are missing it inverts the last one; before the first the
    estimate is the open loop. There is no covariance (zeros) and no likelihood; the innovation is z minus its
    prediction from the estimate before.

    Attributes:
        inverted: index i of the component that is solved for; -1 is the last.
        channel: index of the channel of z.
        reach: largest distance of a root from the open loop's x_i, in the unit of x_i; if None, the width of the
            range of x_i in the model (`state_high` minus `state_low`), or, without a range, 20 times its spread in
            prior and process noise.

    Raises:
        ValueError: if the model has no such component or channel, or reach is not positive.
    """

    name: ClassVar[str] = "inversion"
    inverted: int = -1
    channel: int = 0
    reach: float | None = None

    def __post_init__(self):
        model = self.model
        i = index_of("inverted", self.inverted, model.n)
        object.__setattr__(self, "inverted", i)
        object.__setattr__(self, "channel", index_of("channel", self.channel, model.m))
        if self.reach is not None:
            reach = self.reach
        elif model.state_low is not None and model.state_high is not None:
            reach = model.state_high[i] - model.state_low[i]
        else:
            reach = 20.0 * model.scales[i]
        object.__setattr__(self, "reach", positive("reach", reach))

    @property
    def inverted_pair(self) -> tuple[int, int] | None:
        """The component of the state that is solved for, and the channel that it is solved from."""
        return self.inverted, self.channel

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """The reach of the search for a root, and the low-pass filter's share of its last output, zero."""
        return self._numbers(0.0)

    def _numbers(self, share: float) -> tuple[float, ...]:
        assert self.reach is not None  # it is set when the filter is made
        return self.reach, share


@dataclass(frozen=True, kw_only=True, eq=False)
class LowPass(Inversion):
    """Exponential low-pass filter of the measurement, followed by an inversion as in `Inversion`.

        y = a y + (1 - a) z,  a = exp(-1/time_constant), from the first measurement on;  h(x with x_i = v) = y

    A missing measurement leaves y as it is.

    Attributes:
        time_constant: of the low-pass filter, in steps; positive.
        inverted: index i of the component that is solved for; -1 is the last.
        channel: index of the channel of z.
        reach: largest distance of a root from the open loop's x_i; see `Inversion`.

    Raises:
        ValueError: as `Inversion`, or if time_constant is not positive.
    """

    name: ClassVar[str] = "low-pass"
    time_constant: float = 2.0

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "time_constant", positive("time_constant", self.time_constant))

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """The reach of the search for a root, and the low-pass filter's share of its last output."""
        return self._numbers(math.exp(-1.0 / self.time_constant))


def index_of(name: str, value, count: int) -> int:
    """Return an index as 0 ... count - 1, negative ones counted from the end; raise ValueError beyond."""
    index = at_least(name, value, -count)
    if index >= count:
        raise ValueError(f"{name} must be a whole number from {-count} to {count - 1}, but got {value!r}")
    return index % count


def indices_of(name: str, indices, count: int) -> tuple[int, ...]:
    """Return a list of indices as 0 ... count - 1, in order, each once; raise ValueError for anything else."""
    if not isinstance(indices, Sequence | np.ndarray) or isinstance(indices, str):
        raise ValueError(f"{name} must be a list of indices, but got {short_repr(indices)}")
    return tuple(sorted({index_of(name, index, count) for index in indices}))
