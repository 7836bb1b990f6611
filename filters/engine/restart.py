"""Restart of a belief that has diverged (not finite, or with a negative variance): it becomes the prior."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places
from thruster_env.core.compiled import inlined
from thruster_env.core.sources import Source
from thruster_env.model.layout import number_places

LARGEST = 1e300  # what the numbers of a belief may add up to


@cache
def row_magnitude(n: int, m: int) -> Callable:
    """Return `magnitude(row)`: the sum of the absolute values of the numbers of a belief and its innovation.

    A negative variance, which rounding leaves of a covariance of very unequal numbers, counts as a number beyond
    LARGEST, and so does NaN.
    """
    places = memory_places(n, m)
    beyond = 10 * LARGEST
    variances = [places.cov + i * (n + 1) for i in range(n)]
    source = Source("magnitude", "row", work=places.gain)
    if source.loops:
        of_all = source.sum(f"abs(row[{i}])" for i in source.range(places.gain))
        of_variances = source.sum(
            f"(0.0 if row[{place}] >= 0.0 else {beyond})"
            for place in (i * (n + 1) + places.cov for i in source.range(n))
        )
        return source.function(f"{of_all} + {of_variances}")
    terms = [f"abs(row[{i}])" for i in range(places.gain) if i not in variances]
    terms += [f"(row[{i}] if row[{i}] >= 0.0 else {beyond})" for i in variances]
    return source.function(" + ".join(terms))


@lru_cache(maxsize=64)
def restart_if_lost(kernels: Kernels) -> Callable:
    """Return `restart(memory, numbers, size)`: replace a diverged belief by the prior, and count."""
    n, m, start, summarise = kernels.n, kernels.m, kernels.start, kernels.summarise
    places, r_place = memory_places(n, m), number_places(n, m).r
    innovation, s_place, log_likelihood = places.innovation, places.innovation_cov, places.log_likelihood
    divergences, magnitude = places.divergences, row_magnitude(n, m)

    @inlined
    def restart(memory, numbers, size):
        row, _, _ = memory
        if not magnitude(row) < LARGEST:
            start(memory, numbers, size)
            summarise(memory, size)
            row[divergences] += 1.0
            row[log_likelihood] = 0.0
            for i in range(m):
                row[innovation + i] = 0.0
            for i in range(m * m):
                row[s_place + i] = numbers[r_place + i]

    return restart
