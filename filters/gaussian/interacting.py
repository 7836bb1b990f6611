"""The interacting multiple model filter, for a plant that switches among several models.

How the filters of the modes are mixed, run and merged is in `filters.gaussian.modes`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from filters.algebra.densities import dot
from filters.gaussian.multiple_models import MultipleModelFilter, probabilities_of
from thruster_env.core.checks import between, positive


def mixing(p, mu):
    """Weights mu_i|j with which mode j begins a step, and its probability c_j; p is column j of Pi."""
    c = dot(p, mu)
    return p * mu / c, c


@dataclass(frozen=True, kw_only=True, eq=False)
class InteractingMultipleModelFilter(MultipleModelFilter):
    """Interacting multiple models (IMM): the plant is in one of K modes, each with its own model and filter.

        mix:     c_j = sum over i of Pi_ij mu_i,  mu_i|j = Pi_ij mu_i/c_j; the filter of mode j begins with
                 x0_j = sum of mu_i|j x_i,  P0_j = sum of mu_i|j (P_i + (x_i - x0_j)(x_i - x0_j)')
        predict: each filter with its model
        update:  each filter; L_j = N(v_j; 0, S_j),  mu_j = c_j L_j/L,  L = sum of c_j L_j
        merge:   mean = sum of mu_j x_j,  P = sum of mu_j (P_j + (x_j - mean)(x_j - mean)')

    mu are the probabilities of the modes (`mode_probabilities`), Pi_ij that of mode j a step after mode i. Unless
    it is given, Pi = stay I + (1 - stay) 1 p': a step keeps its mode with probability `stay`, and else draws one
    with probabilities p, which are those of the first step, too. The log-likelihood is log L; innovation and S
    are those of the mixture before the measurement.

    Modes are models, or changes of `model`, such as `{"measurement_noise_cov": 100 * R}`. Without modes there are
    two, the model and the same with R times `outlier_scale`, with probabilities 1 - `outlier_rate` and
    `outlier_rate`: a filter for outliers. What a mode lacks of the model's states the others say (unbiased mixing,
    `filters.gaussian.absent`), or `absent` does: moments with which such a state begins in the modes that have it.

    Probabilities are kept as logarithms, so that a mode whose probability is below the least float64 comes back if
    measurements speak for it. `Belief.extras` holds the memory of the modes' filters, then these logarithms: see
    `mode_estimates`.

    Attributes:
        stay: probability that a step keeps its mode without a draw, within 0 and 1.
        transition: Pi (K, K), whose rows sum to 1, in place of `stay`.
        outlier_scale: factor on R in the second mode, where no modes are given.
        outlier_rate: probability of that mode.

    Raises:
        ValueError: if models are of other sizes, probabilities do not sum to 1, or a filter is no Gaussian one.

    Source: Blom, Bar-Shalom (1988), "The interacting multiple model algorithm for systems with Markovian switching
    coefficients"; Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation,
    section 11.6.6; unequal states: Granstrom, Willett, Bar-Shalom (2015).
    """

    name: ClassVar[str] = "imm"
    mixing: ClassVar[Callable] = staticmethod(mixing)
    stay: float = 0.9
    transition: Any = None
    outlier_scale: float = 100.0
    outlier_rate: float = 0.05

    def __post_init__(self):
        """Check the numbers; raise ValueError that states the rule and the value."""
        for name, check in (("stay", between), ("outlier_rate", between), ("outlier_scale", positive)):
            ends = (0.0, 1.0) if check is between else ()
            object.__setattr__(self, name, check(name, getattr(self, name), *ends))
        super().__post_init__()

    @property
    def usual_modes(self) -> Sequence[Mapping[str, Any]]:
        """The model, and the same with a larger R."""
        return {}, {"measurement_noise_cov": self.outlier_scale * self.model.measurement_noise_cov}

    @property
    def usual_probabilities(self) -> Sequence[float] | np.ndarray:
        """As outliers come, where no modes are given; else all equal."""
        return (
            super().usual_probabilities if self.modes is not None else (1.0 - self.outlier_rate, self.outlier_rate)
        )

    @property
    def transition_matrix(self) -> np.ndarray:
        """Pi (K, K): the probability of mode j a step after mode i."""
        count, given = len(self.mode_filters), self.transition
        given = self.stay * np.eye(count) + (1.0 - self.stay) * self.p if given is None else given
        return probabilities_of("transition", given, (count, count))
