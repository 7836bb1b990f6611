"""What is summed over a filter's steps, with its slopes: densities of innovations, or scores of true states."""

from __future__ import annotations

from typing import NamedTuple

from filters.algebra.densities import density, density_slope, dot, heavier, outlier_weight
from filters.algebra.derivatives import slopes_of
from filters.algebra.matrices import Matrix
from filters.algebra.operations import factor, inverse, present, quotient, uncorrelated
from filters.differentiated.memory import Memory

LIKELIHOOD, LOG_SCORE, SQUARES = "likelihood", "log-score", "squares"  # what is summed over steps


class Wanted(NamedTuple):
    """What is worked out: a score, with its gradient, and what stands beside it."""

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
    memory: Memory, v: Matrix, s: Matrix, moves: dict, tail: Matrix, wanted: Wanted
) -> tuple[dict, dict]:
    """The log density of an innovation, and of a parameter its slope, and what the information takes of both."""
    seen, of = present(memory.z), factor(s)
    w, e = quotient(v, of), inverse(of, seen)
    level, weighted = density(v, of, seen), w
    if wanted.tails:
        q = dot(v, w)
        level, weighted = level + heavier(q, seen, tail), w * outlier_weight(q, seen, tail)
    dv, ds = slopes_of([v, s], moves)
    slopes = {memory.slope: density_slope(w, weighted, e, dv, ds)}
    if wanted.information:
        m = memory.shape.m
        slopes |= {memory.noted: dv, memory.noted + m: ds}
        slopes |= {memory.weighed: e @ dv, memory.weighed + m: (e @ ds @ e) * 0.5}
    return {memory.level: level}, slopes


def score_of_truth(memory: Memory, off: Matrix, cov: Matrix, moves: dict, score: str) -> tuple[dict, dict]:
    """A score of the estimate, given its error without the states that do not count, and its slope."""
    if score == SQUARES:
        weighted = memory.weights @ off
        doff = slopes_of([off], moves)[0]
        slope = None if doff is None else dot(weighted, doff) * -2.0
        return {memory.level: dot(weighted, off) * -1.0}, {memory.slope: slope}
    known = present(memory.truth)
    s = uncorrelated(known, cov)
    of = factor(s)
    w = quotient(off, of)
    slope = density_slope(w, w, inverse(of, known), *slopes_of([off, s], moves))
    return {memory.level: density(off, of, known)}, {memory.slope: slope}
