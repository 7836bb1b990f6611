"""The optimal proposal: particles are drawn by what is measured, and weighted by how well it was predicted."""

from __future__ import annotations

from filters.algebra.blocks import zeros
from filters.algebra.densities import log_density
from filters.algebra.operations import divide, only, present, sym, uncorrelated, wrap
from filters.ensembles.steps import advance
from filters.pages.page import Page
from filters.particles import auxiliary
from filters.particles.weighted import expect


def start(model, w):
    """A particle of the prior, without noise."""
    x, kept = auxiliary.start(model, w)
    return x, {"noise_cov": sym(zeros(model.Q, len(w), len(w))), **kept}


def settle(model, x, w):
    """The end of a step, of which the noise and its Q are kept: a later update may meet another Q."""
    x, kept = auxiliary.settle(model, x, w)
    return x, {"noise_cov": model.Q, **kept}


def propose(model, x, d, Q, z, e):
    """Particles x = mu + d and their noise d ~ N(0, Q), moved by the measurement z; logarithms of their weights.

    Conditioning d on z in the manner of an ensemble filter, with a perturbation of z for each particle, makes of a
    sample of the prior one of the proposal. Without noise, and with Q = 0, nothing moves.
    """
    seen, mu = present(z), x - d
    H, R = only(seen, model.H(mu)), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - model.h(mu), model.measurement_angles))
    S = sym(H @ Q @ H.T + R)
    d = d + divide(Q @ H.T, S) @ (v - H @ d - only(seen, model.R_root @ e))
    x = mu + d
    rest = only(seen, wrap(z - model.h(x), model.measurement_angles))
    return x, d, log_density(v, S, seen) + log_density(rest, R, seen) - log_density(v - H @ d, R, seen)


def update(model, x, log_w, z, e):
    """The measurement z; channels that are NaN are missing."""
    _, v, S = expect(model, x, log_w, z)
    x, d, level = propose(model, x, model.kept["noise"], model.kept["noise_cov"], z, e)
    return (
        x,
        log_w + level,
        v,
        S,
        {"noise": zeros(model.Q, len(x)), "noise_cov": sym(zeros(model.Q, len(x), len(x)))},
    )


OPTIMAL = Page(advance, settle, update, start=start, of_each=("noise",))
