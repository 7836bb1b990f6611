"""The steps of a filter on tensors for one set of numbers, as they stand or compiled by `torch.compile`.

Nothing here asks the device for a number, so that a processor issues a step's operations without waiting for them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._pytree import tree_flatten, tree_unflatten

from filters.tensors.stages import Draw, Stages, normals_of, where
from thruster_env.graphs.programs import Place


class Estimate(NamedTuple):
    """Mean (..., n), covariance (..., n, n) and extras by name."""

    mean: Tensor
    cov: Tensor
    extras: dict[str, Tensor]


class Step(NamedTuple):
    """An estimate after an update; innovation, S and log density; and which trajectories (...,) are lost."""

    estimate: Estimate
    innovation: list[Tensor]
    lost: Tensor


class Numbers(NamedTuple):
    """What a recursion reads: the numbers of pages, the prior, R for restarts, and words of random numbers."""

    known: dict[Place, Tensor]
    prior_mean: Tensor  # (..., n), angles on their branch
    prior_cov: Tensor
    measurement_noise_cov: Tensor
    words: Tensor  # `draws.round_keys`


class Recursion:
    """The steps of a filter, for numbers that stay the same."""

    def __init__(self, stages: Stages, numbers: Numbers, size: int, substeps: int):
        """Take the stages of a page; `size` is of the ensemble."""
        self._stages, self._numbers, self._size, self._substeps = stages, numbers, size, substeps

    def _draw(self, step: int | Tensor) -> Draw:
        return normals_of(self._numbers.words, step, self._size, self._numbers.prior_mean)

    def prior(self, batch: tuple[int, ...], step: int | Tensor) -> Estimate:
        """The prior for a batch of trajectories, and those of the numbers."""
        mean, cov = self._numbers.prior_mean, self._numbers.prior_cov
        shape = torch.broadcast_shapes(batch, mean.shape[:-1], cov.shape[:-2])
        prior = mean.expand(*shape, -1), cov.expand(*shape, -1, -1)
        return Estimate(*self._stages.start(self._numbers.known, prior, self._draw(step)))

    def predict(self, estimate: Estimate, u: Tensor, step: int | Tensor) -> Estimate:
        """The estimate a step later, which has this number."""
        known = self._numbers.known
        return Estimate(*self._stages.predict(known, tuple(estimate), u, self._substeps, self._draw(step)))

    def update(self, estimate: Estimate, z: Tensor, step: int | Tensor) -> Step:
        """The estimate after z, and what is lost: not finite, or of a negative variance."""
        updated, innovation = self._stages.update(self._numbers.known, tuple(estimate), z, self._draw(step))
        return Step(Estimate(*updated), innovation, ~_all_finite(*updated[:2], *innovation))

    def first(self, z: Tensor) -> Step:
        """The prior, updated with the first measurements."""
        return self.update(self.prior(z.shape[:-1], 0), z, 0)

    def step(self, estimate: Estimate, u: Tensor, z: Tensor, step: int | Tensor) -> Step:
        """The estimate a step later, updated with measurements."""
        return self.update(self.predict(estimate, u, step), z, step)

    def restarted(self, after: Step, step: int) -> Step:
        """The prior in place of lost estimates, with R for S, and zero for innovation and log density."""
        lost, (mean, cov, extras), (v, s, level) = after.lost, after.estimate, after.innovation
        prior, sizes = self.prior(lost.shape, step), self._stages.extra_dimensions
        estimate = Estimate(
            where(lost, prior.mean, mean, 1),
            where(lost, prior.cov, cov, 2),
            {name: where(lost, prior.extras[name], extra, sizes[name]) for name, extra in extras.items()},
        )
        r = self._numbers.measurement_noise_cov
        innovation = where(lost, torch.zeros_like(v), v, 1), where(lost, r, s, 2), torch.where(lost, 0.0, level)
        return Step(estimate, [*innovation], lost)


class CompiledRecursion(Recursion):
    """The same steps, each as one program of `torch.compile` for the shapes of its arguments.

    The operations on tensors are recorded once, without the Python that issues them, and then fused.
    """

    def __init__(
        self, stages: Stages, numbers: Numbers, size: int, substeps: int, programs: dict[Any, tuple[Callable, Any]]
    ):
        """Take the stages of a page, and programs by name and shapes, to which further ones are added."""
        super().__init__(stages, numbers, size, substeps)
        self._programs = programs

    def first(self, z: Tensor) -> Step:
        """The prior, updated with the first measurements."""
        return self._run("first", Recursion.first, z)

    def step(self, estimate: Estimate, u: Tensor, z: Tensor, step: int | Tensor) -> Step:
        """The estimate a step later, updated with measurements."""
        number = torch.full((), int(step), device=z.device)
        return self._run("step", Recursion.step, estimate, u, z, number)

    def _run(self, name: str, function: Callable, *arguments: Any) -> Step:
        tensors, structure = tree_flatten((self._numbers, arguments))
        key = name, *((tensor.shape, tensor.dtype, tensor.device) for tensor in tensors)
        if key not in self._programs:
            self._programs[key] = self._compiled(function, tensors, structure)
        program, result = self._programs[key]
        return tree_unflatten(program(*tensors), result)

    def _compiled(self, function: Callable, tensors: list[Tensor], structure: Any) -> tuple[Callable, Any]:
        """A program of tensors, and the structure of its results."""
        results = []

        def flat(*tensors: Tensor) -> list[Tensor]:
            numbers, arguments = tree_unflatten(tensors, structure)
            plain = Recursion(self._stages, numbers, self._size, self._substeps)
            values, result = tree_flatten(function(plain, *arguments))
            results.append(result)
            return values

        recorded = make_fx(flat)(*(tensor.detach() for tensor in tensors))
        return torch.compile(recorded, dynamic=False), results[-1]


def _all_finite(mean: Tensor, cov: Tensor, *innovation: Tensor) -> Tensor:
    """Which beliefs (...,) and innovations consist of finite numbers, with variances that are not negative."""
    v, s, level = innovation
    sums = mean.abs().sum(-1) + cov.abs().sum((-2, -1)) + v.abs().sum(-1) + s.abs().sum((-2, -1)) + level.abs()
    return sums.isfinite() & (torch.diagonal(cov, dim1=-2, dim2=-1) >= 0).all(-1)
