"""A Gaussian sum filter: each update splits the belief, so that it may have several modes, and merges it again."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import ClassVar

import numpy as np

from filters.baselines.baselines import place_of
from filters.engine.belief import Belief, Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.filter import Filter
from filters.gaussian import extended
from filters.gaussian.mixture import blender, part_update
from filters.pages.kernels import anything_measured, nothing_to_summarise, page_kernels
from thruster_env.numerics.checks import at_least
from thruster_env.numerics.compiled import inlined
from thruster_env.plants.shape import Functions, Shape

FEWEST_PARTS, MOST_PARTS = 7, 1000
REACH = 4.5  # of the outermost parts, in standard deviations of the split component
OVERLAP = 0.6  # standard deviation of a part, over the distance from one to the next


@lru_cache(maxsize=64)
def gaussian_sum_kernels(functions: Functions, shape: Shape, *, parts) -> Kernels:
    """Kernels for model functions, sizes and a number of parts; extras as the class says."""
    n, m = shape.n, shape.m
    places, own = memory_places(n, m), own_place(shape)
    stride, likelihood_place = n + n * n + 1 + m + m * m + 1, places.log_likelihood
    mean_place, cov_place, means = places.mean, places.cov, places.extras
    covs, weights, seen = means + n, means + n + n * n, means + n + n * n + 1
    seen_covs, likelihoods = seen + m, seen + m + m * m
    of_states = blender(n, means, covs, weights, stride, shape.state_angles)
    of_innovations = blender(m, seen, seen_covs, weights, stride, shape.measurement_angles)
    component_place, variance_place, nodes_place, shares_place = own, own + 1, own + 2, own + 2 + parts
    _, (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    condition = part_update(functions, shape)
    plain = page_kernels(extended.ExtendedKalmanFilter.page, functions, shape)
    begin, predict = plain.start, plain.predict

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        begin(memory, numbers, size)
        for k in range(parts * stride):
            row[means + k] = 0.0

    @inlined
    def update_parts(row, z, numbers):
        """Split the belief and update each part by itself; its weight is still that before the measurement."""
        i = int(numbers[component_place])
        variance = row[cov_place + i * (n + 1)]
        narrower = (numbers[variance_place] - 1.0) / variance if variance > 0.0 else 0.0
        for k in range(parts):
            part = row[means + k * stride : means + (k + 1) * stride]
            step = numbers[nodes_place + k] * variance**-0.5 if variance > 0.0 else 0.0
            for a in range(n):
                along = row[cov_place + a * n + i]
                part[a] = row[mean_place + a] + step * along
                for b in range(n):
                    part[n + a * n + b] = (
                        row[cov_place + a * n + b] + narrower * along * row[cov_place + b * n + i]
                    )
            part[n + n * n] = numbers[shares_place + k]
            condition(part, z, numbers)

    @inlined
    def weigh(row):
        """Weights after the measurement; returns the log of what they summed up to."""
        top = row[likelihoods]
        for k in range(parts):
            top = row[likelihoods + stride * k] if row[likelihoods + stride * k] > top else top
        total = 0.0
        for k in range(parts):
            row[weights + stride * k] *= math.exp(row[likelihoods + stride * k] - top)
            total += row[weights + stride * k]
        for k in range(parts):
            row[weights + stride * k] /= total
        return top + math.log(total)

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        update_parts(row, z, numbers)
        innovation, s = of_innovations(row, parts)
        store_innovation(row, innovation)
        store_s(row, s)
        row[likelihood_place] = 0.0
        if anything_measured(z):
            row[likelihood_place] = weigh(row)
            mean, p = of_states(row, parts)
            store_mean(row, mean)
            store_cov(row, p)

    return Kernels(n, m, n, 0, start, predict, update, nothing_to_summarise, extras=parts * stride)


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianSumFilter(Filter):
    """Gaussian sum filter: an extended filter whose belief is a sum of Gaussians within each update.

        predict: the extended filter's
        split:   along g = P e_i/sqrt(P_ii), the way in which the state goes with its component i, into parts
                 N(mean + t_k g, P - (1 - s^2) g g') of weight a_k; nodes t_k, weights a_k and s < 1 are those of a
                 sum of N(t_k, s^2) with mean 0 and variance 1, so that mean and covariance stay the belief's
        update:  each part by the extended filter, with h and H at its own mean;
                 its weight becomes a_k N(z; h(x_k), S_k)/L,  L = sum of a_k N(z; h(x_k), S_k)
        merge:   mean and P of the weighted parts: P within the parts and between them

    A measurement may thus have several solutions in component i; one linearisation at the mean finds only one. The
    log-likelihood is log L; innovation and S are those of the mixture before the measurement. On an affine model
    this is the Kalman filter to some thousandths of a standard deviation, for the sum has thinner tails than a
    Gaussian.

    `Belief.extras` holds what the last update made of each part: mean, covariance, weight, innovation, its
    covariance and its log-likelihood; `part_estimates` takes the first three apart.

    Attributes:
        parts: number of Gaussians, at least 7.
        component: index i of the component along which the belief is split; -1 is the last.

    Raises:
        ValueError: if parts or component is out of its range.

    Source: Alspach, Sorenson (1972), "Nonlinear Bayesian estimation using Gaussian sum approximations"; splitting
    along one direction: Faubel, McDonough, Klakow (2009), "The split and merge unscented Gaussian mixture filter".
    """

    name: ClassVar[str] = "gsf"
    gaussian_likelihood: ClassVar[bool] = False
    parts: int = 15
    component: int = -1

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        object.__setattr__(self, "parts", at_least("parts", self.parts, FEWEST_PARTS, MOST_PARTS))
        object.__setattr__(self, "component", place_of("component", self.component, self.model.n))

    @cached_property
    def standard_split(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Nodes t (parts,), weights a (parts,) and variance s^2 of a sum of Gaussians like N(0, 1)."""
        nodes = np.linspace(-REACH, REACH, self.parts)
        variance = (OVERLAP * (nodes[1] - nodes[0])) ** 2
        weights = np.exp(-0.5 * nodes**2)
        weights /= weights.sum()
        return nodes * np.sqrt((1.0 - variance) / (weights @ nodes**2)), weights, float(variance)

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """The component, s^2, nodes and weights."""
        nodes, weights, variance = self.standard_split
        return (float(self.component), variance, *nodes, *weights)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return gaussian_sum_kernels(self.kernel_model.functions, self.kernel_model.shape, parts=self.parts)

    def part_estimates(self, belief: Belief) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means (parts, n), covariances (parts, n, n) and weights (parts,) that the last update merged."""
        n, held = self.model.n, belief.extras.reshape(self.parts, -1)
        means, covs, weights, _ = np.split(held, [n, n + n * n, n + n * n + 1], axis=1)
        return means.copy(), covs.reshape(-1, n, n).copy(), weights[:, 0].copy()
