"""What the training of an estimator minimises: squared errors, or the log density of the truth."""

from __future__ import annotations

import torch
from torch import Tensor

from filters.learned.estimator import LearnedEstimator, Track
from filters.tensors.stages import density, factor


class Loss:
    """The loss of a step, of means (B, n) and covariances: zero for runs that are not scored there.

    Without a covariance the weighted mean square, with weights that have the slope of the score where the starting
    filter is; with one the log density of the true states that count:

        sum over states of w e^2,  w = 1/(scale * error of the starting filter)
        (e' P^-1 e + log det 2 pi P)/2

    It is NaN where P is not positive definite; the training then leaves out the update.
    """

    def __init__(self, estimator: LearnedEstimator, scale):
        """Of an estimator and the scale (n,) of a problem's score, infinite for states that do not count."""
        scale = torch.as_tensor(scale, dtype=torch.float64)
        self._states = torch.isfinite(scale).nonzero()[:, 0]
        self._has_covariance = estimator.has_covariance
        self._wrapped = estimator.equations.of_state
        count = len(self._states)
        self._weights = 1.0 / (scale * estimator.scale_error[: len(scale)])[self._states] / count
        self._extra = estimator.model.n - len(scale)

    def __call__(self, track: Track, truth: Tensor, scored: Tensor) -> Tensor:
        """The sum over the runs (B,) that are scored, at a step with true states (B, n)."""
        known = torch.where(scored[:, None], truth, 0.0)
        whole = torch.nn.functional.pad(known, (0, self._extra))
        error = self._wrapped(track.mean - whole)[:, self._states]
        if not self._has_covariance:
            return torch.where(scored, (self._weights * error**2).sum(-1), 0.0).sum()
        assert track.cov is not None
        root = factor(track.cov[:, self._states[:, None], self._states])
        return torch.where(scored, -density(error, root, torch.ones_like(error, dtype=torch.bool)), 0.0).sum()
