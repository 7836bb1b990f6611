"""Bounds within a pass over a window: components that lie at a bound are conditioned on it, or released.

Conditioning a Gaussian d, P on a value of component i is an accurate measurement of it:

    d += k v,  P -= k s k',  k = P e_i/s,  s = (1 + 1e-9) P_ii,  v = value - d_i

The backward pass adds the multiplier v/s - k' l to the adjoint l_i: the force with which the bound pushes. A
component is released if its bound would have to pull, and held at a bound if its estimate lies beyond it. All
components change at once; if that does not converge, they change one by one, which converges for a linear problem.

Source: Judice, Pires (1994), "A block principal pivoting algorithm for large-scale strictly monotone linear
complementarity problems", Computers & Operations Research 21(5).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

from filters.horizon.window import kept_places, scratch_places
from thruster_env.core.compiled import inlined
from thruster_env.model.shape import Shape
from thruster_env.model.state_bounds import Bound

ENOUGH = 1e-9  # rounding error of values beyond a bound, and of forces, in standard deviations
SLACK = 1e-9  # fraction of a variance that a bound leaves, so that contradictory bounds appear as forces


class Limits(NamedTuple):
    """Functions of scratch and of a step of the belief; sigma bounds disturbances, in standard deviations.

    Functions with `wrong` return it plus the number of bounds that were wrong.
    """

    clip: Callable  # clip(row, offset): put the state at this offset within the bounds
    hold_state: Callable  # hold_state(rows, step)
    hold_disturbance: Callable  # hold_disturbance(rows, step, sigma)
    push_state: Callable  # push_state(rows, step, wrong, single), of l after the update
    update_state_set: Callable  # update_state_set(rows, step, wrong, single), by the estimate
    update_disturbance_set: Callable  # update_disturbance_set(rows, step, sigma, wrong, single), by the estimate


@inlined
def hold(rows, mean, cov, n, i, value, at):
    """Condition the Gaussian at offsets `mean` and `cov` on component i; store k, s and v from `at` on."""
    s = (1.0 + SLACK) * rows[cov + i * n + i]
    v = value - rows[mean + i]
    for k in range(n):
        rows[at + k] = rows[cov + k * n + i] / s if s > 0.0 else 0.0
    rows[at + n], rows[at + n + 1] = s, v
    for k in range(n):
        rows[mean + k] += rows[at + k] * v
        for j in range(n):
            rows[cov + k * n + j] -= rows[at + k] * s * rows[at + j]
    for k in range(n):  # P_ki - P_ki P_ii/s, without cancellation
        left = rows[at + k] * s * (SLACK / (1.0 + SLACK))
        rows[cov + k * n + i] = left
        rows[cov + i * n + k] = left
        rows[cov + k * n + k] = max(rows[cov + k * n + k], 0.0)


@inlined
def force(rows, adjoint, n, at):
    """The multiplier of a component after `hold`."""
    total = rows[at + n + 1] / rows[at + n] if rows[at + n] > 0.0 else 0.0
    for k in range(n):
        total -= rows[at + k] * rows[adjoint + k]
    return total


@inlined
def change_side(step, index, side, wrong, single):
    """Set the bound that holds to `side`, unless changes are `single` and one was made; count wrong bounds."""
    if step[index] == side:
        return wrong
    if not (single and wrong > 0):
        step[index] = side
    return wrong + 1


@inlined
def side_of(value, low, high, spread):
    """The bound at which a free component must be held: -1, 1, or 0 for none."""
    room = ENOUGH * spread
    return -1.0 if value < low - room else 1.0 if value > high + room else 0.0


@cache
def limits(shape: Shape, bounds: tuple[Bound, ...], limited: bool) -> Limits:
    """Functions that hold states within bounds, and disturbances if they are limited, for a model's sizes."""
    n, step_layout, at = shape.n, kept_places(shape), scratch_places(shape)
    low, high = [-math.inf] * n, [math.inf] * n
    for bound in bounds:
        low[bound.place], high[bound.place] = bound.low, bound.high
    lows, highs, bounded, size = tuple(low), tuple(high), bool(bounds), n + 2
    of_states, of_disturbances = at.holds, at.holds + n * size
    held_states, held_disturbances = step_layout.sides, step_layout.sides + n

    @inlined
    def clip(row, offset):
        if bounded:
            for i in range(n):
                row[offset + i] = min(max(row[offset + i], lows[i]), highs[i])

    @inlined
    def hold_state(rows, step):
        if bounded:
            for i in range(n):
                side = step[held_states + i]
                if side != 0.0:
                    value = (lows[i] if side < 0.0 else highs[i]) - step[step_layout.x + i]
                    hold(rows, at.updated_d, at.updated_cov, n, i, value, of_states + i * size)

    @inlined
    def hold_disturbance(rows, step, sigma):
        if limited:
            for i in range(n):
                rows[at.spread + i] = rows[at.noise_cov + i * n + i] ** 0.5
            for i in range(n):
                side = step[held_disturbances + i]
                if side != 0.0:
                    value = side * sigma * rows[at.spread + i]
                    hold(rows, at.noise, at.noise_cov, n, i, value, of_disturbances + i * size)

    @inlined
    def pushed(rows, step, holds, sides, wrong, single):
        """Add the forces of the bounds that hold to the adjoint, and release components whose bounds pull."""
        for i in range(n - 1, -1, -1):
            side = step[sides + i]
            if side != 0.0:
                s = rows[holds + i * size + n]
                push = force(rows, at.after, n, holds + i * size)
                rows[at.after + i] += push
                if s > 0.0 and side * push * s**0.5 > ENOUGH:
                    wrong = change_side(step, sides + i, 0.0, wrong, single)
        return wrong

    @inlined
    def update_state_set(rows, step, wrong, single):
        if bounded:
            for i in range(n):
                if step[held_states + i] == 0.0:
                    spread = rows[at.cov + i * n + i] ** 0.5
                    side = side_of(rows[at.estimate + i], lows[i], highs[i], spread)
                    wrong = change_side(step, held_states + i, side, wrong, single)
        return wrong

    @inlined
    def push_state(rows, step, wrong, single):
        return pushed(rows, step, of_states, held_states, wrong, single) if bounded else wrong

    @inlined
    def update_disturbance_set(rows, step, sigma, wrong, single):
        for i in range(n):
            rows[at.after + i] = rows[at.end + at.before + i]
        wrong = pushed(rows, step, of_disturbances, held_disturbances, wrong, single)
        for i in range(n):
            if step[held_disturbances + i] == 0.0:
                spread = rows[at.spread + i]
                side = side_of(rows[at.disturbance + i], -sigma * spread, sigma * spread, spread)
                wrong = change_side(step, held_disturbances + i, side, wrong, single)
        return wrong

    return Limits(clip, hold_state, hold_disturbance, push_state, update_state_set, update_disturbance_set)
