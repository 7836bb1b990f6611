"""Where a page of a particle filter finds everything, and what it stores."""

from __future__ import annotations

from math import prod

from filters.algebra.matrices import Matrix, given
from filters.algebra.members import on_branch
from filters.algebra.operations import wrap
from filters.algebra.samples import (
    effective_size,
    normalised,
    weighted_covariance,
    weighted_mean,
    weights,
)
from filters.algebra.scalars import at_least
from filters.engine.layout import memory_places
from filters.pages.equations import PagedModel
from filters.pages.members import MembersMemory
from filters.pages.page import Page
from filters.pages.programs import stored, with_kept
from filters.pages.stages import Stage
from thruster_env.graphs.programs import Place

LOWEST = -1e300  # of logarithms of weights


class Layout:
    """Where everything lies.

    Attributes:
        x, logarithm, weight: rows of the table, of which the weights are scratch, and lie behind what is kept.
        kept: what is kept besides, in the table or the row.
        size: the place of the ESS.
        rows, extras: how many rows of the table and numbers of the row belong to the belief.
    """

    def __init__(self, page: Page, memory: MembersMemory, model: PagedModel):
        """Give each its place."""
        n, first = memory.shape.n, memory_places(memory.shape.n, memory.shape.m).extras
        self.x, self.logarithm = memory.x, given(Place("table", n), (), member=True, like=memory.x)
        self.size, self.kept = Place("rows", first), {}
        memory.end, rows = first + 1, n + 1
        self.start = with_kept(page.start(model, memory.w))  # type: ignore[misc]
        for name, one in self.start[-1].items():
            if name in page.of_each:
                place = Place("table", rows)
                self.kept[name] = given(place, one.shape, symmetric=one.symmetric, member=True, like=memory.x)
                rows += prod(one.shape)
            else:
                self.kept[name] = memory.another(one, symmetric=one.symmetric)
        self.rows, self.extras, self.weight = rows, memory.end - first, Place("table", rows)
        model.kept = self.kept

    def moments(self, model: PagedModel, x: Matrix, w: Matrix, P: Matrix | None) -> tuple[Matrix, ...]:
        """Particles with their angles on one branch, their mean and their covariance."""
        x = on_branch(x, model.state_angles, w)
        cov = weighted_covariance(x, w)
        return x, wrap(weighted_mean(x, w), model.state_angles), cov if P is None else cov + weighted_mean(P, w)


def stages_of(page: Page, memory: MembersMemory, model: PagedModel) -> dict[str, Stage]:
    """What a page of a particle filter stores; see `filters.particles.kernels`."""
    at = Layout(page, memory, model)
    x, log_w, kept = at.x, at.logarithm, at.kept
    innovation, cov, likelihood = memory.told
    of_each = {
        "start": (on_branch(at.start[0], model.state_angles), *at.start[1:]),
        "advance": page.advance(model, x, memory.u),
        "settle": page.settle(model, x, memory.w),
    }
    if page.renew:
        of_each["renew"] = page.renew(model, x, memory.mean, memory.P, memory.w)
    stages = {name: stored(found, (x,), kept) for name, found in of_each.items()}
    stages["choose"] = stored((weights(log_w),), (at.weight,))
    stages["summarise"] = stored(at.moments(model, x, weights(log_w), kept.get("P")), (x, *memory.belief))
    if page.foresee:
        mu, level, v, S = page.foresee(model, x, log_w, memory.z)
        w, first = normalised(log_w + level)
        found: dict[Matrix | Place, Matrix] = {
            x: mu,
            log_w: -level,
            innovation: v,
            cov: S,
            at.weight: w,
            likelihood: first,
        }
        if page.renew:
            found |= dict(zip(memory.belief, at.moments(model, mu, w, None)[1:], strict=True))
        stages["foresee"] = stored(tuple(found.values()), tuple(found))
        log_w = log_w + memory.read("rows", likelihood.at)
    x, log_w, *told, changed = with_kept(page.update(model, x, log_w, memory.z, memory.e))
    w, level = normalised(log_w)
    x, *moments = at.moments(model, x, w, changed.get("P"))
    log_w = at_least(log_w - level, LOWEST)  # a particle that expects no number has hardly any weight
    results = x, log_w, level, effective_size(w), *moments, *told, changed
    places: tuple[Matrix | Place, ...] = (
        at.x,
        at.logarithm,
        likelihood,
        at.size,
        *memory.belief,
        *(innovation, cov)[: len(told)],
    )
    return {**stages, "update": stored(results, places, kept)}
