"""Multiple model adaptive estimation: which one of several models is right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from filters.gaussian.multiple_models import MultipleModelFilter

USUAL_FACTORS = (0.1, 1.0, 10.0)  # on Q


@dataclass(frozen=True, kw_only=True, eq=False)
class MultipleModelAdaptiveEstimator(MultipleModelFilter):
    """Multiple model adaptive estimation (MMAE): one of K models is right at all times, and the data say which.

        mu_j is proportional to mu_j L_j,  L_j = N(v_j; 0, S_j); each filter runs by itself
        mean = sum of mu_j x_j,  P = sum of mu_j (P_j + (x_j - mean)(x_j - mean)')

    Without modes these are the model with Q times 0.1, 1 and 10. The log-likelihood is that of the mixture, and so
    are innovation and S; `mode_probabilities` and `mode_estimates` say more. Probabilities are kept as
    logarithms: a model whose probability has come to nothing comes back if as much evidence speaks for it. All of
    a run counts, so where the plant switches, take `imm`.

    Raises:
        ValueError: if models are of other sizes, probabilities do not sum to 1, or a filter is no Gaussian one.

    Source: Magill (1965), "Optimal adaptive estimation of sampled stochastic processes".
    """

    name: ClassVar[str] = "mmae"

    @property
    def usual_modes(self) -> Sequence[Mapping[str, Any]]:
        """The model with a smaller Q, its own, and a larger one."""
        return [{"process_noise_cov": factor * self.model.process_noise_cov} for factor in USUAL_FACTORS]
