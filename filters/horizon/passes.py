"""Kernels of moving-horizon estimation: passes of a smoother over a window, until its states converge.

Each step of a window keeps its Q, R and constants. Measurements of one time share a step; a second reading of a
channel gets its own step, to which the state does not move.
"""

from __future__ import annotations

import math
from functools import lru_cache

from filters.engine.belief import Kernels, memory_places, own_place
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.horizon.limits import limits
from filters.horizon.window import kept_places, scratch_places, window_works
from filters.pages.kernels import anything_measured, nothing_to_summarise, page_kernels
from thruster_env.core.compiled import inlined, not_inlined
from thruster_env.model.shape import Functions, Shape, number_places
from thruster_env.model.state_bounds import Bound

MOST_PASSES = 100  # besides `iterations`, until the right bounds hold
HALVINGS = 6  # of a step that increases the cost, if bounds do not change
ROUNDING = 1e-9  # of a cost
PATIENCE = 3  # passes without fewer wrong bounds, after which bounds change one by one


@lru_cache(maxsize=64)
def horizon_kernels(
    functions: Functions, shape: Shape, *, room: int, loss: str, bounds: tuple[Bound, ...], limited: bool
) -> Kernels:
    """Kernels for model functions and sizes, with room for `room` + 1 steps.

    Extras are the number of steps, arrival mean and P, and the steps. Scratch has the numbers of a step, then the
    results of each.
    """
    n, m, inputs = shape.n, shape.m, shape.inputs
    layout, step_layout, at = memory_places(n, m), kept_places(shape), scratch_places(shape)
    end, width, square = step_layout.end, at.end, n * n
    arrival = layout.extras + 1
    steps = arrival + n + square
    numbers_place = steps + (room + 1) * end
    mean, cov, number = layout.mean, layout.cov, layout.extras
    sigma_place, horizon_place, iterations_place = (own_place(shape) + k for k in (1, 2, 3))
    numbers_end, constants = iterations_place + 1, shape.constants
    scratch, at_numbers = numbers_place + numbers_end, number_places(n, m)
    q_place, r_place, constants_place = at_numbers.q, at_numbers.r, at_numbers.constants
    substeps = at_numbers.substeps
    works = window_works(functions, shape, loss)
    tell, centre, linearise, substep, disturb, move, correct, estimate, back_off, descend, find = works
    clip, hold_state, hold_disturbance, push_state, update_state_set, update_disturbance_set = limits(
        shape, bounds, limited
    )
    plain = page_kernels(ExtendedKalmanFilter.page, functions, shape)
    begin, predict_belief = plain.start, plain.predict
    has_bounds = bool(bounds) or limited
    more = MOST_PASSES if has_bounds else 0

    @inlined
    def copy(target, at, source, first, size):
        for i in range(size):
            target[at + i] = source[first + i]

    @inlined
    def keep_sight(row, numbers, step):
        first = steps + step * end
        copy(row, first + step_layout.R, numbers, r_place, m * m)
        copy(row, first + step_layout.seen_by, numbers, constants_place, constants)

    @inlined
    def keep_motion(row, numbers, step):
        """Store Q, constants and the number of substeps of the motion to the next step."""
        first = steps + step * end
        copy(row, first + step_layout.Q, numbers, q_place, square)
        copy(row, first + step_layout.moved_by, numbers, constants_place, constants)
        row[first + step_layout.substeps] = numbers[substeps]

    @not_inlined
    def forwards(row, numbers, count, free):
        """The forward pass over the first `count` steps, without bounds if `free`; returns the cost of X."""
        then = row[numbers_place : numbers_place + numbers_end]
        copy(then, 0, numbers, 0, numbers_end)
        for i in range(n):
            row[scratch + at.d + i] = row[arrival + i]
        for i in range(square):
            row[scratch + at.cov + i] = row[arrival + n + i]
        centre(row[scratch : scratch + width], row[steps : steps + end], numbers)
        cost = row[scratch + at.seen_cost]
        for j in range(count):
            rows = row[scratch + j * width : scratch + (j + 2) * width]
            step = row[steps + j * end : steps + (j + 2) * end]
            for i in range(m):
                rows[at.z + i] = step[step_layout.z + i] if step[step_layout.z + i] < math.inf else math.nan
            copy(then, r_place, step, step_layout.R, m * m)
            copy(then, constants_place, step, step_layout.seen_by, constants)
            correct(rows, step, then)
            cost += rows[at.seen_cost]
            if not free:
                hold_state(rows, step)
            if j < count - 1:
                copy(then, q_place, step, step_layout.Q, square)
                copy(then, constants_place, step, step_layout.moved_by, constants)
                linearise(rows, step, then)
                for _ in range(int(step[step_layout.substeps])):
                    substep(rows, step, then)
                disturb(rows, step, then)
                if not free:
                    hold_disturbance(rows, step, numbers[sigma_place])
                move(rows, step, then)
                cost += rows[at.moved_cost]
        return cost

    @not_inlined
    def backwards(row, numbers, count, single):
        """The backward pass, which moves the window's states; returns how many bounds were wrong."""
        wrong = 0
        for j in range(count - 1, -1, -1):
            rows = row[scratch + j * width : scratch + (j + 2) * width]
            step = row[steps + j * end : steps + (j + 2) * end]
            if j < count - 1:
                if limited:
                    find(rows, step, numbers)
                    wrong = update_disturbance_set(rows, step, numbers[sigma_place], wrong, single)
                descend(rows, step, numbers)
            else:
                for i in range(n):
                    rows[at.after + i] = 0.0
            wrong = push_state(rows, step, wrong, single)
            estimate(rows, step, numbers)
            wrong = update_state_set(rows, step, wrong, single)
            for i in range(n):
                step[step_layout.x + i] = rows[at.estimate + i]
                step[step_layout.adjoint + i] = rows[at.before + i]
            step[step_layout.fresh] = 0.0
            clip(step, step_layout.x)
            for i in range(n):
                rows[at.step + i] += step[step_layout.x + i] - rows[at.estimate + i]
        return wrong

    @not_inlined
    def halve(row, numbers, count):
        for j in range(count):
            rows = row[scratch + j * width : scratch + (j + 2) * width]
            step = row[steps + j * end : steps + (j + 2) * end]
            back_off(rows, step, numbers)
            for i in range(n):
                step[step_layout.x + i] = rows[at.estimate + i]

    @inlined
    def begin_step(row, numbers, count):
        """Append a step without a measurement; its state is the belief's mean."""
        clip(row, mean)
        first = steps + count * end
        for i in range(end):
            row[first + i] = 0.0
        for i in range(n):
            row[first + step_layout.x + i] = row[mean + i]
        for i in range(m):
            row[first + step_layout.z + i] = math.inf
        row[first + step_layout.fresh] = 1.0
        keep_sight(row, numbers, count)
        row[number] = count + 1.0

    @inlined
    def leave_first(row, numbers, count):
        """Drop the first step: its prediction of the second becomes the arrival cost of that."""
        forwards(row, numbers, 2, True)
        second, second_step = scratch + width + at.cov, steps + end
        for i in range(n):
            expected = row[second_step + step_layout.x + i]
            for k in range(n):
                row[arrival + n + i * n + k] = row[second + i * n + k]
                expected -= row[second + i * n + k] * row[second_step + step_layout.adjoint + k]
            row[arrival + i] = expected
        for i in range(steps, steps + (count - 1) * end):
            row[i] = row[i + end]
        row[number] = count - 1.0

    @inlined
    def add_step(row, numbers, count):
        begin_step(row, numbers, count)
        if count == int(numbers[horizon_place]):
            leave_first(row, numbers, count + 1)

    @inlined
    def repeat_step(row, numbers, count):
        """Append a step at the same time as the last one, for another measurement."""
        last = steps + (count - 1) * end
        keep_motion(row, numbers, count - 1)
        for i in range(square):
            row[last + step_layout.Q + i] = 0.0
        row[last + step_layout.substeps] = 0.0
        add_step(row, numbers, count)

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        begin(memory, numbers, size)
        for i in range(number, numbers_place):
            row[i] = 0.0
        for i in range(n):
            row[arrival + i] = row[mean + i]
        for i in range(square):
            row[arrival + n + i] = row[cov + i]
        begin_step(row, numbers, 0)

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        count = int(row[number])
        copy(row, steps + (count - 1) * end + step_layout.u, u, 0, inputs)
        keep_motion(row, numbers, count - 1)
        predict_belief(memory, u, numbers, size)
        add_step(row, numbers, count)

    @inlined
    def iterate(row, numbers, count):
        """Make passes until all iterations are done and the right bounds hold, then one without bounds, for P."""
        fewest, patience, settled, least, wrong = 1 << 30, PATIENCE, False, math.inf, 0
        iterations = int(numbers[iterations_place])
        for k in range(iterations + more + 1):
            cost = forwards(row, numbers, count, settled)
            for _ in range(HALVINGS):
                if k == 0 or wrong > 0 or cost <= least + ROUNDING * (1.0 + abs(least)):
                    break
                halve(row, numbers, count)
                cost = forwards(row, numbers, count, settled)
            least = cost if wrong == 0 else math.inf  # a state beyond a bound may cost less
            if settled:
                break
            wrong = backwards(row, numbers, count, patience < 0)
            fewest, patience = (wrong, PATIENCE) if wrong < fewest else (fewest, patience - 1)
            settled = k + 1 == iterations + more or (k + 1 >= iterations and wrong == 0)

    @inlined
    def take(row, z, numbers):
        """Store a measurement with those of the same time; their errors are independent."""
        newest = steps + (int(row[number]) - 1) * end
        is_first, fits = True, True
        for i in range(m):
            if row[newest + step_layout.z + i] < math.inf:
                is_first = False
                fits = fits and z[i] != z[i]
        if is_first:
            keep_sight(row, numbers, int(row[number]) - 1)
        else:
            for i in range(constants):
                fits = fits and row[newest + step_layout.seen_by + i] == numbers[constants_place + i]
            if not fits:
                repeat_step(row, numbers, int(row[number]))
                newest = steps + (int(row[number]) - 1) * end
        for i in range(m):
            if z[i] == z[i]:
                row[newest + step_layout.z + i] = z[i]
                for j in range(m):
                    joint = numbers[r_place + i * m + j] if z[j] == z[j] else 0.0
                    row[newest + step_layout.R + i * m + j] = row[newest + step_layout.R + j * m + i] = joint

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        tell(row, z, numbers)
        if anything_measured(z):
            take(row, z, numbers)
        count = int(row[number])
        newest = steps + (count - 1) * end
        if has_bounds or anything_measured(z):
            iterate(row, numbers, count)
            for i in range(n):
                row[mean + i] = row[newest + step_layout.x + i]
            for i in range(square):
                row[cov + i] = row[scratch + (count - 1) * width + at.updated_cov + i]

    return Kernels(
        *(n, m, n, 0, start, predict, update, nothing_to_summarise),
        extras=numbers_place - number,
        scratch=numbers_end + (room + 1) * width,
    )
