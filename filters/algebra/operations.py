"""Operations of pages besides + - @ * / ** and .T, on matrices and on numbers, with their derivatives.

Each is a function of arrays, an operation on Matrices, and a derivative along a parameter, such as

    d (C S^-1) = (dC - K dS) S^-1,  K = C S^-1

In order: symmetry and angles; missing channels; quotients and Joseph's form; conditions, traces and counts; slopes
of graphs; the geometric mean of two covariances. A choice computes both sides, so a page that divides guards its
divisor, not its quotient. Slopes are Matrices of the same graph as values, so operations that they share, such as
a gain, a quotient S^-1 v or the product P H', are evaluated once. A slope of None is zero.

Source: Magnus, Neudecker (2019), Matrix Differential Calculus with Applications in Statistics and Econometrics.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from functools import cache

import numpy as np

from filters.algebra.matrices import (
    Matrix,
    Operation,
    entries_product,
    in_order,
    magnitude,
    minus,
    multiply,
    operation,
    plus,
    power,
    reciprocal,
    same,
    shifted,
    through,
)
from thruster_env.core import matrices
from thruster_env.core.angles import wrapped
from thruster_env.core.sources import Source, entrywise, is_array, matrix_reader, matrix_writer
from thruster_env.graphs.graphs import ROWS, Graph, are_unknown, called, repeated, where
from thruster_env.graphs.programs import CALLED, CALLED_IN_ROUNDS, Place, Program, program_of

ROUNDS = 14  # enough for condition numbers of 1e16: the last rounds each double the number of correct digits
CLOSE = 1e-10  # if det((a + b)/2)^(1/size), which is at least 1, exceeds 1 by less, one more round is enough


def sym(a):
    """The symmetric part of a matrix that is symmetric but for rounding; a Matrix computes only its lower half.

    A P A', with a symmetric P, is computed from P A', because gains need P A', too.
    """
    if not isinstance(a, Matrix):
        return 0.5 * (a + a.T)
    if a.symmetric:
        return a
    if getattr(a.operation, "name", "") in ("add", "subtract"):
        return a.operation(*map(sym, a.arguments))
    if a.operation is multiply and a.arguments[0].operation is multiply:
        (left, p), right = a.arguments[0].arguments, a.arguments[1]
        if p.symmetric and left.T is right:
            return congruence(left, p, p @ right)
    return mirrored(a)


@operation(same, lambda a: True)
def mirrored(a):
    """The symmetric matrix whose entries on and below the diagonal are those of a."""
    at = np.arange(len(a))
    return a[np.maximum.outer(at, at), np.minimum.outer(at, at)]


@operation(lambda a, *shapes: (a[0], a[0]), lambda *arguments: True)
def congruence(a, p, pa):
    """The matrix A P A' of a symmetric P, from A and P A'."""
    if a.dtype != object or pa.dtype != object:
        return mirrored.compute(a @ pa)
    result = np.empty((len(a), len(a)), dtype=object)
    for k in range(0, len(a), ROWS):  # of these columns, rows below the diagonal's suffice
        rows, columns = a[k:], slice(k, k + ROWS)
        if are_unknown(a):
            result[k:, columns] = repeated(lambda row, rows=rows: rows @ (p @ row), a[columns]).T
        else:
            result[k:, columns] = repeated(lambda column, rows=rows: rows @ column, pa.T[columns]).T
    return mirrored.compute(result)


@operation(same, lambda a: True)
def with_transposed(a):
    """The sum A + A'."""
    return a + a.T


@operation(lambda shape: (shape[0], shape[0]), lambda like: True)
def eye(like):
    """The identity matrix with as many rows as `like`."""
    return np.eye(len(like))


def wrap(x, angles):
    """A vector with its angles (flags) wrapped to (-pi, pi]."""
    return on_one_branch(x, tuple(angles)) if any(angles) else x


@operation(same)
def on_one_branch(x, angles):
    """`wrap`, if there are angles."""
    return np.array([wrapped(entry) if angle else entry for entry, angle in zip(x, angles, strict=True)])


# Missing channels: those that are NaN in z


@operation(same)
def present(z):
    """Which channels of z are measured."""
    return np.array([entry == entry for entry in z])


