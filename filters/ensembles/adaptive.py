"""Inflation that adapts to the innovations: a function of an ensemble's page that returns one that does more.

    predict: x_j = mean + t^1/2 (x_j - mean) at the end of the step
    update:  t = max(1, t + u), u the mode of  (1 + g u) exp(-u^2/(2 deviation^2)),
             g = d log N(v; 0, (t'/t) A + R)/dt' at t' = t,  A = S - R the forecast's own part of S

One factor t is kept in the belief; it begins at 1. Before each update it is normal with a standard
deviation that does not shrink, so that it can follow a model whose errors change; its likelihood is linear about
the last value. An error of the model which is not in Q widens the innovations, and so the ensemble.

With a factor for each state, t_i is that of state i, and its likelihood is that of all channels while it alone
moves:

    g_i = d log N(v; 0, D A D + R)/dt' at t' = t_i,  D_kk = (1 + c_ik (t'^1/2 - 1))/(1 + c_ik (t_i^1/2 - 1)),
    c_ik = taper of i and k times |correlation of x_i and y_k| in the forecast

so that of a single state it is the same, if h is linear.

With an inverse gamma prior, p(t') ~ t'^-(a+1) exp(-(a+1) t/t'), whose mode is t, the standard deviation follows
the measurements, too. It is kept in the belief as the width p = 1/(a+1), behind the factors:

    (deviation/t)^2 = p/((1 - 2p)^2 (1 - 3p)),  p at first that of `adaptive_inflation`, later between it and
                      that of `least_deviation`
    update:  t+ = t (1 + e), the mode of (1 + g (t' - t)) p(t');  p+ = p/(1 - 2d + d^2/p),  d = 1 - t/t+,
             the inverse gamma density with the posterior's mode and its curvature there;  t = max(1, t+)

Sources: Anderson (2007), "An adaptive covariance inflation error correction algorithm for ensemble filters", for
one factor; the linear likelihood and factors of states are those of Anderson (2009), "Spatially and temporally
varying adaptive covariance inflation for ensemble filters", here of all channels at once. The inverse gamma prior:
El Gharamti (2018), "Enhanced adaptive inflation algorithm for ensemble filters", Monthly Weather Review 146, which
finds the new deviation from a second point of the posterior instead of its curvature.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from filters.algebra.densities import dot
from filters.algebra.members import correlations, mean
from filters.algebra.operations import divide, factor, inverse, present, uncorrelated
from filters.algebra.points import outer
from filters.algebra.scalars import at_least, choose, constant, diagonal, exceeds
from filters.ensembles.steps import expect
from filters.pages.page import Page


def slopes(model, x, z, v, S):
    """Return g, or each g_i, of members x before the update, by 1/2 tr((w w' - S^-1) dA/dt'), w = S^-1 v."""
    seen, w, ones, t = present(z), divide(v, S), constant(1.0, v), model.kept["factor"]
    A = S - uncorrelated(seen, model.R)
    # Sums of the rows of M o A, M = w w' - S^-1, for 1/2 tr(M (E A + A E)) of a diagonal E is their sum by E.
    scores = ((outer(w, w) - inverse(factor(S), seen)) * A) @ ones
    if not np.shape(t):
        return dot(scores, ones) / (2.0 * t)
    c, root = abs(correlations(x, expect(model, x, z))), t**0.5
    if hasattr(model.own, "taper"):
        c = c * model.own.taper
    return ((c / (1.0 + diagonal(root - 1.0) @ c)) @ scores) / (2.0 * root)  # E = dD/dt' where D = I


def moved(t, g, deviation):
    """The mode of the normal prior times the likelihood, at least 1."""
    # A root of u^2 + u/g - deviation^2, the larger one where g is positive, else the smaller; 1 where g is NaN.
    product = 2.0 * g * (deviation * deviation)
    return at_least(t + product / (1.0 + (1.0 + 2.0 * g * product) ** 0.5), 1.0)


def relative_move(h, p):
    """Return e where the mode is 1 + e of (1 + h e) times an inverse gamma density of mode 1 and width p."""
    # The root with the sign of h of (1 - p) h e^2 + (1 - 2 p h) e - p h.
    along = 1.0 - 2.0 * p * h
    return 2.0 * p * h / (along + (along * along + 4.0 * p * (1.0 - p) * h * h) ** 0.5)


def moved_with_width(t, p, g, narrowest, widest):
    """The same of an inverse gamma prior, and its width; 1 and the widest where the likelihood is no number."""
    e = relative_move(t * g, p)  # what follows compares NaN as false
    d = e / (1.0 + e)
    p = p / (1.0 - 2.0 * d + d * d / p)
    p = choose(exceeds(widest - p, 0.0), p, widest)
    return at_least(t * (1.0 + e), 1.0), choose(exceeds(p - narrowest, 0.0), p, narrowest)


@cache
def adapted(page: Page) -> Page:
    """A page with a factor for each number of `model.own.deviation`, or of the `widest` width."""

    def start(model):
        own = model.own
        if hasattr(own, "widest"):
            return {"factor": constant(1.0, own.widest), "width": own.widest}
        return {"factor": constant(1.0, own.deviation)}

    def settle(model, x, w):
        x = page.settle(model, x, w)
        return mean(x) + (x - mean(x)) * model.kept["factor"] ** 0.5

    def update(model, x, z, e):
        after, v, S, level = page.update(model, x, z, e)
        t, own = model.kept["factor"], model.own
        g = slopes(model, x, z, v, S)
        if not hasattr(own, "widest"):
            return after, v, S, level, {"factor": moved(t, g, own.deviation)}
        t, p = moved_with_width(t, model.kept["width"], g, own.narrowest, own.widest)
        return after, v, S, level, {"factor": t, "width": p}

    return page._replace(start=start, settle=settle, update=update)
