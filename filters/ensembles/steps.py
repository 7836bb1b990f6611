"""What the pages of ensemble filters share: motion, and what a measurement says of the members."""

from __future__ import annotations

from filters.algebra.densities import log_density
from filters.algebra.members import covariance, mean, on_branch
from filters.algebra.operations import only, present, sym, uncorrelated, wrap


def advance(model, x, u):
    """One of the model's substeps."""
    return model.f(x, u)


def settle(model, x, w):
    """The end of a step."""
    return on_branch(x + model.Q_root @ w, model.state_angles)


def expect(model, x, z):
    """What a member expects to be measured; zero in channels that are NaN in z."""
    return on_branch(only(present(z), model.h(x)), model.measurement_angles)


def compare(model, x, z):
    """A member's y less their mean, cov(x, y), innovation v, S, R, log N(v; 0, S).

    Covariances are tapered where a filter has tapers between channels.
    """
    seen, y = present(z), expect(model, x, z)
    R = uncorrelated(seen, model.R)
    v = only(seen, wrap(z - mean(y), model.measurement_angles))
    C, A = covariance(x, y), covariance(y, y)
    if hasattr(model.own, "between"):
        C, A = C * model.own.taper, sym(A * model.own.between)
    S = A + R
    return y - mean(y), C, v, S, R, log_density(v, S, seen)