def _masked(keep, a, shape):
    return np.array([where(keep(*at), a[at], 0.0) for at in np.ndindex(*shape)], dtype=a.dtype).reshape(shape)


@operation(lambda measured, shape: shape)
def mask_missing(measured, a):
    """A vector, or rows of a matrix, with zeros for missing channels."""
    return _masked(lambda i, *_: measured[i], a, a.shape)


@operation(lambda measured, shape: shape, lambda measured, r: r.symmetric)
def uncorrelated(measured, r):
    """The covariance r without its correlations to missing channels."""
    return _masked(lambda i, j: True if i == j else measured[i] & measured[j], r, r.shape)


# Quotients


@operation(same)
def factor(s):
    """Unit lower triangular L, and d, with L diag(d) L' = s; NaN where s is not positive definite."""
    return pivoted(s, lambda d, variance: d > 0.0, math.nan)


def pivoted(s, counts, otherwise):
    """The factor by Cholesky's method, with another d, NaN or infinite, where counts(d, s_ii) is false."""
    lower, d = np.array(np.eye(len(s)), dtype=s.dtype), np.array(np.diag(s))
    used = np.array(d)  # zero in place of infinity, by which its column of L, zero, is not to be multiplied
    for j in range(len(s)):
        pivot = d[j] - sum(lower[j, k] * lower[j, k] * used[k] for k in range(j))
        is_number = counts(pivot, s[j, j])
        d[j] = where(is_number, pivot, otherwise)
        used[j] = where(is_number, pivot, 0.0) if otherwise == math.inf else d[j]
        for i in range(j + 1, len(s)):
            lower[i, j] = (s[i, j] - sum(lower[i, k] * lower[j, k] * used[k] for k in range(j))) / d[j]
    return lower, d


def divide(c, s):
    """The matrix C S^-1, or the vector S^-1 c, for a covariance S; its inverse is not formed."""
    return quotient(c, factor(s))


def forward(c, lower):
    """The quotient c L'^-1 by a unit lower triangular L."""
    y = np.array(c)
    for i in range(len(lower)):
        y[..., i] = y[..., i] - sum(y[..., k] * lower[i, k] for k in range(i))
    return y


@operation(same)
def quotient(c, of):
    """`divide`, from the factor of S. A vector may be a column, as in ensembles of NumPy's arrays."""
    if c.ndim == 2 and c.dtype == object and c.shape[1] == len(of[1]):
        return repeated(lambda row: quotient.compute(row, of), c)
    lower, d = of
    x = forward(c.ravel() if c.shape == (len(d), 1) else c, lower)
    for i in reversed(range(len(d))):
        x[..., i] = x[..., i] / d[i] - sum(x[..., k] * lower[k, i] for k in range(i + 1, len(d)))
    return x.reshape(c.shape)


@operation(same, lambda of, measured: True)
def inverse(of, measured):
    """S^-1 from the factor of S, with zeros for missing channels."""
    result = quotient.compute(np.array(np.eye(len(measured)), dtype=of[1].dtype), of)
    return _masked(lambda i, j: measured[i] if i == j else True, result, result.shape)


def joseph(p, k, h, r):
    """(I - K H) P (I - K H)' + K R K', positive whatever the gain K; Bucy, Joseph (1968)."""
    a = eye(p) - k @ h
    value = sym(a @ p @ a.T) + sym(k @ r @ k.T)
    if isinstance(k, Matrix) and k.operation is quotient:
        c, of = k.arguments
        if c is p @ h.T and of.arguments[0] is sym(h @ p @ h.T) + r:
            return of_best_gain(value, p, c, of.arguments[0], k)
    return value


@operation(same, lambda *arguments: True)
def of_best_gain(value, p, c, s, k):
    """Joseph's form if K = P H' S^-1: then it is P - C S^-1 C' with C = P H'.

    So its derivative is dP - N - N', N = (dC - 1/2 K dS) K', and no dK is formed.
    """
    return value


# Derivatives of all these; slopes of None are zero


@mirrored.derivative
@with_transposed.derivative
@on_one_branch.derivative
def _of_linear(result, arguments, slopes):
    return through(
        lambda slope: slope if result.operation is on_one_branch else result.operation(slope), slopes[0]
    )


