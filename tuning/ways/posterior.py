"""The posterior of a model's numbers by a random walk, of which the mean is taken."""

from __future__ import annotations

import math

import numpy as np

from tuning.problems.coordinates import Coordinates
from tuning.search.objectives import LIKELIHOOD
from tuning.ways.task import Task

DRAWS, WARM_UP = 2000, 500
DEVIATION = math.log(
    10.0
)  # of the prior, in coordinates: within a factor of ten, or a tenth of a linear range each
AIM_OF_ONE, AIM = 0.44, 0.234  # accepted part of the proposals, of one number and of many


def posterior(task: Task) -> None:
    """The mean over a Metropolis random walk of p(theta | z) in coordinates, with normal priors about the start.

        theta' = theta + s N(0, C),   accepted with min(1, p(z | theta') p(theta') / (p(z | theta) p(theta)))

    C is that of the draws so far, from 100 on, times 2.38^2/p; s follows the accepted part during the warm-up,
    which does not count. It needs no gradient, so it works for every filter with a likelihood.

    Sources: Haario, Saksman, Tamminen (2001), "An adaptive Metropolis algorithm", Bernoulli 7(2); Roberts,
    Rosenthal (2001), "Optimal scaling for various Metropolis-Hastings algorithms", Statistical Science 16(4).
    """
    coordinates = Coordinates(task.free)
    centre = np.clip(coordinates.of(task.values_of(task.start, task.free)), coordinates.low, coordinates.high)
    runs = task.passes / len(task.problems)  # the likelihood objective is the mean of a run and of problems
    p, generator = len(centre), task.generator

    def density(point: np.ndarray) -> float:
        if (point < coordinates.low).any() or (point > coordinates.high).any():
            return -math.inf
        choice = task.with_values(coordinates.values(point), task.free)
        return -len(task.problems) * runs * task.value(choice, LIKELIHOOD) - 0.5 * float(
            ((point - centre) ** 2).sum() / DEVIATION**2
        )

    point, here = centre, density(centre)
    spread, size, draws = 0.1 * np.eye(p), 1.0, []
    aim = AIM_OF_ONE if p == 1 else AIM
    for step in range(WARM_UP + DRAWS):
        root = np.linalg.cholesky(spread + 1e-12 * np.eye(p))
        other = point + size * root @ generator.standard_normal(p)
        there = density(other)
        chance = math.exp(min(there - here, 0.0))
        if generator.random() < chance:
            point, here = other, there
        draws.append(point)
        if step < WARM_UP:
            size *= math.exp((chance - aim) / math.sqrt(step + 1.0))
            if step >= 100 and step % 50 == 0:
                spread = 2.38**2 / p * np.atleast_2d(np.cov(np.array(draws[step // 2 :]), rowvar=False))
                size = 1.0
        if step % 100 == 99:
            counted = draws[WARM_UP:] if step >= WARM_UP else draws[len(draws) // 2 :]
            task.keep(task.with_values(coordinates.values(np.mean(counted, axis=0)), task.free))
