"""Inflation that adapts to the innovations, around the kernels of any ensemble filter.

    predict: x_j = mean + t^1/2 (x_j - mean) at the end of the step
    update:  t = max(1, t + u), u the mode of  (1 + g u) exp(-u^2/(2 deviation^2)),
             g = d log N(v; 0, (t'/t) A + R)/dt' at t' = t,  A = S - R the forecast's own part of S

One factor t is kept in the belief, in its extras; it begins at 1. Before each update it is normal with a standard
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

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places
from filters.particles.motion import silencer
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.tuples import column_reader, column_writer
from thruster_env.plants.layout import constants_reader, number_places
from thruster_env.plants.shape import Functions, Shape


@inlined
def write_scores(row, innovation, cov, numbers, r, z, lower, scores):
    """Scores (m,) w_k (A w)_k - (S^-1 A)_kk, w = S^-1 v, A = S less R, 0 if missing; lower (m, m) is scratch."""
    m = len(z)
    for i in range(m):
        for j in range(i + 1):
            total = row[cov + i * m + j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = total**0.5 if i == j else total / lower[j, j]
    w = np.zeros(m)
    for i in range(m):
        total = row[innovation + i]
        for k in range(i):
            total -= lower[i, k] * w[k]
        w[i] = total / lower[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            w[i] -= lower[k, i] * w[k]
        w[i] /= lower[i, i]
    column = np.zeros(m)
    for j in range(m):
        found = 0.0
        if z[j] == z[j]:
            for i in range(m):
                seen = z[i] == z[i]
                column[i] = row[cov + i * m + j] - numbers[r + i * m + j] if seen else 0.0
            for i in range(m):
                found += w[i] * column[i] * w[j]
            for i in range(m):
                for k in range(i):
                    column[i] -= lower[i, k] * column[k]
                column[i] /= lower[i, i]
            for i in range(m - 1, j - 1, -1):
                for k in range(i + 1, m):
                    column[i] -= lower[k, i] * column[k]
                column[i] /= lower[i, i]
            found -= column[j]
        scores[j] = found


@inlined
def moved_factor(factor, slope, deviation):
    """The mode of a factor, at least 1, of which the log-likelihood has a slope."""
    # A root of u^2 + u/slope - deviation^2: the larger one where the slope is positive, else the smaller one.
    product = 2.0 * slope * deviation**2
    move = product / (1.0 + (1.0 + 2.0 * slope * product) ** 0.5)
    return max(factor + move, 1.0) if abs(move) < np.inf else 1.0


def width_of(deviation: float) -> float:
    """The width p of an inverse gamma density, below 1/3, with a standard deviation over its mode."""

    def excess(root):
        p = root * root
        return root - deviation * (1.0 - 2.0 * p) * max(1.0 - 3.0 * p, 0.0) ** 0.5

    from scipy.optimize import brentq  # loads half of SciPy, for this line

    return brentq(excess, 0.0, 3.0**-0.5, xtol=1e-300) ** 2  # of the root, so that small ones are exact, too


@inlined
def relative_move(h, p):
    """Return e where the mode is 1 + e of (1 + h e) times an inverse gamma density of mode 1 and width p."""
    # The root with the sign of h of (1 - p) h e^2 + (1 - 2 p h) e - p h.
    along = 1.0 - 2.0 * p * h
    return 2.0 * p * h / (along + (along * along + 4.0 * p * (1.0 - p) * h * h) ** 0.5)


def adapter(deviation_place: int, count: int, updates_deviation: bool) -> tuple[Callable, Callable]:
    """Return `begin(row, place, numbers)` and `adapt(row, place, slope, numbers)`, of one of `count` factors.

    Where the deviation is updated, its numbers are the widest and the narrowest width.
    """
    widest, narrowest = deviation_place, deviation_place + 1

    @inlined
    def begin(row, place, numbers):
        row[place] = 1.0
        if updates_deviation:
            row[place + count] = numbers[widest]

    @inlined
    def adapt(row, place, slope, numbers):
        if not updates_deviation:
            row[place] = moved_factor(row[place], slope, numbers[deviation_place])
            return
        p = row[place + count]
        e = relative_move(row[place] * slope, p)
        if abs(e) < np.inf:
            d = e / (1.0 + e)
            row[place] = max(row[place] * (1.0 + e), 1.0)
            row[place + count] = min(max(p / (1.0 - 2.0 * d + d * d / p), numbers[narrowest]), numbers[widest])
        else:
            begin(row, place, numbers)

    return begin, adapt


@inlined
def row_moments(table, i, size):
    """Mean and sample variance of a row of the members."""
    mean, squares = 0.0, 0.0
    for j in range(size):
        mean += table[i, j] / size
    for j in range(size):
        squares += (table[i, j] - mean) ** 2
    return mean, squares / (size - 1)


@inlined
def stretch_row(table, i, factor, size):
    """A row's distances from its mean, times a factor."""
    mean = 0.0
    for j in range(size):
        mean += table[i, j] / size
    for j in range(table.shape[1]):
        table[i, j] = mean + factor * (table[i, j] - mean)


