"""How the states of two successive steps are related by sigma points: pages of smoothers of such filters.

    points X = x 1' + g L U,  L L' = P;  predicted x and P as the filter predicts,
    G = cov(x, f(X)) (predicted P)^-1,  bracket = cov(X - G f(X)) + G Q G'

The bracket equals P - G (predicted P) G' and is a sum of squares.

Source: Sarkka (2008), "Unscented Rauch-Tung-Striebel smoother", algorithm 1, with additive noise; for cubature
points Arasaratnam, Haykin (2011), "Cubature Kalman smoothers".
"""

from __future__ import annotations

from filters.algebra.blocks import careful
from filters.algebra.operations import quotient, sym
from filters.algebra.points import others, root, square, units
from filters.gaussian import cubature, unscented
from filters.gaussian.unscented_points import advance, moments, scatter
from filters.smoothers.rts import Relation


def link_unscented(model, x, P, X):
    """The link of an unscented filter."""
    g, w, L, U = model.own.spread, model.own.weight, root(P), others(units(x))
    mean, s, D = moments(model, X, model.state_angles)
    C = (L @ (U @ D.T)) * (w * g)
    G = quotient(C, careful(scatter(model, D, s) + model.Q))
    left = scatter(model, (L * g) @ U - G @ D, G @ s)
    return mean, G, left + sym(G @ model.Q @ G.T)


def link_cubature(model, x, P, X):
    """The link of a cubature filter."""
    (g, w), L, U = model.own, root(P), others(units(x))
    mean, D = cubature.moments(model, X, model.state_angles)
    C = (L @ (U @ D.T)) * (w * g)
    G = quotient(C, careful(square(D) * w + model.Q))
    return mean, G, square((L * g) @ U - G @ D) * w + sym(G @ model.Q @ G.T)


UNSCENTED = Relation(unscented.begin, advance, link_unscented)
CUBATURE = Relation(cubature.begin, advance, link_cubature)
