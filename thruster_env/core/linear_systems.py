"""Linear systems in discrete time: discretisation and observability."""

from __future__ import annotations

import numpy as np


def zero_order_hold(a: np.ndarray, b: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Discrete A_d, B_d of dx/dt = A x + B u for an input held over dt [s], by the matrix exponential."""
    from scipy.signal import cont2discrete

    a_d, b_d, *_ = cont2discrete((a, b, np.eye(len(a)), np.zeros((len(a), b.shape[1]))), dt, method="zoh")
    return a_d, b_d


def observability(a: np.ndarray, c: np.ndarray) -> tuple[int, float]:
    """Rank and condition number of the observability matrix [C; C A; ...] of a discrete pair (A, C)."""
    matrix = np.vstack([c @ np.linalg.matrix_power(a, k) for k in range(len(a))])
    return int(np.linalg.matrix_rank(matrix)), float(np.linalg.cond(matrix))
