"""Moments of a normal distribution of which only a part is possible.

Source: Johnson, Kotz, Balakrishnan (1994), Continuous Univariate Distributions, volume 1, section 13.10.1.
"""

from __future__ import annotations

import math

from thruster_env.core.compiled import inlined

FAR = 5.0  # standard deviations, from which a continued fraction is used
VERY_FAR = 100.0  # from which the moments are series, whose next terms are 1e-10 of them
NEVER = -37.0  # beyond which exp(a^2/2) would not be finite; what lies below it has no probability
NARROW = 1e-4  # standard deviations, up to which the part is taken as uniform
TERMS = 60  # of the fraction


@inlined
def mills_ratio(a):
    """(1 - Phi(a))/phi(a) of the standard normal distribution: the probability beyond a over the density at a."""
    if a < FAR:
        a = max(a, NEVER)
        return math.sqrt(0.5 * math.pi) * math.exp(0.5 * a * a) * math.erfc(a * math.sqrt(0.5))
    rest = a
    for k in range(TERMS, 0, -1):
        rest = a + k / rest
    return 1.0 / rest


@inlined
def truncated_normal(low, high):
    """Mean and variance of a standard normal number between two bounds, of which one may be infinite.

        d = m(a) - e m(b),  e = exp((a^2 - b^2)/2),  mean = (1 - e)/d,  variance = 1 + (a - b e)/d - mean^2

    with Mills' ratio m, in the order in which b >= |a|; with e = 0 for one bound.
    """
    sign, a, b = 1.0, low, high
    if low + high < 0.0:
        sign, a, b = -1.0, -high, -low
    if b - a < NARROW:
        return sign * 0.5 * (a + b), (b - a) * (b - a) / 12.0
    e = math.exp(-0.5 * (b - a) * (b + a)) if b < math.inf else 0.0
    if a > VERY_FAR and e < 1e-16:
        s = 1.0 / (a * a)
        return sign * (a + (1.0 - s * (2.0 - 10.0 * s)) / a), s * (1.0 - s * (6.0 - 50.0 * s))
    d, end = mills_ratio(a), a
    if e > 0.0:
        d, end = d - e * mills_ratio(b), a - b * e
    mean = (1.0 - e) / d
    return sign * mean, max(1.0 + end / d - mean * mean, 0.0)
