"""Linear signals in continuous time, and in equal steps: F and Q of steps of any length, and sums of signals.

    dx/dt = A x + w,  E[w(t) w(s)'] = S delta(t - s);   z = C x

A `Signal` gives F and Q of any step, so each step of a record may have its own length. `filters.models` has those
with a name.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

TERMS, LARGEST_TERM = 14, 0.5  # of the series of e^(A h), and the norm of A h from which on h is halved
WIDE = 100.0  # spreads of the data in the prior's deviation: a start that knows nothing


class Signal(NamedTuple):
    """A linear signal: A, S, C, and the symbols of its states with their units."""

    slope: np.ndarray  # A, (n, n)
    densities: np.ndarray  # S, (n, n), diagonal
    output: np.ndarray  # C, (n,)
    states: tuple[tuple[str, str], ...]  # symbol, and unit with U for the data's
    orders: tuple[int, ...]  # how often each state is differentiated by time: U/s^order
    first: np.ndarray  # covariance of the first state, (n, n); variances are infinite where it may be anything
    discrete: tuple[int, ...] = ()  # states in equal steps alone, whose A is F of a row, and S its Q

    def transition(self, dt: float) -> np.ndarray:
        """F = e^(A dt), (n, n)."""
        return self.step(dt)[0]

    def noise(self, dt: float) -> np.ndarray:
        """Q of a step of dt [s], (n, n)."""
        return self.step(dt)[1]

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """F and Q of a step of dt [s]."""
        transitions, noises = self.steps(self.slope, np.array([dt]), dt)
        return transitions[0], np.tensordot(np.diag(self.densities)[list(self.driven)], noises[:, 0], 1)

    def steps(self, slopes: np.ndarray, dts: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """The results of `steps` for rates (..., n, n) of such a signal, and rows that are dt [s] apart.

        Raises:
            ValueError: for states in equal steps alone, if dt is no part of a step.
        """
        if not self.discrete:
            return steps(slopes, self.driven, self.orders, dts)
        counts, n, driven = np.round(dts / dt).astype(np.int64), len(self.output), self.driven
        if not np.allclose(counts * dt, dts, rtol=1e-6):
            rule = "an autoregression must have equal steps"
            raise ValueError(f"{rule}, but these are {dts.min():g} to {dts.max():g} s: take ornstein-uhlenbeck")
        f = np.zeros((*slopes.shape[:-2], len(dts), n, n))
        noises = np.zeros((*slopes.shape[:-2], len(driven), len(dts), n, n))
        for is_discrete in (False, True):
            states = np.array([i for i in range(n) if (i in self.discrete) == is_discrete])
            if not len(states):
                continue
            block: tuple[Any, ...] = (..., states[:, None], states)
            rates, of_block = slopes[block], [j for j, state in enumerate(driven) if state in states]
            within = [int(np.searchsorted(states, driven[j])) for j in of_block]
            orders = np.array(self.orders)[states]
            parts = _powers(rates, within, counts) if is_discrete else steps(rates, within, orders, dts)
            f[block] = parts[0]
            for position, j in enumerate(of_block):
                noises[..., j, :, :, :][block] = parts[1][..., position, :, :, :]
        return f, noises

    def start(self, spread: float, dt: float) -> np.ndarray:
        """Covariance of the first state, (n, n), with a hundred spreads of the data where it may be anything."""
        wide = (WIDE * spread / dt ** np.array(self.orders)) ** 2
        return np.where(np.isfinite(self.first), self.first, np.diag(wide))

    @property
    def driven(self) -> tuple[int, ...]:
        """Indices of the states that white noise drives."""
        return tuple(np.flatnonzero(np.diag(self.densities)).tolist())


def steps(
    slope: np.ndarray, driven: Sequence[int], orders: Sequence[int], dts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """F of steps of different lengths, and Q of white noise of density 1 on each of some states.

        F(h) = sum_k A^k h^k/k!,  Q(h) = sum_k L^k(S) h^(k+1)/(k+1)!,  L(X) = A X + X A'
        F(2h) = F(h)^2,  Q(2h) = Q(h) + F(h) Q(h) F(h)'

    No term cancels another in Q, and only products of matrices are computed, for all lengths at once.

    Args:
        slope: A, (..., n, n).
        driven: indices of d states.
        orders: how often each state is differentiated by time, (n,): units in which A is well scaled.
        dts: lengths h [s], (u,).

    Returns:
        F, (..., u, n, n), and Q, (..., d, u, n, n).

    Source: van Loan (1978), "Computing integrals involving the matrix exponential", IEEE Transactions on Automatic
    Control 23(3); Moler, van Loan (2003), SIAM Review 45(1), method 3, for scaling and doubling.
    """
    n, unit = slope.shape[-1], float(dts.max())
    scale = unit ** np.asarray(orders, dtype=np.float64)  # of x in units of the data
    a = (slope * scale[:, None] / scale * unit)[..., None, :, :]  # an axis for what is driven
    terms = [np.broadcast_to(np.eye(n), a.shape)]
    while len(terms) < n and terms[-1].any():
        terms.append(a @ terms[-1] / len(terms))
    is_polynomial = not (a @ terms[-1]).any()
    count = 2 * n - 1 if is_polynomial else TERMS
    noise = np.zeros((len(driven), n, n))
    noise[range(len(driven)), driven, driven] = 1.0
    noises = [np.broadcast_to(noise, (*a.shape[:-3], *noise.shape))]
    for k in range(1, count):
        rate = a @ noises[-1]
        noises.append((rate + np.swapaxes(rate, -1, -2)) / (k + 1))
        if not is_polynomial and k >= len(terms):
            terms.append(a @ terms[-1] / k)
    doublings = np.zeros(len(dts), dtype=np.int64)
    if not is_polynomial:
        reach = float(np.abs(a).sum(axis=-1).max()) / LARGEST_TERM
        doublings = np.maximum(np.ceil(np.log2(np.maximum(reach * dts / unit, 1e-300))), 0.0).astype(np.int64)
    lengths = dts / unit * 0.5**doublings
    f = _polynomials(np.concatenate(terms, axis=-3), lengths)
    q = _polynomials(np.stack(noises, axis=-3), lengths) * lengths[:, None, None]
    for turn in range(int(doublings.max(initial=0))):
        now = doublings > turn
        part, of_noise = f[..., now, :, :], q[..., now, :, :]
        wide = part[..., None, :, :, :]
        q[..., now, :, :] = of_noise + wide @ of_noise @ np.swapaxes(wide, -1, -2)
        f[..., now, :, :] = part @ part
    q *= (unit ** (1.0 + 2.0 * np.asarray(orders, dtype=np.float64)))[list(driven), None, None, None]
    return f / scale[:, None] * scale, q / np.outer(scale, scale)


def _powers(transition: np.ndarray, driven: Sequence[int], counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`steps` of states in equal steps: F^k, and the sum of F^i S F'^i up to k - 1, for counts k (u,)."""
    n = transition.shape[-1]
    unit = np.zeros((len(driven), n, n))
    unit[range(len(driven)), driven, driven] = 1.0
    f, q = np.broadcast_to(np.eye(n), transition.shape), np.zeros((*transition.shape[:-2], *unit.shape))
    fs = np.empty((*transition.shape[:-2], len(counts), n, n))
    qs = np.empty((*transition.shape[:-2], len(driven), len(counts), n, n))
    wide = transition[..., None, :, :]
    for k in range(int(counts.max()) + 1):
        fs[..., counts == k, :, :], qs[..., counts == k, :, :] = f[..., None, :, :], q[..., None, :, :]
        f, q = transition @ f, wide @ q @ np.swapaxes(wide, -1, -2) + unit
    return fs, qs


