"""The window of a moving-horizon estimate: its layout in memory, the computations of each step, and its bounds.

They use deviations d_j = x_j - X_j from the estimate X of the window, about which the model is linearised:

    forwards:   d_{j+1} = F_j d_j + f(X_j) - X_{j+1},  P_{j+1} = F_j P_j F_j' + Q,  then the update with z_j
    backwards:  l = g + (I - K H)' l,  g = H' S^-1 (z_j - h(X_j) - H d_j),  x_j = X_j + d_j + P_j l,
                l = F_{j-1}' l

with d_j and P_j before the update in the last line. Of states that turn, d_j lies in the tangent at X_j
(`thruster_env.model.turns`): f(X_j) - X_{j+1} is a difference there, F_j and Q are brought there by a reset, and
x_j is X_j moved. The adjoint l, a vector, needs neither P^-1 nor Q^-1: both may be singular. Components at a bound
are conditioned on it, or released (`limits`).

Source: Bryson, Frazier (1963), "Smoothing for linear and nonlinear dynamic systems".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, lru_cache
from typing import NamedTuple

from filters.algebra.matrices import shifted
from filters.algebra.operations import (
    choose,
    constant,
    count,
    divide,
    exceeds,
    eye,
    joseph,
    logarithm,
    mask_missing,
    present,
    quotient,
    sym,
    uncorrelated,
    wrap,
)
from filters.algebra.points import dot
from filters.algebra.roots import careful
from filters.algebra.tangents import (
    after_reset,
    differences,
    inverse_reset_slopes,
    local_at,
    local_at_measurement,
    move,
    reset,
    reset_back,
    reset_slopes,
)
from filters.engine.belief import memory_offsets
from filters.gaussian import extended
from filters.pages.kernels import Stage, programs_of, stored
from filters.pages.page import ACTING, Equations, Page, RowMemory
from filters.rts import propagate_jacobian, represent_jacobian
from thruster_env.model.quantities import Bound
from thruster_env.model.shape import Functions, Shape, starts_of

HUBER, STUDENT, QUADRATIC = LOSSES = "huber", "student", "quadratic"
OWN = tuple(
    (name, ()) for name in ("threshold", "disturbance_limit", "horizon", "iterations")
)  # the filter's numbers
ENOUGH = 1e-9  # rounding error of values beyond a bound, and of forces, in standard deviations
SLACK = 1e-9  # fraction of a variance that a bound leaves, so that contradictory bounds appear as forces


class Kept(NamedTuple):
    """Offsets of the numbers that a belief keeps of a step."""

    u: int  # (p,), from this step to the next one; at 0, as in `given` of other programs
    x: int  # (n,), X
    z: int  # (channels,), infinite where missing: a belief must not be NaN
    adjoint: int  # (t,), l before the update
    fresh: int  # 1 until the step was part of a pass
    sides: int  # (2 t,), which bounds hold the state and the disturbance after it: -1, 0 or 1
    R: int  # (m, m), of z
    seen_by: int  # (c,), the model's constants at z
    Q: int  # (t, t), from this step to the next one
    moved_by: int  # (c,), constants of that motion
    substeps: int  # of it; zero before a second reading at the same time
    acting: int  # (p,), the input at z, if h takes it
    end: int


class Scratch(NamedTuple):
    """Offsets of the results of a step, in scratch."""

    d: int  # (t,), before the update; at first the arrival's mean (n,)
    cov: int  # (t, t)
    updated_d: int
    updated_cov: int
    z: int  # (channels,), NaN where missing
    mean: int  # (n,), f(X)
    slope: int  # (t, t), F
    without: int  # (t, t), I - K H
    pull: int  # (t,), g
    after: int  # (t,), l after the update, then after the bounds
    before: int  # (t,), l before the update
    estimate: int  # (n,), the new X
    step: int  # (t,), from the last X to the new one
    seen_cost: int  # of the measurement, and of the arrival in the first step
    moved_cost: int  # of the disturbance after this step
    noise: int  # (t,), mean of the disturbance after this step
    noise_cov: int  # (t, t), of it
    disturbance: int  # (t,), estimate of it
    spread: int  # (t,), its standard deviations
    holds: int  # (2 t, t + 2), gain k, variance s and jump v of each bound that holds
    end: int


@cache
def kept_places(shape: Shape) -> Kept:
    """Offsets of the numbers that a belief keeps of a step."""
    n, t = shape.n, shape.t
    square, constants = t * t, shape.constants
    of_step = shape.inputs, n, shape.channels, t, 1, 2 * t, shape.m**2, constants, square, constants, 1, shape.feed
    return Kept(*starts_of(*of_step))


@cache
def scratch_places(shape: Shape) -> Scratch:
    """Offsets of the results of a step."""
    n, m, t, square = shape.n, shape.channels, shape.t, shape.t * shape.t
    return Scratch(
        *starts_of(
            n, square, t, square, m, n, square, square, t, t, t, n, t, 1, 1, t, square, t, t, 2 * t * (t + 2)
        )
    )


class Works(NamedTuple):
    """Functions (rows, given, numbers): `tell` of a filter's row and z, others of scratch and a kept step."""

    tell: Callable  # innovation, its covariance and log-likelihood, of the prediction
    centre: Callable  # d -= X, and the arrival cost
    linearise: Callable  # set f(X) and F to X and the identity
    substep: Callable  # propagate f(X) and F by one substep
    disturb: Callable  # set the disturbance after this step to zero and Q
    move: Callable  # d and P of the next step, from the updated ones
    correct: Callable  # update d and P with the measurement
    estimate: Callable  # l before the update, x, and the step to it
    back_off: Callable  # undo half of the last step
    descend: Callable  # l of this step, from that of the next one
    find: Callable  # the estimate of the disturbance after this step
    leave: Callable  # the arrival's mean and P, in place of the estimate and the updated P, of the step before