@inlined
def correlation_of(table, i, k, size):
    """The sample correlation of two rows of the members; 0 of constants."""
    mean, other, products, squares, others = 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(size):
        mean += table[i, j] / size
        other += table[k, j] / size
    for j in range(size):
        d, e = table[i, j] - mean, table[k, j] - other
        products += d * e
        squares += d * d
        others += e * e
    return products / (squares * others) ** 0.5 if squares * others > 0.0 else 0.0


@lru_cache(maxsize=64)
def with_adaptive_inflation(kernels: Kernels, deviation_place: int, updates_deviation: bool) -> Kernels:
    """An ensemble's kernels that inflate each forecast by a factor that is kept in the belief, and adapt it."""
    n, m = kernels.n, kernels.m
    places = memory_places(n, m)
    factor, innovation, cov, r = places.extras, places.innovation, places.innovation_cov, number_places(n, m).r
    start_plainly, predict_plainly, update_plainly = kernels.start, kernels.predict, kernels.update
    begin, adapt = adapter(deviation_place, 1, updates_deviation)

    @inlined
    def start(memory, numbers, size):
        start_plainly(memory, numbers, size)
        begin(memory[0], factor, numbers)

    @inlined
    def predict(memory, u, numbers, size):
        predict_plainly(memory, u, numbers, size)
        row, table, _ = memory
        spread = row[factor] ** 0.5
        for i in range(n):
            stretch_row(table, i, spread, size)

    @inlined
    def update(memory, z, numbers, size):
        update_plainly(memory, z, numbers, size)
        row, _, _ = memory
        scores, total = np.zeros(m), 0.0
        write_scores(row, innovation, cov, numbers, r, z, np.zeros((m, m)), scores)
        for k in range(m):
            total += scores[k]
        adapt(row, factor, 0.5 * total / row[factor], numbers)

    return kernels._replace(start=start, predict=predict, update=update, extras=1 + updates_deviation)


@lru_cache(maxsize=64)
def with_inflation_by_state(
    kernels: Kernels,
    functions: Functions,
    shape: Shape,
    deviation_place: int,
    updates_deviation: bool,
    taper_place: int | None,
) -> Kernels:
    """The same with a factor for each state; tapers (n, m) of states and channels are among the numbers, if any.

    Those of the forecast's correlations that tapers or missing channels leave are `near` (n, m).
    """
    n, m = kernels.n, kernels.m
    places = memory_places(n, m)
    first, innovation, cov, r = places.extras, places.innovation, places.innovation_cov, number_places(n, m).r
    start_plainly, predict_plainly, update_plainly = kernels.start, kernels.predict, kernels.update
    constants, state, store = constants_reader(shape), column_reader(n), column_writer(m, n)
    observe, silence = functions.observe, silencer(n, shape.measurement_angles)
    tapers = -1 if taper_place is None else taper_place
    begin, adapt = adapter(deviation_place, n, updates_deviation)

    @inlined
    def start(memory, numbers, size):
        start_plainly(memory, numbers, size)
        for i in range(n):
            begin(memory[0], first + i, numbers)

    @inlined
    def predict(memory, u, numbers, size):
        predict_plainly(memory, u, numbers, size)
        row, table, _ = memory
        for i in range(n):
            stretch_row(table, i, row[first + i] ** 0.5, size)

    @inlined
    def update(memory, z, numbers, size):
        row, table, _ = memory
        near, scores, c = np.zeros((n, m)), np.zeros(m), constants(numbers)
        for j in range(table.shape[1]):
            store(table, j, observe(state(table, j), c))
        silence(table, z, size)
        for i in range(n):
            for k in range(m):
                taper = numbers[tapers + i * m + k] if tapers >= 0 else 1.0
                near[i, k] = taper * abs(correlation_of(table, i, n + k, size)) if taper > 0.0 else 0.0
        update_plainly(memory, z, numbers, size)
        write_scores(row, innovation, cov, numbers, r, z, np.zeros((m, m)), scores)
        for i in range(n):
            root, slope = row[first + i] ** 0.5, 0.0
            for k in range(m):
                slope += 0.5 * scores[k] * near[i, k] / (root * (1.0 + near[i, k] * (root - 1.0)))
            adapt(row, first + i, slope, numbers)

    rows, extras = max(kernels.table_rows, n + m), n * (1 + updates_deviation)
    return kernels._replace(start=start, predict=predict, update=update, extras=extras, table_rows=rows)