@congruence.derivative
def _of_congruence(result, arguments, slopes):
    """The slope M + M' + A dP A', M = dA P A'."""
    (a, _, pa), (da, dp, _) = arguments, slopes
    by_p = through(lambda slope: congruence(a, slope, slope @ a.T), dp)
    return plus(through(lambda slope: with_transposed(slope @ pa), da), by_p)


@eye.derivative
@present.derivative
def of_constant(result, arguments, slopes):
    """The slope None of a constant."""
    return None


for _masking in (mask_missing, uncorrelated):
    _masking.derivative(
        lambda result, arguments, slopes: through(lambda slope: result.operation(arguments[0], slope), slopes[1])
    )


@factor.derivative
def _of_factor(result, arguments, slopes):
    return slopes[0]  # the slope of S, which the derivatives of quotients and densities use


@quotient.derivative
def _of_quotient(result, arguments, slopes):
    of, (dc, ds) = arguments[1], slopes
    change = minus(dc, through(lambda slope: result @ slope, ds))
    return through(lambda slope: quotient(slope, of), change)


@multiply.derivative
def _of_product(result, arguments, slopes):
    (a, b), (da, db) = arguments, slopes
    return plus(through(lambda slope: _times(slope, b), da), through(lambda slope: a @ slope, db))


def _times(slope, b):
    """A slope times b. The slope of a gain times v is (dC - K dS) (S^-1 v), so that no dK is formed."""
    if slope.operation is quotient and len(b.shape) == 1:
        change, of = slope.arguments
        return change @ quotient(b, of)
    return slope @ b


@of_best_gain.derivative
def _of_best_gain(result, arguments, slopes):
    (_, _, _, _, k), (_, dp, dc, ds, _) = arguments, slopes
    half = minus(dc, through(lambda slope: (k @ slope) * 0.5, ds))
    return minus(dp, through(lambda slope: with_transposed(slope @ k.T), half))


def _by_entries(function, *arrays):
    """A function of numbers, applied to the entries of arrays."""
    with np.errstate(invalid="ignore"):
        result = np.frompyfunc(function, len(arrays), 1)(*arrays)
    return np.array(result.tolist()) if np.ndim(result) else result


@operation(same)
def exceeds(a, value):
    """Whether a number, or each entry, is larger than the float `value`."""
    return _by_entries(operator.gt, a, value)


@operation(lambda a: ())
def is_number(a):
    """Whether a number is not NaN."""
    return a == a


@operation(lambda *shapes: shapes[1], lambda condition, a, b: a.symmetric and b.symmetric)
def choose(condition, a, b):
    """`a` if the condition holds, else `b`: numbers or matrices; the condition may differ between entries."""
    return _by_entries(where, condition, a, b)


@operation(lambda shape: ())
def trace(a):
    """The sum of the diagonal."""
    return sum(a[i, i] for i in range(len(a)))


@operation(lambda shape: ())
def count(measured):
    """The number of measured channels."""
    return sum(where(channel, 1.0, 0.0) for channel in measured)


@operation(same)
def exponential(v):
    """e^v of a number, or of each entry of a vector."""
    return np.exp(v)


@operation(lambda a: ())
def logarithm(a):
    """The natural logarithm of a number."""
    return np.log(a)


@operation(same)
def at_most(v, value):
    """The smaller of each entry of a vector and the float `value`."""
    return np.array([where(entry > value, value, entry) for entry in v])


@operation(same)
def at_least(a, value):
    """The larger of a number, or of each entry, and the float `value`; `value` for NaN."""
    return _by_entries(lambda entry: where(entry > value, entry, value), a)


@operation(lambda v, value: v)
def below(v, value):
    """1 for entries of a vector that are not larger than the float `value`, else 0."""
    return np.array([where(entry > value, 0.0, 1.0) for entry in v])


@operation(lambda v: (v[0], v[0]), lambda v: True)
def diagonal(v):
    """The diagonal matrix with the entries of a vector."""
    return np.diag(np.ravel(v))


def constant(value: float, like):
    """A number, or a vector of equal numbers, with the shape and the kind of `like`."""
    return shifted(like * 0.0, float(value)) if isinstance(like, Matrix) else np.full(np.shape(like), value)[()]


