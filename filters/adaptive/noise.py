"""What filters that estimate R and Q share: the moment of the measurement noise, bounded steps, factors."""

from __future__ import annotations

from filters.algebra.operations import divide, eye, only, sym, uncorrelated
from filters.algebra.points import outer
from filters.algebra.scalars import choose, exceeds, is_number, trace
from thruster_env.core.checks import finite


def noise_moment(seen, HPH, R, v):
    """E[v v' | z] of v ~ N(0, R) in z = h(x) + v, for the part H P H' of S and an innovation.

    With S = H P H' + R and G = R S^-1: E[v | z] = G innovation, and in Joseph's form cov(v | z) is
    (I - G) R (I - G)' + G H P H' G'; the moment is positive definite whatever is measured. Channels that are
    missing carry no information; their part of the moment follows from the others through R.
    """
    G = divide(only(seen, R).T, sym(HPH + uncorrelated(seen, R)))
    A, e = eye(R) - G, G @ v
    return outer(e, e) + sym(A @ R @ A.T) + sym(G @ HPH @ G.T)


def bounded_step(A, more, less, d):
    """A + d (more - less), with d shortened to 1/(2 trace(A^-1 less)) if that is less.

    With A positive definite, and `more` and `less` positive semidefinite, `less` is at most trace(A^-1 less) A, so
    the result is at least A/2. A matrix A that is not positive definite stays as it is.
    """
    size = trace(divide(less, A))
    d = choose(exceeds(d * size, 0.5), 0.5 / size, d)
    return choose(is_number(size), A + (more - less) * d, A)


def part_that_is_kept(name: str, value) -> float:
    """Return value as a float; raise ValueError unless it is above 0 and at most 1."""
    factor = finite(name, value)
    if not 0.0 < factor <= 1.0:
        raise ValueError(f"{name} must be above 0 and at most 1, but got {factor}")
    return factor
