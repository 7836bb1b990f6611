"""Moving-horizon estimation: the most probable states of the last steps, within bounds, at every step.

Passes of a smoother over the window are repeated until its states converge. Each step of a window keeps its Q, R
and constants. Measurements of one time share a step; a second reading of a channel gets its own step, to which the
state does not move.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import ClassVar

import numpy as np

from filters.engine.belief import Belief, Kernels, filter_offset, memory_offsets
from filters.filter import Filter
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.horizon.window import HUBER, LOSSES, kept_places, limits, scratch_places, window_works
from filters.pages.kernels import anything_measured, nothing_to_summarise, page_kernels
from thruster_env.core.checks import at_least, one_of, positive
from thruster_env.core.sources import vector_reader, vector_writer
from thruster_env.model.quantities import Bound
from thruster_env.model.shape import Functions, Shape
from thruster_env.model.traced import called_function
from thruster_env.model.turns import innovation as difference

MOST_PASSES = 100  # besides `iterations`, until the right bounds hold
HALVINGS = 6  # of a step that increases the cost, if bounds do not change
ROUNDING = 1e-9  # of a cost
PATIENCE = 3  # passes without fewer wrong bounds, after which bounds change one by one
MOST_STEPS, MOST_ITERATIONS = 200, 50
KERNEL_HORIZONS = 10, 20, 50, 100, MOST_STEPS  # only for these there are kernels, so that studies compile few


@lru_cache(maxsize=64)
def horizon_kernels(
    functions: Functions, shape: Shape, *, room: int, loss: str, bounds: tuple[Bound, ...], limited: bool
) -> Kernels:
    """Kernels for model functions and sizes, with room for `room` + 1 steps.

    Extras are the number of steps, arrival mean and P, and the steps. Scratch has the numbers of a step, then the
    results of each.
    """
    n, m, t, channels, inputs = shape.n, shape.m, shape.t, shape.channels, shape.inputs
    layout, step_layout, at = memory_offsets(n, m, t), kept_places(shape), scratch_places(shape)
    end, width, square = step_layout.end, at.end, t * t
    acting, feed = layout.extras, shape.feed  # the input of the last step, if h takes it
    number = acting + feed
    arrival = number + 1
    steps = arrival + n + square
    numbers_offset = steps + (room + 1) * end
    mean, cov = layout.mean, layout.cov
    sigma_offset, horizon_offset, iterations_offset = (filter_offset(shape) + k for k in (1, 2, 3))
    numbers_end, constants = iterations_offset + 1, shape.constants
    scratch, at_numbers = numbers_offset + numbers_end, shape.offsets
    q_offset, r_offset, constants_offset = at_numbers.q, at_numbers.r, at_numbers.constants
    substeps = at_numbers.substeps
    works = window_works(functions, shape, loss)
    tell, centre, linearise, substep, disturb, move, correct, estimate, back_off, descend, find, leave = works
    clip, hold_state, hold_disturbance, push_state, update_state_set, update_disturbance_set = limits(
        shape, bounds, limited
    )
    plain = page_kernels(ExtendedKalmanFilter.page, functions, shape)
    begin, predict_belief = plain.start, plain.predict
    has_bounds, known = bool(bounds) or limited, known_errors(shape)
    more = MOST_PASSES if has_bounds else 0

    def copy(target, at, source, first, size):
        for i in range(size):
            target[at + i] = source[first + i]

    def keep_sight(row, numbers, step):
        first = steps + step * end
        copy(row, first + step_layout.R, numbers, r_offset, m * m)
        copy(row, first + step_layout.seen_by, numbers, constants_offset, constants)
        copy(row, first + step_layout.acting, row, acting, feed)

    def keep_motion(row, numbers, step):
        """Store Q, constants and the number of substeps of the motion to the next step."""
        first = steps + step * end
        copy(row, first + step_layout.Q, numbers, q_offset, square)
        copy(row, first + step_layout.moved_by, numbers, constants_offset, constants)
        row[first + step_layout.substeps] = numbers[substeps]

    def forwards(row, numbers, count, free):
        """The forward pass over the first `count` steps, without bounds if `free`; returns the cost of X."""
        then = row[numbers_offset : numbers_offset + numbers_end]
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
            for i in range(channels):
                rows[at.z + i] = step[step_layout.z + i] if step[step_layout.z + i] < math.inf else math.nan
            copy(then, r_offset, step, step_layout.R, m * m)
            copy(then, constants_offset, step, step_layout.seen_by, constants)
            correct(rows, step, then)
            cost += rows[at.seen_cost]
            if not free:
                hold_state(rows, step)
            if j < count - 1:
                copy(then, q_offset, step, step_layout.Q, square)
                copy(then, constants_offset, step, step_layout.moved_by, constants)
                linearise(rows, step, then)
                for _ in range(int(step[step_layout.substeps])):
                    substep(rows, step, then)
                disturb(rows, step, then)
                if not free:
                    hold_disturbance(rows, step, numbers[sigma_offset])
                move(rows, step, then)
                cost += rows[at.moved_cost]
        return cost

    def backwards(row, numbers, count, single):
        """The backward pass, which moves the window's states; returns how many bounds were wrong."""
        wrong = 0
        for j in range(count - 1, -1, -1):
            rows = row[scratch + j * width : scratch + (j + 2) * width]
            step = row[steps + j * end : steps + (j + 2) * end]
            if j < count - 1:
                if limited:
                    find(rows, step, numbers)
                    wrong = update_disturbance_set(rows, step, numbers[sigma_offset], wrong, single)
                descend(rows, step, numbers)
            else:
                for i in range(t):
                    rows[at.after + i] = 0.0
            wrong = push_state(rows, step, wrong, single)
            estimate(rows, step, numbers)
            wrong = update_state_set(rows, step, wrong, single)
            for i in range(n):
                step[step_layout.x + i] = rows[at.estimate + i]
            for i in range(t):
                step[step_layout.adjoint + i] = rows[at.before + i]
            step[step_layout.fresh] = 0.0
            clip(step, step_layout.x)
            for i in range(n if has_bounds else 0):
                rows[at.step + i] += step[step_layout.x + i] - rows[at.estimate + i]
        return wrong

    def halve(row, numbers, count):
        for j in range(count):
            rows = row[scratch + j * width : scratch + (j + 2) * width]
            step = row[steps + j * end : steps + (j + 2) * end]
            back_off(rows, step, numbers)
            for i in range(n):
                step[step_layout.x + i] = rows[at.estimate + i]

    def begin_step(row, numbers, count):
        """Append a step without a measurement; its state is the belief's mean."""
        clip(row, mean)
        first = steps + count * end
        for i in range(end):
            row[first + i] = 0.0
        for i in range(n):
            row[first + step_layout.x + i] = row[mean + i]
        for i in range(channels):
            row[first + step_layout.z + i] = math.inf
        row[first + step_layout.fresh] = 1.0
        keep_sight(row, numbers, count)
        row[number] = count + 1.0

    def leave_first(row, numbers, count):
        """Drop the first step: its prediction of the second becomes the arrival cost of that."""
        forwards(row, numbers, 2, True)
        second = scratch + width
        leave(row[second : second + 2 * width], row[steps + end : steps + 3 * end], numbers)
        for i in range(n):
            row[arrival + i] = row[second + at.estimate + i]
        for i in range(square):
            row[arrival + n + i] = row[second + at.updated_cov + i]
        for i in range(steps, steps + (count - 1) * end):
            row[i] = row[i + end]
        row[number] = count - 1.0

    def add_step(row, numbers, count):
        begin_step(row, numbers, count)
        if count == int(numbers[horizon_offset]):
            leave_first(row, numbers, count + 1)

    def repeat_step(row, numbers, count):
        """Append a step at the same time as the last one, for another measurement."""
        last = steps + (count - 1) * end
        keep_motion(row, numbers, count - 1)
        for i in range(square):
            row[last + step_layout.Q + i] = 0.0
        row[last + step_layout.substeps] = 0.0
        add_step(row, numbers, count)

    def start(memory, numbers, size):
        row, _, _ = memory
        begin(memory, numbers, size)
        for i in range(number, numbers_offset):
            row[i] = 0.0
        for i in range(n):
            row[arrival + i] = row[mean + i]
        for i in range(square):
            row[arrival + n + i] = row[cov + i]
        begin_step(row, numbers, 0)

    def predict(memory, u, numbers, size):
        row, _, _ = memory
        count = int(row[number])
        copy(row, steps + (count - 1) * end + step_layout.u, u, 0, inputs)
        keep_motion(row, numbers, count - 1)
        predict_belief(memory, u, numbers, size)
        add_step(row, numbers, count)

    def iterate(row, numbers, count):
        """Make passes until all iterations are done and the right bounds hold, then one without bounds, for P."""
        fewest, patience, settled, least, wrong = 1 << 30, PATIENCE, False, math.inf, 0
        iterations = int(numbers[iterations_offset])
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

    def take(row, z, numbers):
        """Store a measurement with those of the same time; their errors are independent."""
        newest = steps + (int(row[number]) - 1) * end
        is_first, fits = True, True
        for i in range(channels):
            if row[newest + step_layout.z + i] < math.inf:
                is_first = False
                fits = fits and z[i] != z[i]
        if is_first:
            keep_sight(row, numbers, int(row[number]) - 1)
        else:
            for i in range(constants):
                fits = fits and row[newest + step_layout.seen_by + i] == numbers[constants_offset + i]
            for i in range(feed):
                fits = fits and row[newest + step_layout.acting + i] == row[acting + i]
            if not fits:
                repeat_step(row, numbers, int(row[number]))
                newest = steps + (int(row[number]) - 1) * end
        for i in range(channels):
            row[newest + step_layout.z + i] = z[i] if z[i] == z[i] else row[newest + step_layout.z + i]
        errors = known(z)
        for i in range(m):
            if errors[i] == errors[i]:
                for j in range(m):
                    joint = numbers[r_offset + i * m + j] if errors[j] == errors[j] else 0.0
                    row[newest + step_layout.R + i * m + j] = row[newest + step_layout.R + j * m + i] = joint

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
        extras=numbers_offset - acting,
        scratch=numbers_end + (room + 1) * width,
        acting=tuple(range(acting, number)),
        turns=len(shape.turns),
        measured_turns=len(shape.measured_turns),
    )