reciprocal.derivative(
    lambda result, arguments, slopes: through(lambda slope: slope * result * result * -1.0, slopes[0])
)


@power.derivative
def _of_power(result, arguments, slopes):
    a, exponent = arguments
    return through(lambda slope: slope * power(a, exponent - 1.0) * exponent, slopes[0])


logarithm.derivative(lambda result, arguments, slopes: through(lambda slope: slope / arguments[0], slopes[0]))


@exponential.derivative
def _of_exponential(result, arguments, slopes):
    return through(lambda slope: entries_product(result, slope) if result.shape else result * slope, slopes[0])


@entries_product.derivative
def _of_entries(result, arguments, slopes):
    (a, b), (da, db) = arguments, slopes
    by_a = through(lambda slope: entries_product(slope, b), da)
    return plus(by_a, through(lambda slope: entries_product(a, slope), db))


@at_most.derivative
def _of_limit(result, arguments, slopes):
    v, value = arguments
    return through(lambda slope: entries_product(slope, below(v, value)), slopes[0])


@at_least.derivative
def _of_lower_limit(result, arguments, slopes):
    a, value = arguments
    return through(lambda slope: choose(exceeds(a, value), slope, slope * 0.0), slopes[0])


@magnitude.derivative
def _of_magnitude(result, arguments, slopes):
    return through(lambda slope: choose(exceeds(arguments[0], 0.0), slope, slope * -1.0), slopes[0])


diagonal.derivative(lambda result, arguments, slopes: through(diagonal, slopes[0]))
shifted.derivative(lambda result, arguments, slopes: slopes[0])
trace.derivative(lambda result, arguments, slopes: through(trace, slopes[0]))


@choose.derivative
def _of_choice(result, arguments, slopes):
    condition, *values = arguments
    moves = (a * 0.0 if slope is None else slope for a, slope in zip(values, slopes[1:], strict=True))
    return choose(condition, *moves)


for _jumps in (below, exceeds, is_number, count):
    _jumps.derivative(lambda *_: None)


def slopes_of(wanted: Sequence[Matrix], moves: Mapping[Matrix, Matrix]) -> list[Matrix | None]:
    """Slopes of matrices along one parameter, from those of given matrices, `moves`; None for zero."""
    slopes: dict[Matrix, Matrix | None] = dict(moves)
    for matrix in in_order(wanted):
        if matrix not in slopes:
            of = [slopes[a] if isinstance(a, Matrix) else None for a in matrix.arguments]
            moving = any(slope is not None for slope in of)
            slopes[matrix] = matrix.operation.slope(matrix, matrix.arguments, of) if moving else None
    return [slopes[matrix] for matrix in wanted]


@operation(same, lambda a, b: True)
def geometric_mean(a, b):
    """A # B = A (A^-1 B)^(1/2) of two covariances, itself a covariance.

    Replacing the two by their arithmetic and harmonic mean, again and again, converges to it. With both scaled to
    determinant 1 one round is enough for two channels, and one channel needs none. For more than two channels
    programs call a function.

    Source: Bhatia (2007), Positive Definite Matrices, chapter 4; scaling by determinants: Higham (2008), Functions
    of Matrices, section 6.5.
    """
    size = len(a)
    if a.dtype == object and size > 2:
        numbers = [a[0, 0].graph.number(entry) for entry in (*a.ravel(), *b.ravel())]
        entries = called(_taught(size)[0], size * size, *numbers)
        return mirrored.compute(np.array(entries, dtype=object).reshape(size, size))
    if size == 1:
        return np.array([[(a[0, 0] * b[0, 0]) ** 0.5]])
    a, b, unit = _scaled(a, b)
    for _ in range(rounds(size)):
        a, b = _closer(a, b)
    return a * unit


def _scaled(a, b):
    """Both with determinant 1, and the factor of their mean."""
    unit_a, unit_b = _unit(factor(a)), _unit(factor(b))
    return a * (1.0 / unit_a), b * (1.0 / unit_b), (unit_a * unit_b) ** 0.5


