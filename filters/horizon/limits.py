"""Bounds within a pass over a window: components that lie at a bound are conditioned on it, or released.

A component i of a Gaussian d, P that is held at a value has, as any accurate measurement of it,

    d += k v,  P -= k s k',  k = P e_i/s,  s = (1 + 1e-9) P_ii,  v = value - d_i

and backwards the multiplier v/s - k' l, which is added to the adjoint l_i: the force with which the bound pushes.
A component is released if its bound would have to pull, and held at a bound if its estimate lies beyond it. All
change at once; where that does not settle, one by one, which does if the problem is linear.

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

ENOUGH = 1e-9  # beyond a bound, and of a force, in standard deviations: rounding
SLACK = 1e-9  # of a variance that a bound leaves, so that bounds which contradict each other show as forces


class Limits(NamedTuple):
    """Functions of scratch and of what is kept of a step; sigma is the bound of disturbances, in deviations."""

    clip: Callable  # clip(row, place): put the state that lies there within the bounds
    hold_state: Callable  # hold_state(rows, given)
    hold_disturbance: Callable  # hold_disturbance(rows, given, sigma)
    push_state: Callable  # push_state(rows, given, wrong, single), of l after the update; how many are wrong
    update_state_set: Callable  # update_state_set(rows, given, wrong, single), of the estimate
    update_disturbance_set: Callable  # update_disturbance_set(rows, given, sigma, wrong, single), of the estimate


@inlined
def hold(rows, mean, cov, n, i, value, at):
    """Condition the Gaussian that lies at `mean` and `cov` on component i; k, s and v go to places from `at`."""
    s = (1.0 + SLACK) * rows[cov + i * n + i]
    v = value - rows[mean + i]
    for k in range(n):
        rows[at + k] = rows[cov + k * n + i] / s if s > 0.0 else 0.0
    rows[at + n], rows[at + n + 1] = s, v
    for k in range(n):
        rows[mean + k] += rows[at + k] * v
        for j in range(n):
            rows[cov + k * n + j] -= rows[at + k] * s * rows[at + j]
    for k in range(n):  # what P_ii - P_ii^2/s and the like are, without cancellation
        left = rows[at + k] * s * (SLACK / (1.0 + SLACK))
        rows[cov + k * n + i] = left
        rows[cov + i * n + k] = left
        rows[cov + k * n + k] = max(rows[cov + k * n + k], 0.0)


@inlined
def force(rows, adjoint, n, at):
    """The multiplier of a component that `hold` held, before it is added to the adjoint."""
    total = rows[at + n + 1] / rows[at + n] if rows[at + n] > 0.0 else 0.0
    for k in range(n):
        total -= rows[at + k] * rows[adjoint + k]
    return total


@inlined
def change_side(step, index, side, wrong, single):
    """Let another bound hold, unless bounds change one by one and one has; returns how many were wrong."""
    if step[index] == side:
        return wrong
    if not (single and wrong > 0):
        step[index] = side
    return wrong + 1


@inlined
def side_of(value, low, high, spread):
    """The bound at which a component that is free ought to be held: -1, 1, or 0 for none."""
    room = ENOUGH * spread
    return -1.0 if value < low - room else 1.0 if value > high + room else 0.0


@cache
def limits(shape: Shape, bounds: tuple[Bound, ...], limited: bool) -> Limits:
    """What holds states within bounds, and disturbances if they are limited, for some sizes."""
    n, step_layout, at = shape.n, kept_places(shape), scratch_places(shape)
    low, high = [-math.inf] * n, [math.inf] * n
    for bound in bounds:
        low[bound.place], high[bound.place] = bound.low, bound.high
    lows, highs, bounded, size = tuple(low), tuple(high), bool(bounds), n + 2
    of_states, of_disturbances = at.holds, at.holds + n * size
    held_states, held_disturbances = step_layout.held, step_layout.held + n

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
        """Add the forces of bounds that hold to the adjoint, and release those that pull."""
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
                    side = side_of(rows[at.found + i], lows[i], highs[i], spread)
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