def tell(model, x, P, z):
    """Innovation, its covariance and log density, by the extended filter; NaN marks missing channels."""
    local, z = local_at(model, z, x)
    return extended.update(local, x, P, z)[2:]


def correct(model, x, d, P, z, fresh, loss):
    """The updated d and P, I - K H, g, and the loss at x.

    The weight follows from the residual at x; for a fresh step, without an estimate, from the innovation.
    """
    model, z = local_at_measurement(model, z, x)
    measured = present(z)
    H, R = mask_missing(measured, model.H(x)), uncorrelated(measured, model.R)
    residual = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles))
    v, square = residual - H @ d, dot(residual, divide(residual, R))
    limit = model.own.threshold * model.own.threshold
    cost = loss_of(square, measured, limit, loss)
    if loss != QUADRATIC:
        S = sym(H @ P @ H.T + R)
        square = choose(exceeds(fresh, 0.5), dot(v, divide(v, S)), square)
        R = R / weight_of(square, measured, limit, loss)
    S = sym(H @ P @ H.T + R)
    K = divide(P @ H.T, S)
    return d + K @ v, joseph(P, K, H, R), eye(P) - K @ H, H.T @ divide(v, S), cost


def loss_of(square, measured, limit, loss):
    """The loss rho(r) of square = r^2 = v' R^-1 v; `limit` is the square of the threshold."""
    if loss == QUADRATIC:
        return square * 0.5
    far = square / limit
    if loss == STUDENT:
        return (limit + count(measured)) * logarithm(shifted(far, 1.0)) * 0.5
    return choose(exceeds(far, 1.0), limit * (far**0.5 - 0.5), square * 0.5)


def weight_of(square, measured, limit, loss):
    """The factor rho'(r)/r on the precision of a measurement."""
    if loss == STUDENT:
        return (limit + count(measured)) / (limit + square)
    far = square / limit
    return choose(exceeds(far, 1.0), far, constant(1.0, far)) ** -0.5


def cost_of(v, cov):
    """The cost v' cov^-1 v/2; components without variance do not count."""
    return dot(v, quotient(v, careful(cov))) * 0.5


@lru_cache(maxsize=64)
def window_works(functions: Functions, shape: Shape, loss: str) -> Works:
    """The computations of the steps of a window, for a model's functions and sizes, and a loss."""
    n, m, t = shape.n, shape.m, shape.t
    step_layout, at, row = kept_places(shape), scratch_places(shape), memory_offsets(n, m, t)
    outputs = row.innovation, row.innovation_cov, row.log_likelihood

    def stages(memory: RowMemory, model: Equations) -> list[Stage]:
        x, fresh = memory.read("given", step_layout.x, n), memory.read("given", step_layout.fresh)
        next_x = memory.read("given", step_layout.end + step_layout.x, n)

        def vector(offset, size=t):
            return memory.read("rows", offset, size)

        def square(offset, *, symmetric=False):
            return memory.read("rows", offset, t, t, symmetric=symmetric)

        d, P = vector(at.d), square(at.cov, symmetric=True)
        updated_d, updated_P = vector(at.updated_d), square(at.updated_cov, symmetric=True)
        z, after, before = memory.read("rows", at.z, shape.channels), vector(at.after), vector(at.before)
        next_before, noise = vector(at.end + at.before), vector(at.noise)
        noise_cov = square(at.noise_cov, symmetric=True)
        mean, F, without = vector(at.mean, n), square(at.slope), square(at.without)
        next_d, next_P = vector(at.end + at.d), square(at.end + at.cov, symmetric=True)
        adjoint = vector(at.pull) + without.T @ after
        estimate, step, shift = vector(at.estimate, n), vector(at.step), d + P @ adjoint
        half, jump, begun = step * 0.5, differences(model, mean, next_x), vector(at.d, n)
        centred, arrival_P = differences(model, begun, x), reset(model, P, begun, differences(model, x, begun))
        left = move(model, x, P @ memory.read("given", step_layout.adjoint, t) * -1.0)
        onwards, slopes = F, {}
        if model.turns:  # the difference of the next X from f(X), by both
            way = differences(model, next_x, mean)
            onwards = inverse_reset_slopes(next_x, jump, model.turns) @ F
            slopes = {F: reset_slopes(mean, way, model.turns) @ onwards}
        reached, reached_P = onwards @ updated_d + noise, sym(onwards @ updated_P @ onwards.T) + noise_cov
        if model.turns:
            reached, reached_P = after_reset(model, reached, mean, way), reset(model, reached_P, mean, way)
        model.extras = {ACTING: memory.read("rows", row.extras, shape.feed)}
        results = tell(model, memory.x, memory.P, memory.z)
        model.extras = {ACTING: memory.read("given", step_layout.acting, shape.feed)}
        return [
            stored(results, outputs),
            stored((centred, arrival_P, cost_of(centred, arrival_P)), (d, P, at.seen_cost)),
            stored(represent_jacobian(model, x, P), (mean, F)),
            stored(propagate_jacobian(model, mean, F, memory.u), (mean, F)),
            stored((noise * 0.0, model.Q), (noise, noise_cov)),
            stored(
                (reached + jump, reached_P, cost_of(jump, model.Q), *slopes.values()),
                (next_d, next_P, at.moved_cost, *slopes),
            ),
            stored(
                correct(model, x, d, P, z, fresh, loss),
                (updated_d, updated_P, without, vector(at.pull), at.seen_cost),
            ),
            stored((adjoint, move(model, x, shift), shift), (before, estimate, step)),
            stored((move(model, x, half * -1.0), half), (estimate, step)),
            stored((F.T @ next_before,), (after,)),
            stored((noise + noise_cov @ next_before,), (vector(at.disturbance),)),
            stored((left, reset_back(model, P, left, differences(model, x, left))), (estimate, updated_P)),
        ]

    page = Page(extended.propagate, extended.add_process_noise, extended.update, own=OWN)
    return Works(*programs_of(page, functions, shape, stages).works)


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


