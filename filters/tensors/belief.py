"""What filters on tensors return."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import Tensor


class TensorBelief(NamedTuple):
    """The estimates of a batch at one time.

    Attributes:
        mean: of the states, (..., n), in the units of the model.
        cov: covariances of the errors, (..., n, n).
        divergences: restarts from the prior, (...,).
        kept: what else the filter keeps, by the names of its page, such as an estimate of R; of an ensemble its
            `members` (..., n, N).
        key: on which an ensemble's random numbers depend, (..., 2) whole numbers.
        step: steps predicted, on which they depend, too.
    """

    mean: Tensor
    cov: Tensor
    divergences: Tensor
    kept: dict[str, Tensor]
    key: np.ndarray = np.zeros(2)
    step: int = 0

    @property
    def anomalies(self) -> Tensor:
        """The distances (..., n, N) of an ensemble's members from their mean."""
        members = self.kept["members"]
        return members - members.mean(-1, keepdim=True)


class TensorInnovation(NamedTuple):
    """Innovations of an update, as `Innovation` has them: (..., m), (..., m, m) and (...,)."""

    value: Tensor
    cov: Tensor
    log_likelihood: Tensor


class TensorEstimates(NamedTuple):
    """A filter's output over a batch of trajectories; as `Estimates` has it, but tensors.

    Attributes:
        means: (..., K + 1, n).
        covs: (..., K + 1, n, n).
        innovations: (..., K + 1, m); zero in missing channels.
        innovation_covs: S, (..., K + 1, m, m).
        log_likelihoods: (..., K + 1).
        divergences: restarts from the prior, (...,).
    """

    means: Tensor
    covs: Tensor
    innovations: Tensor
    innovation_covs: Tensor
    log_likelihoods: Tensor
    divergences: Tensor
