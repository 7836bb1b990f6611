"""Pages of ensembles on states with rotations, directions or poses: in the tangent at the mean of the members.

An ensemble's page adds and averages vectors of its members. For a state that turns it gets their errors instead,

    m = intrinsic mean of the x_j,  D_j = difference(x_j, m),  x_j = move(m, D_j) afterwards

with h of the moved members, and with the root of Q brought from each member's own tangent to that at m. So the
page itself does not change.

Source: Karcher (1977), "Riemannian center of mass and mollifier smoothing", Communications on Pure and Applied
Mathematics 30(5), for the mean, here by a fixed number of steps m := move(m, mean of D).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import cache
from typing import Any

from filters.algebra.members import covariance, mean, on_branch
from filters.algebra.operations import wrap
from filters.algebra.points import weighted_covariance, weighted_mean
from filters.algebra.roots import zeros
from filters.algebra.tangents import differences, inverse_reset_slopes, local_at, moved, reset_back, unit
from filters.pages.page import Page
from thruster_env.model.turns import tangent_flags

ROUNDS = 6  # of the mean, from the normalised mean of the stored numbers: to 1e-9 for a spread of half a radian


def moments(model: Any, x: Any) -> tuple[Any, Any]:
    """The mean (n,) and the covariance (t, t) of the members."""
    if not model.turns:
        return wrap(mean(x), model.state_angles), covariance(x, x)
    m = mean_of(model, x)
    D = differences(model, x, m)
    return wrap(m, model.state_angles), covariance(D, D)


def weighted_moments(model: Any, x: Any, w: Any, P: Any | None) -> tuple[Any, Any, Any]:
    """Members near their weighted mean, that mean (n,) and the covariance (t, t); P is that of each member."""
    if not model.turns:
        x = on_branch(x, model.state_angles, w)
        cov = weighted_covariance(x, w)
        return x, wrap(weighted_mean(x, w), model.state_angles), cov if P is None else cov + weighted_mean(P, w)
    m = mean_of(model, x, lambda d: weighted_mean(d, w))
    D = differences(model, x, m)
    cov = weighted_covariance(D, w)
    if P is not None:  # each about its own member
        cov = cov + weighted_mean(reset_back(model, P, m, D), w)
    return moved(m, D, model.turns), wrap(m, model.state_angles), cov


def mean_of(model: Any, x: Any, average: Callable = mean) -> Any:
    """The intrinsic mean (n,) of the members."""
    m = unit(average(x), model.turns)
    for _ in range(ROUNDS):
        m = moved(m, average(differences(model, x, m)), model.turns)
    return m


@cache
def renewed(rejuvenate: Callable) -> Callable:
    """A particle filter's `rejuvenate` of a state with rotations, from one for numbers: at the particles' mean."""

    def rejuvenate_there(model: Any, x: Any, mean: Any, P: Any, e: Any) -> Any:
        D = differences(model, x, mean)
        after = rejuvenate(_chart(model), D, zeros(P, len(P)), P, e)
        after, *extras = after if isinstance(after, tuple) else (after,)
        return moved(mean, after, model.turns), *extras

    return rejuvenate_there


@cache
def on_tangent(page: Page) -> Page:
    """The page of a state with rotations, from one that is written for numbers."""
    return page._replace(
        add_process_noise=_charted(page.add_process_noise, with_noise=True),
        update=_charted(page.update, with_noise=False),
    )


@cache
def measured_about_mean(page: Page) -> Page:
    """The page of a measurement with rotations, in its tangent at h of the mean, from one for numbers."""

    def update(model: Any, x: Any, z: Any, e: Any) -> Any:
        local, z = local_at(model, z, mean(x))
        return page.update(local, x, z, e)

    return page._replace(update=update)


def _charted(function: Callable, *, with_noise: bool) -> Callable:
    """A function of a page, of members in the tangent at their mean."""

    def charted(model: Any, x: Any, *signals: Any) -> Any:
        m = mean_of(model, x)
        D = differences(model, x, m)
        chart = _chart(model)
        chart.h = lambda d: model.h(moved(m, d, model.turns))
        if with_noise:
            chart.Q_root = inverse_reset_slopes(m, D, model.turns) @ model.Q_root
            return moved(m, function(chart, D, *signals), model.turns)
        after, *rest = function(chart, D, *signals)
        return moved(m, after, model.turns), *rest

    return charted


def _chart(model: Any) -> Any:
    """The model of a state that is an error, without its equations."""
    chart = copy(model)
    chart.turns, chart.state_angles = (), tangent_flags(model.state_angles, model.turns)
    return chart
