"""The Kalman filter of one measurement over runs of any steps, with derivatives along parameters, as machine code.

One function serves all models: sizes are lengths of its arrays, and each row has the index of its F and Q. Where
steps are equal and no number is missing, covariances settle, and only means are computed from there on.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from thruster_env.core.parallel import spread
from thruster_env.graphs.loops import Loops

SETTLED = 1e-13  # of the variances: a change of P from row to row below which they have settled
CANCELS = 1e6  # S over R from which P is updated in Joseph's form
LOG_TWO_PI = math.log(2.0 * math.pi)


class StepTables(NamedTuple):
    """F and Q of u steps of different lengths, and their derivatives along p parameters."""

    f: np.ndarray  # (u, n, n)
    q: np.ndarray  # (u, n, n)
    f_slopes: np.ndarray  # (p, u, n, n)
    q_slopes: np.ndarray  # (p, u, n, n)
    f_moves: np.ndarray  # (p,), whether there is a slope of F


class Beginning(NamedTuple):
    """The belief at one row of each of B runs, with derivatives along p parameters."""

    rows: np.ndarray  # (B,)
    is_prediction: bool  # before the measurement of that row; otherwise after it
    beliefs: np.ndarray  # (B, n + n^2), mean and covariance
    slopes: np.ndarray  # (B, p, n + n^2)
    counted_from: np.ndarray  # (B,), the first row whose innovation counts

    def of(self, runs: slice) -> Beginning:
        """That of some runs."""
        return Beginning(
            self.rows[runs], self.is_prediction, self.beliefs[runs], self.slopes[runs], self.counted_from[runs]
        )


class Sums(NamedTuple):
    """What the recursion leaves, of each run."""

    values: np.ndarray  # (B,), log-likelihoods
    squares: np.ndarray  # (B,), sums of v^2/S
    gradients: np.ndarray  # (B, p)
    information: np.ndarray  # (B, p, p)
    innovations: np.ndarray  # (B, K, 2), v and S of each row; NaN without a measurement; or (B, 0, 2)
    beliefs: np.ndarray  # (B, K, n + n^2) of each row, or of the last one, (B, 1, n + n^2)


def filtered_runs(
    z: np.ndarray,
    index: np.ndarray,
    tables: StepTables,
    output: np.ndarray,
    r: float,
    r_slopes: np.ndarray,
    begin: Beginning,
    *,
    each_row: bool = False,
) -> Sums:
    """Filter B runs of one measurement; derivatives are along the p parameters of the tables.

    Args:
        z: (B, K), NaN where missing.
        index: (B, K), the step in the tables that leads to each row.
        tables: of steps.
        output: C, (n,).
        r: R.
        r_slopes: (p,).
        begin: where each run begins.
        each_row: whether the results have each row's innovation and belief.
    """
    (count, rows), n, p = z.shape, len(output), len(r_slopes)
    sums = np.zeros((count, 2 + p))
    information = np.zeros((count, p, p))
    innovations = np.full((count, rows if each_row else 0, 2), np.nan)
    beliefs = np.zeros((count, rows if each_row else 1, n + n * n))
    numbers = np.array([r, float(begin.is_prediction)])
    of_steps = tables.f, tables.q, tables.f_slopes, tables.q_slopes, tables.f_moves
    begins = begin.rows, begin.beliefs, begin.slopes, begin.counted_from
    arrays = [
        np.ascontiguousarray(array, dtype=np.float64)
        for array in (z, index, *of_steps, output, numbers, r_slopes, *begins)
    ]

    def run_some(first: int, last: int) -> None:
        memory = np.zeros((5 + 4 * p, n, n)), np.zeros((3 + 4 * p, n)), np.zeros(2 * p)
        _recursion(*arrays, sums, information, innovations, beliefs, *memory, first, last)

    spread(run_some, count)
    return Sums(sums[:, 0], sums[:, 1], sums[:, 2:], information, innovations, beliefs)


def _read(row, mean, cov):
    """Take mean and covariance from a row."""
    n = mean.shape[0]
    for i in range(n):
        mean[i] = row[i]
        for j in range(n):
            cov[i, j] = row[n + i * n + j]


def _write(mean, cov, row):
    """Put mean and covariance into a row."""
    n = mean.shape[0]
    for i in range(n):
        row[i] = mean[i]
        for j in range(n):
            row[n + i * n + j] = cov[i, j]


def _copy(mean, cov, mean_to, cov_to):
    for i in range(mean.shape[0]):
        mean_to[i] = mean[i]
        for j in range(mean.shape[0]):
            cov_to[i, j] = cov[i, j]


def _image(matrix, x, out):
    """A x."""
    for i in range(x.shape[0]):
        total = 0.0
        for j in range(x.shape[0]):
            total += matrix[i, j] * x[j]
        out[i] = total


def _product(a, b, out):
    """A B."""
    n = out.shape[0]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for m in range(n):
                total += a[i, m] * b[m, j]
            out[i, j] = total


def _spread(product, f, noise, out):
    """Symmetric (F P) F' + Q."""
    n = out.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = noise[i, j]
            for m in range(n):
                total += product[i, m] * f[j, m]
            out[i, j] = total
            out[j, i] = total


