"""The log-likelihood of the compiled recursion as a function that torch differentiates."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from filters.filter import Filter
from filters.likelihood import likelihood
from thruster_env.core.checks import as_floats
from thruster_env.core.sources import lower_pairs


def compiled_likelihood(filter_: Filter, inputs: Any, measurements: Any, q: Tensor, r: Tensor) -> Tensor:
    """Log-likelihoods (B,) of trajectories, with the gradient of `filters.likelihood` along Q and R.

    Args:
        filter_: a filter with a page.
        inputs: (B, K, p); None for a model without.
        measurements: (B, K + 1, m), NaN where missing.
        q: Q, (n, n).
        r: R, (m, m).
    """
    z = np.asarray(torch.as_tensor(as_numbers(measurements)).detach().cpu(), dtype=np.float64)
    if inputs is None:
        inputs = np.zeros((len(z), z.shape[1] - 1, 0))
    u = np.asarray(torch.as_tensor(as_numbers(inputs)).detach().cpu(), dtype=np.float64)
    return _Likelihood.apply(filter_, u, z, q, r)


def as_numbers(value: Any) -> Any:
    """A tensor, or a list of such, as it is; else an array of floats, NaN where something is missing."""
    if isinstance(value, Tensor) or isinstance(value, (list, tuple)) and any(isinstance(a, Tensor) for a in value):
        return value
    return np.ascontiguousarray(as_floats(value))


class _Likelihood(torch.autograd.Function):
    """The recursion, and its gradient along the entries of Q and R on and below the diagonal."""

    @staticmethod
    def forward(ctx, filter_, u, z, q, r):
        noise = [one.detach().cpu().double().numpy() for one in (q, r)]
        model = filter_.model.replace(process_noise_cov=noise[0], measurement_noise_cov=noise[1])
        counts = [
            len(lower_pairs(len(one))) * moves for one, moves in zip(noise, ctx.needs_input_grad[3:], strict=True)
        ]
        q_slopes, r_slopes = (np.zeros((sum(counts), *one.shape)) for one in noise)
        q_slopes[: counts[0]], r_slopes[counts[0] :] = (
            _units(len(one))[:k] for one, k in zip(noise, counts, strict=True)
        )
        found = likelihood(model, u, z, q_slopes, r_slopes, filter=filter_)
        ctx.save_for_backward(q, r, q.new_tensor(found.gradients))
        ctx.counts = counts
        return q.new_tensor(found.values)

    @staticmethod
    @once_differentiable
    def backward(ctx, of_values):
        q, r, gradients = ctx.saved_tensors
        entries = (of_values @ gradients).split(ctx.counts)
        return None, None, None, *(_symmetric(one, like) for one, like in zip(entries, (q, r), strict=True))


def _units(size: int) -> np.ndarray:
    """Symmetric matrices (pairs, size, size) with ones at a pair of places, the directions of `lower_pairs`."""
    found = np.zeros((len(lower_pairs(size)), size, size))
    for unit, (i, j) in zip(found, lower_pairs(size), strict=True):
        unit[i, j] = unit[j, i] = 1.0
    return found


def _symmetric(entries: Tensor, like: Tensor) -> Tensor | None:
    """The gradient G with dL = <G, dS>, of slopes along pairs of places; None if there are none."""
    if not len(entries):
        return None
    found = torch.zeros_like(like)
    rows, columns = torch.tensor(lower_pairs(len(like)), device=like.device).T
    found[rows, columns] = entries
    return 0.5 * (found + found.mT)  # halves beside the diagonal, for which there are two places
