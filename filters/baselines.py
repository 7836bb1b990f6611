"""Baselines that any filter should beat: open loop, inversion of the measurement, low-pass with inversion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from filters.engine.belief import Kernels, memory_places, own_place, row_access
from filters.filter import Filter
from filters.pages.kernels import nothing_to_summarise
from thruster_env.core.angles import wrapped
from thruster_env.core.checks import at_least, positive, short_repr
from thruster_env.core.compiled import inlined
from thruster_env.core.sources import Source, vector_reader, vector_writer, zeros_of
from thruster_env.model.shape import Functions, Shape, constants_reader, innovation_of, number_places

# Solving h(x) = z for one component of x, by bracketing: for any continuous function, compiled or not.


INTERVALS = 100  # on either side, in which a sign change is looked for
HALVINGS = 60  # of such an interval; and steps of the golden section, each of which leaves 0.618 of it
_GOLDEN = 0.6180339887498949


@lru_cache(maxsize=64)
def component_solver(observe: Callable, n: int, component: int, channel: int, angle: bool = False) -> Callable:
    """Return `solve(x, z, c, reach)`: x with the value of one component at which channel h_i(x) = z.

    It is the root nearest to the value in x, among those within `reach` of it whose sign change shows between two
    of 100 equal steps on either side. If there is none, it is the value at which h comes nearest to z, as found by
    a golden section about the nearest step. Where the channel is an `angle`, h_i(x) - z goes the short way round,
    and its jump half a turn away is no root.
    """
    source = Source("place", "x, v", result=(n,), x=(n,))
    place = source.function(source.vector(n, lambda i: source.if_same(i, component, "v", f"x[{i}]")))

    @inlined
    def misfit_of_number(x, v, z, c):
        return observe(place(x, v), c)[channel] - z

    @inlined
    def misfit_of_angle(x, v, z, c):
        return wrapped(observe(place(x, v), c)[channel] - z)

    @inlined
    def crossing_of_number(one, other):
        return (other > 0.0) != (one > 0.0)

    @inlined
    def crossing_of_angle(one, other):
        return (other > 0.0) != (one > 0.0) and abs(other - one) < math.pi

    misfit = misfit_of_angle if angle else misfit_of_number
    crossing = crossing_of_angle if angle else crossing_of_number

    @inlined
    def halved(x, z, c, one, other, at_one):
        for _ in range(HALVINGS):
            middle = 0.5 * (one + other)
            value = misfit(x, middle, z, c)
            if (value > 0.0) == (at_one > 0.0):
                one = middle
            else:
                other = middle
        return 0.5 * (one + other)

    @inlined
    def nearest_approach(x, z, c, low, high):
        for _ in range(HALVINGS):
            left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
            if abs(misfit(x, left, z, c)) < abs(misfit(x, right, z, c)):
                high = right
            else:
                low = left
        return 0.5 * (low + high)

    @inlined
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
                return place(x, down if start - down < up - start else up)
            if abs(next_below) < least:
                nearest, least = start - k * step, abs(next_below)
            if abs(next_above) < least:
                nearest, least = start + k * step, abs(next_above)
            below, above = next_below, next_above
        low, high = max(nearest - step, start - reach), min(nearest + step, start + reach)
        finer = nearest_approach(x, z, c, low, high)
        return place(x, finer if abs(misfit(x, finer, z, c)) < least else nearest)

    return solve


# Baselines that any filter should beat: open loop, inversion of the measurement, low-pass with inversion.


@inlined
def blend_numbers(y, z, kept):
    """What a low-pass makes of its last value y and a measurement z."""
    return kept * y + (1.0 - kept) * z


@inlined
def blend_angles(y, z, kept):
    """The same of angles: from y the short way towards z."""
    return wrapped(y + (1.0 - kept) * wrapped(z - y))


@lru_cache(maxsize=64)
def baseline_kernels(functions: Functions, shape: Shape, inverted: tuple[int, int] | None) -> Kernels:
    """Kernels of all baselines for a model's functions and shape.

    Args:
        functions: of the model.
        shape: of the model.
        inverted: (component, channel) that are inverted, or None for the open loop.

    Extras: the open loop's state (n,), the low-passed measurement, and 1 once it has a value.
    """
    n, m, transition, observe = shape.n, shape.m, functions.transition, functions.observe
    places, source, own = memory_places(n, m), number_places(n, m), own_place(shape)
    substeps_place, step_place, likelihood_place = source.substeps, places.step, places.log_likelihood
    smooth_place, known_place, reach_place, kept_place = places.extras + n, places.extras + n + 1, own, own + 1
    read_open, store_open = vector_reader(n, places.extras), vector_writer(n, places.extras)
    (read_mean, _), (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    prior_mean, constants, control = (
        vector_reader(n, source.prior_mean),
        constants_reader(shape),
        vector_reader(shape.inputs),
    )
    measured, difference = vector_reader(m), innovation_of(shape)
    component, channel = inverted or (0, 0)
    angle, inverts = shape.measurement_angles[channel], inverted is not None
    solve = component_solver(observe, n, component, channel, angle)
    blend = blend_angles if angle else blend_numbers
    no_cov, no_s = zeros_of(n, n), zeros_of(m, m)

    @inlined
    def estimate(row, numbers):
        """The open loop's state, with the component at which the model gives the low-passed measurement."""
        x = read_open(row)
        if inverts and row[known_place] > 0.0:
            x = solve(x, row[smooth_place], constants(numbers), numbers[reach_place])
        store_mean(row, x)

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        store_open(row, prior_mean(numbers))
        row[smooth_place] = row[known_place] = 0.0
        estimate(row, numbers)
        store_cov(row, no_cov())

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        x, v, c = read_open(row), control(u), constants(numbers)
        for _ in range(int(numbers[substeps_place])):
            x = transition(x, v, c)
        store_open(row, x)
        estimate(row, numbers)
        row[step_place] += 1.0

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        store_innovation(row, difference(measured(z), observe(read_mean(row), constants(numbers))))
        store_s(row, no_s())
        row[likelihood_place] = 0.0
        if inverts and z[channel] == z[channel]:
            kept = numbers[kept_place] * row[known_place]
            row[smooth_place] = blend(row[smooth_place], z[channel], kept)
            row[known_place] = 1.0
            estimate(row, numbers)

    return Kernels(n, m, n, 0, start, predict, update, nothing_to_summarise, extras=n + 2)


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenLoop(Filter):
    """The model alone, from the mean of the prior: x = f(x, u). No measurement changes it.

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
        """How far a root is looked for, and how much of the last measurement is kept in the next."""
        return 0.0, 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Inversion(OpenLoop):
    """Inversion of the measurement: the value of one state component x_i for which the model gives z.

        x = f(x, u), the open loop;  the estimate is x with x_i replaced by the root v of
        h(x with x_i = v) = z nearest to x_i, else by the v at which h comes nearest to z, an extremum

    One channel of z and one component are used: for the thruster the flow velocity U_a follows from the thrust,
    with the open loop's motor speed. While a measurement is missing, the last one is inverted; before the first,
    the estimate is the open loop. There is no covariance (zeros) and no likelihood; the innovation is z minus its
    prediction from the estimate before.

    Attributes:
        inverted: index i of the component that is solved for; -1 is the last.
        channel: index of the channel of z.
        reach: largest distance from the open loop's x_i at which a root is looked for, in the unit of x_i; if
            None, the width of the range of x_i in the model (`state_high` minus `state_low`), or, without a range,
            20 times its spread in prior and process noise.

    Raises:
        ValueError: if the model has no such component or channel, or reach is not positive.
    """

    name: ClassVar[str] = "inversion"
    inverted: int = -1
    channel: int = 0
    reach: float | None = None

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        model = self.model
        i = place_of("inverted", self.inverted, model.n)
        object.__setattr__(self, "inverted", i)
        object.__setattr__(self, "channel", place_of("channel", self.channel, model.m))
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
        """How far a root is looked for, and how much of the last measurement is kept in the next."""
        return self._numbers(0.0)

    def _numbers(self, kept: float) -> tuple[float, ...]:
        assert self.reach is not None  # it is set when the filter is made
        return self.reach, kept


@dataclass(frozen=True, kw_only=True, eq=False)
class LowPass(Inversion):
    """Exponential low-pass filter of the measurement, followed by an inversion as in `Inversion`.

        y = a y + (1 - a) z,  a = exp(-1/time_constant), from the first measurement on;  h(x with x_i = v) = y

    A missing measurement leaves y as it is.

    Attributes:
        time_constant: of the low-pass filter, in steps; positive.
        inverted: index i of the component that is solved for; -1 is the last.
        channel: index of the channel of z.
        reach: largest distance from the open loop's x_i at which a root is looked for; see `Inversion`.

    Raises:
        ValueError: as `Inversion`, or if time_constant is not positive.
    """

    name: ClassVar[str] = "low-pass"
    time_constant: float = 2.0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        object.__setattr__(self, "time_constant", positive("time_constant", self.time_constant))

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """How far a root is looked for, and how much of the last measurement is kept in the next."""
        return self._numbers(math.exp(-1.0 / self.time_constant))


def place_of(name: str, value, count: int) -> int:
    """Return a place 0 ... count - 1, counted from the end if negative; raise ValueError if there is none."""
    place = at_least(name, value, -count)
    if place >= count:
        raise ValueError(f"{name} must be a whole number from {-count} to {count - 1}, but got {value!r}")
    return place % count


def places_of(name: str, given, count: int) -> tuple[int, ...]:
    """Return places 0 ... count - 1 in order, each once, of a list of such; raise ValueError for anything else."""
    if not isinstance(given, Sequence | np.ndarray) or isinstance(given, str):
        raise ValueError(f"{name} must be a list of indices, but got {short_repr(given)}")
    return tuple(sorted({place_of(name, one, count) for one in given}))
