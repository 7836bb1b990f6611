"""The effect of leaving out samples beyond a gate on the variance of the rest, and on standard errors."""

from __future__ import annotations

import math


def kept_variance(gate: float) -> float:
    """Variance of a standard normal number that is kept where its magnitude is at most c.

        E[x^2 | |x| <= c] = 1 - 2 c phi(c)/(2 Phi(c) - 1)

    Args:
        gate: c, positive; infinite for no gate, where it is 1.

    Source: Johnson, Kotz, Balakrishnan (1994), Continuous Univariate Distributions, volume 1, section 13.10.1.
    """
    return 1.0 - _edge(gate)


def lost_information(gate: float) -> float:
    """How much larger the variance of an estimated log-variance is: 2/var(x^2 | |x| <= c), 1 without a gate.

    That of a constant, 1/kappa^2 with kappa the `kept_variance`, is smaller.
    """
    variance = kept_variance(gate)
    fourth = 3.0 * variance - (_edge(gate) * gate**2 if gate < math.inf else 0.0)
    return 2.0 / (fourth - variance**2)


def _edge(gate: float) -> float:
    """2 c phi(c)/(2 Phi(c) - 1)."""
    if gate > 38.0:  # phi is no number of floating point any more
        return 0.0
    return 2.0 * gate * math.exp(-0.5 * gate**2) / math.sqrt(2.0 * math.pi) / math.erf(gate / math.sqrt(2.0))
