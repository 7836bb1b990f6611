"""Mehra's covariance matching: P H', R and Q, one after the other, from lagged covariances of innovations."""

from __future__ import annotations

import numpy as np

from tuning.ways.lagged import Noise, Stationary, by_lags
from tuning.ways.task import Task


def mehra(task: Task) -> None:
    """The equations of `mehra_equations`, for numbers that are not below zero; three times over.

    Q and R have to be linear in the numbers that are tuned, and A has to have an inverse.

    Source: Mehra (1970), "On the identification of variances and adaptive Kalman filtering", IEEE Transactions on
    Automatic Control 15(2), equations (20) to (29).
    """
    by_lags(task, "mehra", mehra_equations)


def mehra_equations(
    linear: Stationary, gain: np.ndarray, seen: np.ndarray, noise: Noise
) -> tuple[np.ndarray, np.ndarray]:
    """The matrix (rows, p) and the right side of equations in the numbers of Q and R.

        P C' = L C_0 + pinv(C A; C Ab A; ...) (C_1; C_2; ...; C_n),   Ab = A - A L C,   R = C_0 - C P C'
        sum_{j<k} C A^j Q A^(j-k)' C' = C P A^-k' C' - C A^k P C' - sum_{j<k} C A^j W A^(j-k)' C',   k = 1 ... n
        W = A (L C_0 L' - L C P - P C' L') A'

    P is the covariance of the predictions of the gain L.

    Args:
        linear: the model.
        gain: L (n, m).
        seen: lagged covariances of its innovations, (lags, m, m).
        noise: Q and R by the numbers.

    Raises:
        ValueError: if A has no inverse, or there are fewer lags than states.
    """
    a, c, n = linear.a, linear.c, len(linear.a)
    if len(seen) <= n or np.linalg.matrix_rank(a) < n:
        raise ValueError(f"way 'mehra' needs an A with an inverse and {n} lags, but one of them is missing")
    closed, power, rows = a - a @ gain @ c, np.eye(n), []
    for _ in range(n):
        rows.append(c @ power @ a)
        power = closed @ power
    crossed = gain @ seen[0] + np.linalg.pinv(np.concatenate(rows)) @ np.concatenate(seen[1 : n + 1])  # P C'
    middle = gain @ seen[0] @ gain.T - gain @ crossed.T - crossed @ gain.T
    known = noise.rest[0] + a @ middle @ a.T
    forward = [np.linalg.matrix_power(a, k) for k in range(n + 1)]
    back = [np.linalg.solve(one, np.eye(n)) for one in forward]

    def moved(q: np.ndarray) -> np.ndarray:
        sums = [sum(c @ forward[j] @ q @ back[k - j].T @ c.T for j in range(k)) for k in range(1, n + 1)]
        return np.ravel(sums)

    ends = [crossed.T @ back[k].T @ c.T - c @ forward[k] @ crossed for k in range(1, n + 1)]
    of_r = np.column_stack([one.ravel() for one in noise.r])
    of_q = np.column_stack([moved(one) for one in noise.q])
    r = seen[0] - c @ crossed - noise.rest[1]
    return np.concatenate([of_r, of_q]), np.concatenate([r.ravel(), np.ravel(ends) - moved(known)])