def _closer(a, b):
    """One round: arithmetic and harmonic mean, both with determinant 1."""
    both = a + b
    of = factor(both)
    parallel = mirrored(quotient(a, of) @ b)  # (a^-1 + b^-1)^-1
    unit = _unit(of)
    return both * (1.0 / unit), parallel * unit


def rounds(size: int) -> int:
    """Number of rounds."""
    return 1 if size == 2 else ROUNDS


def _unit(of):
    return math.prod(of[1]) ** (1.0 / len(of[1]))


@cache
def geometric_mean_of(size: int) -> Callable:
    """Return `mean(a, b)`, `geometric_mean` for `calls`; for large matrices it stops as soon as both are close."""
    if size == 1:
        return entrywise("mean", "a, b", (1, 1), lambda i, j: "(a[0][0] * b[0][0]) ** 0.5", a=(1, 1), b=(1, 1))
    count, close = rounds(size), 1.0 + CLOSE if is_array(size, size) else 0.0  # small matrices do all rounds
    cholesky, solve = matrices.cholesky_factor(size), matrices.row_solver(size, size)
    times, add = matrices.multiplier(size, size, size), matrices.symmetric_sum(size)
    source = Source("unit", "l", l=(size, size))  # l l' over this has determinant 1
    unit = source.function(source.product(f"l[{i}][{i}] ** {2.0 / size!r}" for i in source.range(size)))
    scaled = entrywise("scaled", "a, f", (size, size), lambda i, j: f"f * a[{i}][{j}]", a=(size, size))
    (read_first, write_first), (read_second, write_second) = (
        (matrix_reader(size, size, at), matrix_writer(size, size, at)) for at in (0, size * size)
    )

    def mean(a, b):
        unit_a, unit_b = unit(cholesky(a)), unit(cholesky(b))
        pair = np.empty(2 * size * size)
        write_first(pair, scaled(a, 1.0 / unit_a))
        write_second(pair, scaled(b, 1.0 / unit_b))
        rounds_left = count
        while rounds_left > 0:
            rounds_left -= 1
            first, second = read_first(pair), read_second(pair)
            both = add(first, second)
            root = cholesky(both)
            parallel = times(solve(first, root), second)
            unit_both = unit(root)
            if 0.5 * unit_both < close:  # it is 1 for equal ones, else larger
                rounds_left = min(rounds_left, 1)
            write_first(pair, scaled(both, 1.0 / unit_both))
            write_second(pair, scaled(add(parallel, parallel), 0.5 * unit_both))
        return scaled(read_first(pair), (unit_a * unit_b) ** 0.5)

    return mean


@cache
def _taught(size: int) -> tuple[str, Callable]:
    """The name under which programs call the mean, and the function, which lives as long as this is remembered."""
    mean, name, write = geometric_mean_of(size), f"geometric_mean_{size}", matrix_writer(size, size, 0)
    first, second = (matrix_reader(size, size, at) for at in (0, size * size))

    def work(pair, result):
        write(result, mean(first(pair), second(pair)))

    CALLED[name], CALLED_IN_ROUNDS[name] = work, lambda: _as_programs(size)
    return name, work


def _as_programs(size: int) -> tuple[Program, Program, Program, int, int]:
    """The mean as programs, for `CALLED_IN_ROUNDS`; "kept" holds both matrices and the factor of the mean."""
    square = size * size

    def program(array: str, work: Callable, to: str) -> Program:
        graph = Graph()
        numbers = np.array(
            [graph.given(Place(array, k)) for k in range(2 * square + (array == "kept"))], dtype=object
        )
        a, b = (numbers[k * square : (k + 1) * square].reshape(size, size) for k in range(2))
        results = np.concatenate([np.ravel(array) for array in work(a, b, *numbers[2 * square :])])
        return program_of([(Place(to, k), graph.number(entry)) for k, entry in enumerate(results)], {})

    first, again = program("given", _scaled, "kept"), program("kept", lambda a, b, unit: _closer(a, b), "kept")
    last = program("kept", lambda a, b, unit: (a * unit,), "found")
    return first, again, last, rounds(size), 2 * square + 1


FUNCTIONS: dict[Operation, Callable] = {geometric_mean: lambda result, a, b: geometric_mean_of(a[0])}