def force(rows, adjoint, n, at):
    """The multiplier of a component after `hold`."""
    total = rows[at + n + 1] / rows[at + n] if rows[at + n] > 0.0 else 0.0
    for k in range(n):
        total -= rows[at + k] * rows[adjoint + k]
    return total


def change_side(step, index, side, wrong, single):
    """Set the bound that holds to `side`, unless changes are `single` and one was made; count wrong bounds."""
    if step[index] == side:
        return wrong
    if not (single and wrong > 0):
        step[index] = side
    return wrong + 1


def side_of(value, low, high, spread):
    """The bound at which a free component must be held: -1, 1, or 0 for none."""
    room = ENOUGH * spread
    return -1.0 if value < low - room else 1.0 if value > high + room else 0.0


@cache
def limits(shape: Shape, bounds: tuple[Bound, ...], limited: bool) -> Limits:
    """Functions that hold states within bounds, and disturbances if they are limited, for a model's sizes.

    Conditioning a Gaussian d, P on a value of component i is an accurate measurement of it:

        d += k v,  P -= k s k',  k = P e_i/s,  s = (1 + 1e-9) P_ii,  v = value - d_i

    The backward pass adds the multiplier v/s - k' l to the adjoint l_i: the force with which the bound pushes. A
    component is released if its bound would have to pull, and held at a bound if its estimate lies beyond it. All
    components change at once; if that does not converge, they change one by one, which converges for a linear
    problem.

    Source: Judice, Pires (1994), "A block principal pivoting algorithm for large-scale strictly monotone linear
    complementarity problems", Computers & Operations Research 21(5).
    """
    n, step_layout, at = shape.t, kept_places(shape), scratch_places(shape)  # without rotations, if it has bounds
    low, high = [-math.inf] * n, [math.inf] * n
    for bound in bounds:
        low[bound.place], high[bound.place] = bound.low, bound.high
    lows, highs, bounded, size = tuple(low), tuple(high), bool(bounds), n + 2
    of_states, of_disturbances = at.holds, at.holds + n * size
    held_states, held_disturbances = step_layout.sides, step_layout.sides + n

    def clip(row, offset):
        if bounded:
            for i in range(n):
                row[offset + i] = min(max(row[offset + i], lows[i]), highs[i])

    def hold_state(rows, step):
        if bounded:
            for i in range(n):
                side = step[held_states + i]
                if side != 0.0:
                    value = (lows[i] if side < 0.0 else highs[i]) - step[step_layout.x + i]
                    hold(rows, at.updated_d, at.updated_cov, n, i, value, of_states + i * size)

    def hold_disturbance(rows, step, sigma):
        if limited:
            for i in range(n):
                rows[at.spread + i] = rows[at.noise_cov + i * n + i] ** 0.5
            for i in range(n):
                side = step[held_disturbances + i]
                if side != 0.0:
                    value = side * sigma * rows[at.spread + i]
                    hold(rows, at.noise, at.noise_cov, n, i, value, of_disturbances + i * size)

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

    def update_state_set(rows, step, wrong, single):
        if bounded:
            for i in range(n):
                if step[held_states + i] == 0.0:
                    spread = rows[at.cov + i * n + i] ** 0.5
                    side = side_of(rows[at.estimate + i], lows[i], highs[i], spread)
                    wrong = change_side(step, held_states + i, side, wrong, single)
        return wrong

    def push_state(rows, step, wrong, single):
        return pushed(rows, step, of_states, held_states, wrong, single) if bounded else wrong

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