def _has_settled(cov, before, scale):
    """Whether no entry has changed, compared with the variances of the scale: 1 or 0."""
    settled = 1.0
    for i in range(cov.shape[0]):
        for j in range(cov.shape[0]):
            change, size = cov[i, j] - before[i, j], scale[i, i] * scale[j, j]
            if not change * change <= SETTLED * SETTLED * size:
                settled = 0.0
    return settled


def _filter(
    z,
    index,
    f,
    q,
    f_slopes,
    q_slopes,
    f_moves,
    output,
    numbers,
    r_slopes,
    begin_rows,
    begin_beliefs,
    begin_slopes,
    counted_from,
    sums,
    information,
    innovations,
    beliefs,
    matrices,
    vectors,
    scalars,
    first,
    last,
):
    """Matrices: F P, P, its prediction and value before, F dP; dP, its prediction and value before by parameter.

    Vectors: x, its prediction, P C'; dx, its prediction, dP C', and the slope of the gain by parameter.
    """
    n, p, rows = output.shape[0], r_slopes.shape[0], z.shape[1]
    r, is_prediction, each_row = numbers[0], numbers[1], innovations.shape[1]
    product, cov, predicted, before, half = matrices[0], matrices[1], matrices[2], matrices[3], matrices[4]
    mean, ahead, gain = vectors[0], vectors[1], vectors[2]
    for b in range(first, last):
        _read(begin_beliefs[b], mean, cov)
        for i in range(n):
            for j in range(n):
                before[i, j] = 0.0
        for a in range(p):
            _read(begin_slopes[b, a], vectors[3 + 4 * a], matrices[5 + 4 * a])
        settled, step_before, s, begin = 0.0, -1.0, 1.0, int(begin_rows[b])
        for k in range(begin, rows):
            is_measured = z[b, k] == z[b, k] and (k > begin or is_prediction > 0.0)
            step = int(index[b, k])
            if settled > 0.0 and (not is_measured or index[b, k] != step_before):
                settled = 0.0
            if k > begin:
                _image(f[step], mean, ahead)
                if settled == 0.0:
                    _product(f[step], cov, product)
                    _spread(product, f[step], q[step], predicted)
                for a in range(p):
                    dahead, dpredicted = vectors[4 + 4 * a], matrices[6 + 4 * a]
                    _image(f[step], vectors[3 + 4 * a], dahead)
                    if f_moves[a] > 0.0:
                        for i in range(n):
                            for j in range(n):
                                dahead[i] += f_slopes[a, step, i, j] * mean[j]
                    if settled == 0.0:
                        _product(f[step], matrices[5 + 4 * a], half)
                        _spread(half, f[step], q_slopes[a, step], dpredicted)
                        if f_moves[a] > 0.0:
                            for i in range(n):
                                for j in range(i + 1):
                                    for m in range(n):
                                        dpredicted[i, j] += f_slopes[a, step, i, m] * product[j, m]
                                        dpredicted[i, j] += product[i, m] * f_slopes[a, step, j, m]
                                    dpredicted[j, i] = dpredicted[i, j]
            else:
                _copy(mean, cov, ahead, predicted)
                for a in range(p):
                    _copy(vectors[3 + 4 * a], matrices[5 + 4 * a], vectors[4 + 4 * a], matrices[6 + 4 * a])
            if not is_measured:
                _copy(ahead, predicted, mean, cov)
                for a in range(p):
                    _copy(vectors[4 + 4 * a], matrices[6 + 4 * a], vectors[3 + 4 * a], matrices[5 + 4 * a])
            else:
                counts = 1.0 if k >= counted_from[b] else 0.0
                v = z[b, k]
                for i in range(n):
                    v -= output[i] * ahead[i]
                if settled == 0.0:
                    _image(predicted, output, gain)
                    s = r
                    for i in range(n):
                        s += output[i] * gain[i]
                    for i in range(n):
                        gain[i] = gain[i] / s
                    for i in range(n):
                        for j in range(n):
                            before[i, j] = cov[i, j]
                            cov[i, j] = predicted[i, j] - gain[i] * gain[j] * s
                    if s > CANCELS * r:  # Joseph's form: of a wide prior the difference would be rounding
                        for i in range(n):
                            for j in range(n):
                                total = 0.0
                                for m in range(n):
                                    total += ((1.0 if i == m else 0.0) - gain[i] * output[m]) * predicted[m, j]
                                product[i, j] = total
                        for i in range(n):
                            for j in range(i + 1):
                                total = gain[i] * gain[j] * r
                                for m in range(n):
                                    total += product[i, m] * ((1.0 if j == m else 0.0) - gain[j] * output[m])
                                cov[i, j] = total
                                cov[j, i] = total
                    settled = _has_settled(cov, before, cov) if index[b, k] == step_before else 0.0
                    for a in range(p):
                        dcov, dpredicted, dbefore = matrices[5 + 4 * a], matrices[6 + 4 * a], matrices[7 + 4 * a]
                        across, gain_slope, ds = vectors[5 + 4 * a], vectors[6 + 4 * a], r_slopes[a]
                        _image(dpredicted, output, across)
                        for i in range(n):
                            ds += output[i] * across[i]
                        scalars[a] = ds
                        for i in range(n):
                            gain_slope[i] = (across[i] - gain[i] * ds) / s
                        for i in range(n):
                            for j in range(n):
                                dbefore[i, j] = dcov[i, j]
                                dcov[i, j] = dpredicted[i, j] - across[i] * gain[j] - gain[i] * across[j]
                                dcov[i, j] += gain[i] * gain[j] * ds
                        if settled > 0.0:
                            settled = _has_settled(dcov, dbefore, cov)
                    step_before = index[b, k]
                for i in range(n):
                    mean[i] = ahead[i] + gain[i] * v
                sums[b, 0] -= 0.5 * counts * (LOG_TWO_PI + math.log(s) + v * v / s)
                sums[b, 1] += counts * v * v / s
                for a in range(p):
                    dmean, dahead, gain_slope = vectors[3 + 4 * a], vectors[4 + 4 * a], vectors[6 + 4 * a]
                    dv = 0.0
                    for i in range(n):
                        dv -= output[i] * dahead[i]
                    for i in range(n):
                        dmean[i] = dahead[i] + gain_slope[i] * v + gain[i] * dv
                    scalars[p + a] = dv
                    sums[b, 2 + a] -= counts * (0.5 * scalars[a] / s * (1.0 - v * v / s) + v * dv / s)
                    for c in range(a + 1):
                        term = dv * scalars[p + c] / s + 0.5 * scalars[a] * scalars[c] / (s * s)
                        information[b, a, c] += counts * term
                if each_row > 0:
                    innovations[b, k, 0] = v
                    innovations[b, k, 1] = s
            if not is_measured:
                step_before = -1.0
            if each_row > 0:
                _write(mean, cov, beliefs[b, k])
        if each_row == 0:
            _write(mean, cov, beliefs[b, 0])
        for a in range(p):
            for c in range(a):
                information[b, c, a] = information[b, a, c]


_recursion = Loops(
    _filter, [(None,) * d for d in (2, 2, 3, 3, 4, 4, 1, 1, 1, 1, 1, 2, 3, 1, 2, 3, 3, 3, 3, 2, 1)] + [None, None]
)
