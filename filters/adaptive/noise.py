"""The second moment of the measurement noise, from which adaptive and robust filters estimate R."""

from __future__ import annotations

from thruster_env.numerics.algebra.operations import divide, eye, only, sym, uncorrelated
from thruster_env.numerics.algebra.points import outer


def noise_moment(seen, HPH, R, v):
    """E[v v' | z] of v ~ N(0, R) in z = h(x) + v, for the part H P H' of S and an innovation.

    With S = H P H' + R and G = R S^-1: E[v | z] = G innovation, and in Joseph's form cov(v | z) is
    (I - G) R (I - G)' + G H P H' G'; the moment is positive definite whatever is measured. Channels that are
    missing carry no information; their part of the moment follows from the others through R.
    """
    G = divide(only(seen, R).T, sym(HPH + uncorrelated(seen, R)))
    A, e = eye(R) - G, G @ v
    return outer(e, e) + sym(A @ R @ A.T) + sym(G @ HPH @ G.T)
