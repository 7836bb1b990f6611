"""The recursion of a filter over runs, with derivatives of its log-likelihood along parameters of the model.

Derivatives are made from the page by the rules of matrix calculus and of `thruster_env.graphs`. Tuning follows
them in three steps: a `ParametricModel` makes a model and its slopes from parameters, an objective its value,
gradient and information from runs, and `tuning.likelihood.ascent` climbs. `filters.sensitivity` differentiates
the *model* along each parameter in one recursion, of which Fisher's scoring needs a tenth of the evaluations of
L-BFGS-B.

In order: the layout of the memory, with the matrices that stand for its numbers; the score of a step and its
slope; the compiled recursion. A stage works on several runs side by side in memory, but sums are kept for each
run, so the grouping of runs has no effect.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import lru_cache
from math import prod
from typing import Any, NamedTuple

import numpy as np

from filters.algebra.matrices import Matrix, input_matrix
from filters.algebra.operations import (
    factor,
    inverse,
    mask_missing,
    present,
    quotient,
    slopes_of,
    uncorrelated,
    wrap,
)
from filters.algebra.points import density, density_slope, dot, heavier, outlier_weight, root
from filters.algebra.tangents import differences, local_at
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.pages.kernels import Stage, as_calls, as_programs, as_tuple, stage_of, with_extras
from filters.pages.page import Equations, NumbersMemory, Page, PagedModel
from thruster_env.graphs.graphs import uncollected
from thruster_env.graphs.programs import Place, callable_of
from thruster_env.model.shape import (
    Functions,
    Shape,
    constants_reader,
    starts_of,
)
from thruster_env.model.traced import most_operations

LIKELIHOOD, LOG_SCORE, SQUARES = "likelihood", "log-score", "squares"  # summed over steps
EXTENDED = ExtendedKalmanFilter.page
AT_ONCE = 4  # runs of a program: of eight each would take a fifth less, but a run alone twice as long


class Memory(NumbersMemory):
    """The arrays of `thruster_env.graphs.programs`, for a model's sizes.

        rows      x, P, extras; the same after a stage; u, z; the score; the true x; scratch of the slopes
        change    by parameter: dx, dP, d extras; d score; for the information `notes` numbers, twice
        numbers   the model's; tails of two densities (`points.tail_of`); the filter's own; weights of errors
        move      by parameter: dQ, dR, dc, the relative size of dc; dx and dP at the start; d own parameters

    Matrices lie by rows. `rows` and `change` hold one number for each run. During a step, a filter of points has
    its points in the place of x and P.

    Attributes:
        predicted: the predicted quantities: x and P, or the points.
        moves: the slope of each matrix that a parameter may move, except constants and own parameters.
        constants_slope, own_slopes: slopes of the constants, and of the filter's own parameters.
    """

    def __init__(self, shape: Shape, page: Page):
        n, m, t, layout = shape.n, shape.m, shape.t, shape.offsets
        tail = layout.constants + shape.constants
        self.tail, self.predicted_tail = tail, tail + m + 2
        own_at = self.predicted_tail + m + 2
        x = input_matrix(Place("rows", 0), (n,))
        super().__init__(shape, page, x, input_matrix(Place("rows", n), (t, t), symmetric=True, like=x), own_at)
        self.Q_root, self.prior_root = root(self.Q), root(self.P)  # where a filter starts P is that of the prior
        model = PagedModel(self)
        predicted = (x, self.P) if page.represent is None else as_tuple(page.represent(model, x, self.P))
        started = page.started(model)
        self.begun, self.notes = n + t * t, m + m * m
        starts = starts_of(*(prod(matrix.shape) for matrix in predicted))
        self.extras_from = max(self.begun, starts[-1])
        of_extras = starts_of(self.extras_from, *(prod(matrix.shape) for matrix in started.values()))[1:]
        self.state = of_extras[-1]
        self.left, self.input, self.measured, self.level, self.true, self.length = starts_of(
            self.state, self.state, shape.inputs, shape.channels, 1, n
        )[1:]
        self.slope = self.state  # of the score
        self.noted, self.weighed, self.depth = starts_of(self.state + 1, self.notes, self.notes)[1:]
        r, c, size, self.prior, own_slopes = starts_of(t * t, m * m, shape.constants, 1, self.begun)[1:]
        self.u, self.z = (
            self.read("rows", self.input, shape.inputs),
            self.read("rows", self.measured, shape.channels),
        )
        self.ratio = self.ratio_in("rows", self.input)
        self.tails = [self.read("numbers", first, m + 2) for first in (tail, self.predicted_tail)]
        self.truth = self.read("rows", self.true, n)
        self.weights = self.read("numbers", own_at + page.own_size, t, t, symmetric=True)
        self.constants_slope = self.read("move", c, shape.constants)
        self.size = self.read("move", size)
        self.moves: dict[Matrix, Matrix] = {
            self.x: self.read("change", 0, n),
            self.P: self.read("change", n, t, t, symmetric=True),
            self.Q: self.read("move", 0, t, t, symmetric=True),
            self.R: self.read("move", r, m, m, symmetric=True),
        }
        self.predicted = [self.x, self.P]
        if page.represent is not None:
            self.predicted = [self._moving(at, matrix) for at, matrix in zip(starts, predicted, strict=False)]
        self.extras = {
            name: self._moving(at, matrix) for at, (name, matrix) in zip(of_extras, started.items(), strict=False)
        }
        slopes = page.parameters(lambda offset, size: self.read("move", own_slopes + offset, *size))
        self.own_slopes = dict(zip(self.own[: len(page.own)], slopes, strict=False))

    def _moving(self, at: int, like: Matrix) -> Matrix:
        """A matrix like another one in `rows`, with its slope at the same offset in `change`."""
        value, slope = (
            self.read(array, at, *like.shape, symmetric=like.symmetric) for array in ("rows", "change")
        )
        self.moves[value] = slope
        return value


class Wanted(NamedTuple):
    """The outputs of a recursion: a score with its gradient, and options."""

    information: bool  # Fisher's
    constants: bool  # slopes along the model's constants
    tails: bool  # densities with more outliers than the normal one, and channels that are predicted only
    score: str = LIKELIHOOD  # of the innovations; or of the true states, which are given then
    own: bool = False  # slopes along the filter's own parameters

    @property
    def of_truth(self) -> bool:
        """Whether the score is one of the true states."""
        return self.score != LIKELIHOOD


def density_of(
    memory: Memory, z: Matrix, v: Matrix, s: Matrix, moves: dict, tail: Matrix, wanted: Wanted
) -> tuple[dict, dict]:
    """The log density of an innovation, its slope along a parameter, and the terms of the information."""
    measured, of = present(z), factor(s)
    w, e = quotient(v, of), inverse(of, measured)
    level, weighted = density(v, of, measured), w
    if wanted.tails:
        q = dot(v, w)
        level, weighted = level + heavier(q, measured, tail), w * outlier_weight(q, measured, tail)
    dv, ds = slopes_of([v, s], moves)
    slopes = {memory.slope: density_slope(w, weighted, e, dv, ds)}
    if wanted.information:
        m = memory.shape.m
        slopes |= {memory.noted: dv, memory.noted + m: ds}
        slopes |= {memory.weighed: e @ dv, memory.weighed + m: (e @ ds @ e) * 0.5}
    return {memory.level: level}, slopes


def score_of_truth(
    memory: Memory, known: Matrix, off: Matrix, cov: Matrix, moves: dict, score: str
) -> tuple[dict, dict]:
    """A score of the estimate, given its error without the states that are not known, and its slope."""
    if score == SQUARES:
        weighted = memory.weights @ off
        doff = slopes_of([off], moves)[0]
        slope = None if doff is None else dot(weighted, doff) * -2.0
        return {memory.level: dot(weighted, off) * -1.0}, {memory.slope: slope}
    s = uncorrelated(known, cov)
    of = factor(s)
    w = quotient(off, of)
    slope = density_slope(w, w, inverse(of, known), *slopes_of([off, s], moves))
    return {memory.level: density(off, of, known)}, {memory.slope: slope}


class Recursion(NamedTuple):
    """A compiled recursion; see `runs` for its arguments."""

    run: Callable
    at_once: int  # runs
    length: int  # of the memory `rows`
    depth: int  # of `change`

    def sizes(self, parameters: int) -> tuple[tuple[int, ...], ...]:
        """Shapes of the arrays that the recursion works in, its last arguments but the first and last run."""
        changes = max(parameters, 1), self.depth * self.at_once
        return (self.length * self.at_once,), changes, (parameters, parameters, self.at_once), (self.at_once,)


@lru_cache(maxsize=64)
@uncollected()
def recursion_of(functions: Functions, shape: Shape, wanted: Wanted, page: Page, interpreting: bool) -> Recursion:
    """The recursion of a filter's page for a model's functions and sizes; interpreting or not is one each."""
    memory = Memory(shape, page)
    try:
        model = Equations(functions, memory, constants_move=wanted.constants, trace=True)
        stages = stages_of(memory, model, wanted, page)
        compiled = [as_programs(stage, memory.length, most_operations(shape)) for stage in stages]
        works = [callable_of(program, AT_ONCE) for programs in compiled for program in programs[:2]]
        at_once = AT_ONCE
    except Exception:  # a user's function cannot be traced, whatever it raises: it is called instead
        model = Equations(functions, memory, constants_move=wanted.constants, trace=False)
        readers = {memory.constants: constants_reader(shape)}
        compiled = [
            as_calls(stage, memory.length, model.called, readers)
            for stage in stages_of(memory, model, wanted, page)
        ]
        works = [work for calls in compiled for work in calls[:2]]
        at_once = 1
    length = max(stage.length for stage in compiled)
    if page.initial is None and not shape.feeds:
        works[:0] = nothing, nothing
    if page.represent is None:
        works[2:2] = nothing, nothing
    accumulate = _accumulator(memory, works, wanted, page, at_once)
    return Recursion(_as_loops(accumulate), at_once, length, memory.depth)


def _as_loops(accumulate: Callable) -> Callable:
    from thruster_env.graphs.loops import Loops

    dimensions = dict.fromkeys(inspect.signature(accumulate).parameters, 1)
    dimensions |= {"turns": 0, "first": 0, "last": 0, "begins": 2, "moves": 2, "changes": 2}
    dimensions |= dict.fromkeys(("inputs", "measurements", "truth", "out", "information", "outputs"), 3)
    return Loops(accumulate, [(None,) * count if count else None for count in dimensions.values()])


def nothing(rows, change, numbers, move):
    """Do nothing, in place of a stage that a filter does not have."""


def stages_of(memory: Memory, model: Equations, wanted: Wanted, page: Page = EXTENDED) -> list[Stage]:
    """The stages of a step, and with tails the density of channels that are predicted only."""
    x, p = memory.x, memory.P
    moves = dict(memory.moves)
    if wanted.constants:
        assert memory.constants_slope is not None
        moves[memory.constants] = memory.constants_slope
    if wanted.own:
        moves |= memory.own_slopes

    def belief_stage(results: Any, more: dict | None = None, slopes: dict | None = None) -> Stage:
        """A stage that stores results of the page and its extras, with their slopes."""
        *values, changed = with_extras(results)
        extras = {name: changed.get(name, extra) for name, extra in memory.extras.items()}
        starts = starts_of(*(prod(value.shape) for value in values))
        left = dict(zip(starts, values, strict=False)) | _by_offset(memory, extras)
        stage = stage_of({memory.left + at: value for at, value in left.items()} | (more or {}), left, moves)
        still = {at: value * 0.0 for at, value in _by_offset(memory, changed).items() if at not in stage.slopes}
        return stage._replace(slopes=still | stage.slopes | (slopes or {}))

    stages = []
    if page.initial is not None or model.feed:
        started = _by_offset(memory, page.started(model))
        stage = stage_of(started, started, moves)
        stages.append(stage._replace(slopes={at: value * 0.0 for at, value in started.items()} | stage.slopes))
    model.extras = memory.extras
    if page.represent is not None:
        stages.append(belief_stage(page.represent(model, x, p)))
    stages += [
        belief_stage(page.propagated(model, *memory.predicted, u=memory.u)),
        belief_stage(page.add_process_noise(model, *memory.predicted)),
    ]
    local, z = local_at(model, memory.z, x)
    mean, cov, v, s, _, changed = with_extras(page.update(local, x, p, z))
    if wanted.of_truth:
        known = present(differences(model, memory.truth, memory.truth) if model.turns else memory.truth)
        off = mask_missing(known, differences(model, memory.truth, mean))
        of_truth = score_of_truth(memory, known, off, cov, moves, wanted.score)
        stages.append(belief_stage((mean, cov, changed), *of_truth))
        return stages
    stages.append(belief_stage((mean, cov, changed), *density_of(memory, z, v, s, moves, memory.tails[0], wanted)))
    if wanted.tails:
        measured = present(z)
        v = mask_missing(measured, wrap(z - local.h(x), local.measurement_angles))
        stages.append(
            Stage(*density_of(memory, z, v, uncorrelated(measured, model.R), moves, memory.tails[1], wanted))
        )
    return stages


def _by_offset(memory: Memory, extras: Mapping[str, Matrix]) -> dict[int, Matrix]:
    return {memory.extras[name].operation.at: extra for name, extra in extras.items()}


def _accumulator(memory: Memory, works: list[Callable], wanted: Wanted, page: Page, at_once: int) -> Callable:
    """The recursion over steps of some runs."""
    start, start_slopes, begin, begin_slopes, advance, advance_slopes, add_noise, add_noise_slopes = works[:8]
    update, update_slopes = works[8:10]
    predicted, predicted_slopes = works[10:] or works[8:10]  # not called, if there are none
    begun, state, left, first_part = memory.begun, memory.state, memory.left, 0 if page.represent is None else -1
    first_input, first_measured, level, slope = memory.input, memory.measured, memory.level, memory.slope
    prior, noted, weighed, notes = memory.prior, memory.noted, memory.weighed, memory.notes
    inputs_count, channels, informative = memory.shape.inputs, memory.shape.channels, wanted.information
    first_true, true_states = memory.true, memory.shape.n if wanted.of_truth else 0
    nan = np.nan
    substeps = memory.shape.offsets.substeps

    def accumulate(
        inputs,
        measurements,
        truth,
        begins,
        numbers,
        moves,
        moves_prior,
        counted_from,
        fed,
        turns,
        out,
        information,
        rows,
        changes,
        outputs,
        counted,
        first,
        last,
    ):
        count = out.shape[2] - 1
        for b in range(first, last, at_once):
            lanes = min(at_once, last - b)  # beyond, the last run again
            for j in range(at_once):
                run = b + min(j, lanes - 1)
                for i in range(begun):
                    rows[i * at_once + j] = begins[run, i]
                    for q in range(count):
                        changes[q, i * at_once + j] = moves[q, prior + i] * moves_prior[run]
            start(rows, changes[0], numbers, moves[0])
            for q in range(count):
                start_slopes(rows, changes[q], numbers, moves[q])
                for r in range(count):
                    for j in range(at_once):
                        outputs[q, r, j] = 0.0
            for k in range(measurements.shape[1]):
                if k > 0:
                    for j in range(at_once):
                        for i in range(inputs_count):
                            rows[(first_input + i) * at_once + j] = inputs[b + min(j, lanes - 1), k - 1, i]
                    for part in range(first_part, int(numbers[substeps]) + 1):
                        if part < 0:
                            begin(rows, changes[0], numbers, moves[0])
                            for q in range(count):
                                begin_slopes(rows, changes[q], numbers, moves[q])
                        elif part < int(numbers[substeps]):
                            advance(rows, changes[0], numbers, moves[0])
                            for q in range(count):
                                advance_slopes(rows, changes[q], numbers, moves[q])
                        else:
                            add_noise(rows, changes[0], numbers, moves[0])
                            for q in range(count):
                                add_noise_slopes(rows, changes[q], numbers, moves[q])
                        for i in range(state):
                            for j in range(at_once):
                                rows[i * at_once + j] = rows[(left + i) * at_once + j]
                block = k * out.shape[1] // measurements.shape[1]
                for turn in range(turns):
                    for j in range(at_once):
                        run = b + min(j, lanes - 1)
                        counted[j] = 1.0 if k >= counted_from[run] else 0.0
                        for i in range(channels):
                            z = measurements[run, k, i]
                            rows[(first_measured + i) * at_once + j] = z if fed[i] == 1.0 - turn else nan
                        for i in range(true_states):
                            rows[(first_true + i) * at_once + j] = truth[run, k, i]
                    if turn == 0:
                        update(rows, changes[0], numbers, moves[0])
                        for q in range(count):
                            update_slopes(rows, changes[q], numbers, moves[q])
                        for i in range(state):
                            for j in range(at_once):
                                rows[i * at_once + j] = rows[(left + i) * at_once + j]
                    else:
                        predicted(rows, changes[0], numbers, moves[0])
                        for q in range(count):
                            predicted_slopes(rows, changes[q], numbers, moves[q])
                    for j in range(lanes):
                        if counted[j] > 0.0:
                            out[b + j, block, 0] += rows[level * at_once + j]
                            for q in range(count):
                                out[b + j, block, 1 + q] += changes[q, slope * at_once + j]
                    if informative:
                        for q in range(count):
                            for r in range(q + 1):
                                for i in range(notes):
                                    for j in range(at_once):
                                        product = (
                                            changes[q, (noted + i) * at_once + j]
                                            * changes[r, (weighed + i) * at_once + j]
                                        )
                                        outputs[q, r, j] += product if counted[j] > 0.0 else 0.0
            if informative:
                for j in range(lanes):
                    for q in range(count):
                        for r in range(q + 1):
                            information[b + j, q, r] = information[b + j, r, q] = outputs[q, r, j]

    return accumulate