@cache
def known_errors(shape: Shape) -> Callable:
    """Return `known(z)`: numbers (m,) that are NaN where z misses them, all of a rotation if it misses one."""
    turns, m, channels = shape.measured_turns, shape.m, shape.channels
    if not turns:
        return same

    def without_error(z, c):
        return tuple(difference(z, z, turns))

    function = called_function(without_error, "x, c", (channels, 0), 0, (m,))
    read, store = vector_reader(channels), vector_writer(m)

    def known(z):
        errors = np.zeros(m)
        store(errors, function(read(z), ()))
        return errors

    return known


def same(z):
    """What it gets."""
    return z


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingHorizonFilter(Filter):
    """Moving-horizon estimation: Gauss and Newton's method for the most probable states of the last L steps.

        minimise  1/2 (x_1 - m)' P^-1 (x_1 - m) + 1/2 sum w_j' Q^-1 w_j + sum rho(r_j),
                  w_j = x_{j+1} - f(x_j, u_j),  r_j^2 = v_j' R^-1 v_j,  v_j = z_j - h(x_j),
        so that   low <= x_j <= high,  |w_j| <= limit sqrt(diag Q)

    over x_1 ... x_L; the estimate is x_L. An iteration is a forward pass of the extended filter and a backward
    pass of its smoother, both linearised along the states of the pass before; the first starts from the states of
    the last update and the prediction. When a step leaves the window, its prediction of the next one becomes the
    arrival cost of that: P = F P F' + Q by the extended filter along the estimate, and m such that the estimate
    does not change. The losses are

        quadratic  rho = r^2/2;  in a linear model without bounds the estimate is the Kalman filter's for any L
        huber      rho = r^2/2 up to the threshold k, from there on k r - k^2/2
        student    rho = (k^2 + d)/2 log(1 + r^2/k^2), of Student's t with k^2 degrees of freedom, for d channels

    The latter two divide R by a weight rho'(r)/r, which each pass computes again. Bounds of states are the model's
    `bounds`; its `bounded_by` has no meaning here. Components that are at a bound are found by an active set. If
    bounds of states and disturbances leave no room between them, the states keep theirs.

    The covariance of x_L follows from the last linearisation and weights, for the problem without bounds: it does
    not vanish if a bound holds. Innovation, S and log-likelihood are the extended filter's at the prediction, with
    R itself. An iteration that increases the cost is halved.

    Each step of the window keeps its dt, Q and R. Measurements of one time share a step; a second reading of a
    channel is a further step, to which the state does not move, and counts among the L.

    `Belief.extras` holds the number of steps, m, P, and of each step u, x, z, multipliers, Q, R and the model's
    constants; `window` reads x.

    Attributes:
        horizon: L, 1 to 200; with 1 it is an iterated extended filter.
        iterations: passes in an update, 1 to 50; with bounds up to 100 more until the right bounds hold.
        loss: "huber", "student" or "quadratic"; Student's may have several minima in a linear model, too.
        threshold: k of the loss, in standard deviations.
        disturbance_limit: of each w in its standard deviations; infinite for none.

    Raises:
        ValueError: if a parameter is out of its range, or the loss unknown.

    Source: Rao, Rawlings, Mayne (2003), "Constrained state estimation for nonlinear discrete-time systems", IEEE
    Trans. Automatic Control 48(2); a smoother's passes as iterations: Bell (1994), "The iterated Kalman smoother
    as a Gauss-Newton method", SIAM J. Optimization 4(3).
    """

    name: ClassVar[str] = "mhe"
    mixable: ClassVar[bool] = False  # mixing would change the estimate, but not its window
    horizon: int = 10
    iterations: int = 3
    loss: str = HUBER
    threshold: float = 2.0
    disturbance_limit: float = math.inf

    def __post_init__(self):
        object.__setattr__(self, "horizon", at_least("horizon", self.horizon, 1, MOST_STEPS))
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))
        one_of("loss", self.loss, LOSSES)
        object.__setattr__(self, "threshold", positive("threshold", self.threshold))
        if self.disturbance_limit != math.inf:
            object.__setattr__(self, "disturbance_limit", positive("disturbance_limit", self.disturbance_limit))

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """The threshold, the limit of disturbances, the horizon, and the iterations."""
        return self.threshold, self.disturbance_limit, float(self.horizon), float(self.iterations)

    @property
    def _kernel_horizon(self) -> int:
        return next(length for length in KERNEL_HORIZONS if length >= self.horizon)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return horizon_kernels(
            self.kernel_model.functions,
            self.kernel_model.any_shape if self.takes_rotations else self.kernel_model.shape,
            room=self._kernel_horizon,
            loss=self.loss,
            bounds=self.model.bounds,
            limited=self.disturbance_limit < math.inf,
        )

    @property
    def takes_rotations(self) -> bool:
        """Whether it takes the rotations of its model: without bounds; no direction steps back."""
        model = self.kernel_model
        free = not model.bounds and self.disturbance_limit == math.inf
        return free and all(turn.kind != "direction" for turn in model.turns)

    def window(self, belief: Belief) -> np.ndarray:
        """The last estimates (at most L, n) of the states of the window, the oldest first."""
        shape, n, t = self.kernel_model.any_shape, self.model.n, self.model.t
        layout, feed = kept_places(shape), shape.feed
        steps = belief.extras[feed + 1 + n + t * t :].reshape(self._kernel_horizon + 1, layout.end)
        return steps[: int(belief.extras[feed]), layout.x : layout.x + n].copy()
