"""The iterated ensemble Kalman filter and its smoother over a window of steps.

    window   x_0j the members L steps ago, w_kj ~ N(0, Q) the noise of the steps since; both are in the belief
    motion   x_kj = f(x_(k-1)j, u_k) + w_kj,  k = 1 ... L, so that y_j = h(x_Lj) is a function of all these
    update   Gauss-Newton as in `IteratedEnsembleKalmanFilter`, for the state (x_0, w_1 ... w_L)

Each iteration runs the motion again from the new start of the window; each step keeps its constants of the model,
such as dt. The next step moves x_0 by the first step of the window, drops that step, and adds its own noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import ClassVar, NamedTuple

from filters.algebra.matrices import input_matrix
from filters.algebra.members import covariance, mean, on_branch
from filters.algebra.operations import divide, geometric_mean, mask_missing, present, wrap
from filters.engine.belief import Kernels, filter_offset, memory_offsets
from filters.ensembles.ensemble import EnsembleFilter, add_process_noise, compare, expect, propagate
from filters.ensembles.stochastic import relax_row, row_moments, stretch_row
from filters.pages.kernels import MembersMemory, Stage, anything_measured, stored
from filters.pages.kernels import member_stages_of as stages_of
from filters.pages.kernels import member_works_of as works_of
from filters.pages.page import Page
from thruster_env.core.checks import at_least
from thruster_env.core.streams import FILTER_PRIOR, FILTER_PROCESS, fill_normals
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import Functions, Shape, number_offsets
from thruster_env.model.state_space import refuse_feed

MOST_ITERATIONS = 20  # which programs repeat without a loop
LONGEST_WINDOW = 1000  # steps


def linearised_again(model, y, z, Y, v, S, R):
    """Slopes Y T^-1 and innovation z - mean(y) + Y w from y of members that the last Y, v and S have moved."""
    E = covariance(y, Y)
    D = divide(E, R + geometric_mean(R, S))
    shift = divide(E + D @ (S - R), S) @ v
    v = mask_missing(present(z), wrap(z - mean(y), model.measurement_angles)) + shift
    return y - mean(y) + D @ Y, v


def pull(Y, v, S, R):
    """S^-1 v - (S + R # S)^-1 Y: the update moves a variable by its covariance with Y times this."""
    return divide(v, S) - divide(Y, S + geometric_mean(R, S))


class WindowPlaces(NamedTuple):
    """Layout of the window: rows of the table, then offsets in the belief's row."""

    window: int  # x_0, then the noise, n rows for each step
    iterate: int  # the window of an iteration, scratch
    slopes: int  # Y, m rows
    pull: int  # m rows
    scratch: int  # of programs
    steps: int  # number of steps in the window so far
    inputs: int  # of these steps, each followed by its constants
    numbers: int  # of a step, scratch
    innovation: int  # v of an iteration, scratch
    innovation_cov: int  # S of an iteration


def window_places(shape: Shape, length: int) -> WindowPlaces:
    """Layout of a window of `length` steps."""
    n, m, rows = shape.n, shape.m, shape.n * (length + 1)
    iterate, first = n + rows, memory_offsets(n, m).extras
    slopes, v = iterate + rows, first + 1 + length * (shape.inputs + shape.constants)
    return WindowPlaces(n, iterate, slopes, slopes + m, slopes + 2 * m, first, first + 1, v + m + m * m, v, v + m)


@cache
def window_stages(length: int) -> Callable:
    """Return `stages(page, memory, model)`: motion and moments of a page, the first iteration, and later ones."""

    def stages(page: Page, memory: MembersMemory, model) -> dict[str, Stage]:
        m, z, layout = memory.shape.m, memory.z, window_places(memory.shape, length)
        row = memory_offsets(memory.shape.n, m)
        Y, B = (
            input_matrix(Place("table", at), (m,), member=True, like=memory.x)
            for at in (layout.slopes, layout.pull)
        )
        v = memory.read("rows", layout.innovation, m)
        S = memory.read("rows", layout.innovation_cov, m, m, symmetric=True)
        first, _, first_v, first_S, R, level = compare(model, memory.x, z)
        later, later_v = linearised_again(model, expect(model, memory.x, z), z, Y, v, S, R)
        later_S = covariance(later, later) + R
        outputs = row.innovation, row.innovation_cov, row.log_likelihood
        plain = stages_of(page, memory, model)
        noise = input_matrix(Place("table", layout.iterate), (memory.shape.n,), member=True, like=memory.x)
        return {
            **{name: plain[name] for name in ("start", "propagate", "summarise")},
            "draw": stored((model.Q_root @ memory.w,), (noise,)),
            "add_process_noise": stored((on_branch(memory.x + memory.w, model.state_angles),), (memory.x,)),
            "update": stored(
                (first, pull(first, first_v, first_S, R), first_v, first_S, first_v, first_S, level),
                (Y, B, v, S, *outputs),
            ),
            "again": stored((later, pull(later, later_v, later_S, R), later_v, later_S), (Y, B, v, S)),
        }

    return stages


def copy_rows(table, source, target, count):
    """Copy `count` rows from `source` to `target`, the first row first."""
    for i in range(count):
        for j in range(table.shape[1]):
            table[target + i, j] = table[source + i, j]


def pull_row(table, source, target, slopes, pulls, count, size):
    """Set row target to row source + its covariance with `count` rows of slopes times rows of pulls."""
    mean = 0.0
    for j in range(size):
        mean += table[source, j] / size
    for j in range(table.shape[1]):
        table[target, j] = table[source, j]
    for k in range(count):
        slope = 0.0
        for j in range(size):
            slope += (table[source, j] - mean) * table[slopes + k, j]
        slope /= size - 1.0
        for j in range(table.shape[1]):
            table[target, j] += slope * table[pulls + k, j]


@lru_cache(maxsize=64)
def window_kernels(page: Page, functions: Functions, shape: Shape, length: int, iterations: int) -> Kernels:
    """Kernels of a window of `length` steps; the page's `model.own` has inflation and relaxation.

    Both act on the whole estimated state (x_0, w_1 ... w_length): inflation in each prediction, relaxation in each
    update.
    """
    n, m, p, at = shape.n, shape.m, shape.inputs, window_places(shape, length)
    works = works_of(page, functions, shape, window_stages(length), at.scratch)
    names = "start", "propagate", "draw", "add_process_noise", "summarise", "update", "again"
    begin, propagate, draw, add_process_noise, moments_of, look, again = (works[name].work for name in names)
    row_offsets, substeps = memory_offsets(n, m), number_offsets(n, m).substeps
    step_offset, key_0, key_1 = row_offsets.step, row_offsets.key_0, row_offsets.key_1
    offsets = page.parameter_offsets(filter_offset(shape))
    inflation, relaxation, rows = offsets["inflation"], offsets["relaxation"], n * (length + 1)
    window, iterate, slopes, pulls, _, steps, inputs, then_offset, _, _ = at
    constants, constants_offset = shape.constants, number_offsets(n, m).constants
    count, size_of_step = filter_offset(shape) + page.own_size, p + shape.constants

    def start(memory, numbers, size):
        row, table, draws = memory
        fill_normals(draws, n * table.shape[1], row[step_offset], FILTER_PRIOR, row[key_0], row[key_1])
        begin(row, numbers, numbers, table, draws, size)
        for k in range(1 + length * size_of_step):
            row[steps + k] = 0.0
        copy_rows(table, 0, window, n)
        for i in range(window + n, window + rows):
            for j in range(table.shape[1]):
                table[i, j] = 0.0

    def move(memory, source, k, numbers, size):
        """Propagate the members by step k of the window that begins at row `source`: start, then noise."""
        row, table, draws = memory
        first, then, width = inputs + k * size_of_step, row[then_offset : then_offset + count], table.shape[1]
        u = row[first : first + p]
        for i in range(count):
            then[i] = numbers[i]
        for i in range(constants):
            then[constants_offset + i] = row[first + p + i]
        for i in range(n):
            for j in range(width):
                draws[i * width + j] = table[source + (k + 1) * n + i, j]
        for _ in range(int(numbers[substeps])):
            propagate(row, u, then, table, draws, size)
        add_process_noise(row, u, then, table, draws, size)

    def run_window(memory, source, numbers, size):
        row, table, _ = memory
        copy_rows(table, source, 0, n)
        for k in range(int(row[steps])):
            move(memory, source, k, numbers, size)

    def drop(memory):
        row, table, _ = memory
        copy_rows(table, window + 2 * n, window + n, rows - 2 * n)
        for k in range((length - 1) * size_of_step):
            row[inputs + k] = row[inputs + size_of_step + k]
        row[steps] -= 1.0

    def admit(memory, u, numbers, size):
        """Append a step, whose noise begins at row `iterate`; then inflate."""
        row, table, _ = memory
        k = int(row[steps])
        first = inputs + k * size_of_step
        for i in range(p):
            row[first + i] = u[i]
        for i in range(constants):
            row[first + p + i] = numbers[constants_offset + i]
        copy_rows(table, iterate, window + (k + 1) * n, n)
        row[steps] += 1.0
        if numbers[inflation] != 1.0:
            for i in range(window, window + rows):
                stretch_row(table, i, numbers[inflation], size)

    def predict(memory, u, numbers, size):
        row, table, draws = memory
        row[step_offset] += 1.0
        fill_normals(draws, n * table.shape[1], row[step_offset], FILTER_PROCESS, row[key_0], row[key_1])
        draw(row, u, numbers, table, draws, size)
        full, k = row[steps] == length, 0
        if not full:
            admit(memory, u, numbers, size)
        copy_rows(table, window, 0, n)
        while k < row[steps]:
            move(memory, window, k, numbers, size)
            k += 1
            if full:  # the window starts here from now on
                full, k = False, 0
                copy_rows(table, 0, window, n)
                drop(memory)
                admit(memory, u, numbers, size)
                copy_rows(table, window, 0, n)

    def update(memory, z, numbers, size):
        row, table, draws = memory
        look(row, z, numbers, table, draws, size)
        if anything_measured(z):
            for iteration in range(1, iterations + 1):
                for i in range(rows):
                    pull_row(table, window + i, iterate + i, slopes, pulls, m, size)
                    if iteration == iterations and numbers[relaxation] > 0.0:
                        _, before = row_moments(table, window + i, size)
                        relax_row(table, iterate + i, before, numbers[relaxation], size)
                run_window(memory, iterate, numbers, size)
                if iteration < iterations:
                    again(row, z, numbers, table, draws, size)
            copy_rows(table, iterate, window, rows)
        summarise(memory, size)

    def summarise(memory, size):
        row, table, draws = memory
        moments_of(row, row, row, table, draws, size)

    used = max(at.scratch, *(work.rows for work in works.values()))
    scratch = m + m * m + count
    sizes = 1 + length * size_of_step, rows, scratch  # extras of the row, kept rows of the table, scratch
    return Kernels(n, m, used, max(n, m), start, predict, update, summarise, *sizes)


def update(model, x, z, e):
    """Update with the measurement z (NaN: missing); Y are the slopes of h along the members' deviations."""
    Y, C, v, S, R, level = compare(model, x, z)
    outputs = v, S, level
    for _ in range(1, model.own.iterations):
        y = expect(model, x + (divide(C, S) @ v - divide(C, S + geometric_mean(R, S)) @ Y), z)
        Y, v = linearised_again(model, y, z, Y, v, S, R)
        C, S = covariance(x, Y), covariance(Y, Y) + R
    return x + (divide(C, S) @ v - divide(C, S + geometric_mean(R, S)) @ Y), *outputs


@dataclass(frozen=True, kw_only=True, eq=False)
class IteratedEnsembleKalmanFilter(EnsembleFilter):
    """Iterated ensemble Kalman filter (IEnKF) over one update, for nonlinear measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q);  X (n, N) the members' distances from their mean
        update:  least over w (N,) of (N - 1) w'w + (z - h(mean + X w))' R^-1 (z - h(mean + X w)), by Gauss-Newton:
                 from w = 0 and T = I on, `iterations` times,
                 y_j = h(mean + X w + X T e_j),  Y = (y - mean(y)) T^-1,  S = Y Y'/(N - 1) + R,
                 w = Y' S^-1 (z - mean(y) + Y w)/(N - 1),  T = (I + Y' R^-1 Y/(N - 1))^-1/2;
                 then x_j = mean + X w + X T e_j,  e_j the j-th unit vector

    So the slopes of h are those at the estimate, averaged over its uncertainty. One iteration is the
    `EnsembleTransformFilter`; if h is linear, further ones change nothing. T and its inverse are symmetric and N x
    N, and never formed. The innovation and its covariance are those of the first iteration.

    Steps are not damped: if the measurement fits several states, iterations may jump between them. If a
    measurement is far more accurate than the forecast, T^-1 amplifies any nonlinearity of h along unobserved
    directions, and iterations gain little.

    With a `window` of L steps this is the iterative ensemble Kalman smoother (IEnKS) of lag L, which uses each
    measurement once and shifts the window by one step: mean and X are those of x_0, L steps ago, and of the
    process noise w_1 ... w_L since, and each iteration computes y_j = h(x_Lj) by x_kj = f(x_(k-1)j, u_k) + w_kj
    again. So the slopes include those of f. If f and h are linear, the estimates are those without a window.
    `Belief.members` then is (n (L + 2), N): the members now, those at the window's start given all measurements
    since, and w_1 ... w_L; `Belief.extras` holds the number of steps in the window so far, with the input and the
    model's constants of each.

    Attributes:
        iterations: evaluations of h by all members in an update, 1 to 20; with a window, each with its steps of f.
        window: number L of steps that an update estimates again, 0 to 1000; with 0 the motion stays as predicted.
            With a window inflation and relaxation act on x_0 and the noise, and there is no adaptive_inflation.
            The others are those of `EnsembleFilter`.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Sakov, Oliver, Bertino (2012), "An iterative EnKF for strongly nonlinear systems"; over the update
    alone it is the filter of Zupanski (2005), "Maximum likelihood ensemble filter: theoretical aspects", solved as
    in Bocquet, Sakov (2012), "Combining inflation-free and iterative ensemble Kalman filters for strongly
    nonlinear systems". With a window: Bocquet, Sakov (2014), "An iterative ensemble Kalman smoother"; noise that
    is estimated, too: Sakov, Haussaire, Bocquet (2018), "An iterative ensemble Kalman filter in the presence of
    additive model error", here with one ensemble of states and noise.
    """

    name: ClassVar[str] = "ienkf"
    page: ClassVar[Page] = Page(propagate, add_process_noise, update)
    unrolled: ClassVar[tuple[str, ...]] = ("iterations",)
    iterations: int = 3
    window: int = 0

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))
        object.__setattr__(self, "window", at_least("window", self.window, 0, LONGEST_WINDOW))
        if self.window:
            refuse_feed(self.model, f"the model of {self.name!r} with a window")
        if self.window and self.adaptive_inflation:
            rule = f"window of a filter with adaptive_inflation {self.adaptive_inflation:g} must be 0"
            raise ValueError(f"{rule}, but got {self.window}")

    @property
    def by_parts(self) -> bool:
        """Whether an update also runs the motion again, which the page does not contain."""
        return bool(self.window)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        if not self.window:
            return super().kernels()
        page, model = self.page_with(False, False), self.kernel_model
        return window_kernels(page, model.functions, model.shape, self.window, self.iterations)