def _polynomials(terms: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """sum_k terms_k h^k of matrices (..., k, n, n), for each length h (u,): (..., u, n, n)."""
    *leading, count, n, _ = terms.shape
    powers = lengths[:, None] ** np.arange(count)
    return (powers @ terms.reshape(*leading, count, n * n)).reshape(*leading, len(lengths), n, n)


def anywhere(count: int) -> np.ndarray:
    """The first covariance of states that may begin anywhere."""
    return np.diag(np.full(count, np.inf))


def added(signals: list[Signal]) -> Signal:
    """The sum of signals, side by side."""
    firsts = np.cumsum([0, *(len(signal.output) for signal in signals)])[:-1].tolist()
    return Signal(
        block_diagonal([signal.slope for signal in signals]),
        block_diagonal([signal.densities for signal in signals]),
        np.concatenate([signal.output for signal in signals]),
        tuple(state for signal in signals for state in signal.states),
        tuple(order for signal in signals for order in signal.orders),
        block_diagonal([signal.first for signal in signals]),
        tuple(first + i for signal, first in zip(signals, firsts, strict=True) for i in signal.discrete),
    )


def block_diagonal(blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Square matrices along a diagonal."""
    matrix, first = np.zeros((sum(map(len, blocks)),) * 2), 0
    for block in blocks:
        last = first + len(block)
        matrix[first:last, first:last], first = block, last
    return matrix
