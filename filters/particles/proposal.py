"""The optimal proposal: particles are drawn by what is measured, and weighted by how well it was predicted."""

from __future__ import annotations

from functools import lru_cache, partial

from filters.pages.equations import Equations
from filters.pages.programs import stored
from filters.pages.stages import Stage
from filters.particles.each import EachMemory, Works, works_of_each
from thruster_env.numerics.algebra.densities import log_density
from thruster_env.numerics.algebra.operations import divide, only, present, sym, uncorrelated, wrap
from thruster_env.plants.shape import Functions, Shape


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


def stages_of(noise: int, level: int, memory: EachMemory, model: Equations) -> dict[str, Stage]:
    """The update, of noise in rows from `noise` on; the logarithms go into the row `level`."""
    n = memory.shape.n
    d, Q = memory.of_each(noise, n), memory.of_all(n, n, symmetric=True)
    x, new, logarithm = propose(model, memory.x, d, Q, memory.z, memory.e)
    return {"update": Stage({**stored((x, new), (memory.x, d)).values, memory.place(level): logarithm}, {})}


@lru_cache(maxsize=64)
def proposal_works(functions: Functions, shape: Shape, noise: int, level: int, cov: int) -> Works:
    """The update for a model's functions and shape, whose row has the Q of the noise from `cov` on."""
    stages, common = partial(stages_of, noise, level), (cov, shape.n * shape.n)
    return works_of_each(functions, shape, level + 1, shape.m, stages, common)
