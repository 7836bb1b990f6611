"""A filter of your own, written as in a textbook. Here: the maximum correntropy Kalman filter, for outliers.

Change what differs in yours. It is compiled, runs over batches and beside envs, and studies tune it:

thruster compare --filter ekf --filter template:Template --scenario outliers --knows true
thruster tune --filter template:Template --scenario outliers --trials 30
env = EstimateState(env, filter="template:Template")     # a wrapper around an env, in Python
"""

from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.operations import (
    at_most,
    diagonal,
    divide,
    exponential,
    joseph,
    mask_missing,
    present,
    sym,
    uncorrelated,
    wrap,
)
from filters.algebra.points import log_density, root
from filters.algebra.roots import forward_quotient
from filters.filter import PageFilter
from filters.gaussian.extended import add_process_noise, propagate
from filters.pages.page import Page


def update(model, x, P, z):
    """The measurement z (m,) of a state of mean x (n,) and covariance P (n, n).

    A page computes with small matrices: + - @ *, .T and the functions of `filters.algebra`. It cannot branch
    (`if`) on their values, only choose (`operations.choose`). The model has f(x, u), F, h(x), H, Q and R;
    `model.own` has the fields below. Channels of z that are NaN are missing: `mask_missing` makes their rows zero.
    """
    measured = present(z)
    H, R = mask_missing(measured, model.H(x)), uncorrelated(measured, model.R)
    v = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + R)
    L, M, step = root(P), root(R), None
    for _ in range(model.own.iterations):
        if step is None:  # first the Kalman filter's gain
            step = divide(P @ H.T, S) @ v
        noise = M @ diagonal(inverse_weights(model, forward_quotient(M, v - H @ step))) @ M.T
        spread = sym(L @ diagonal(inverse_weights(model, forward_quotient(L, step))) @ L.T)
        K = divide(spread @ H.T, sym(H @ spread @ H.T) + sym(noise))
        step = K @ v
    return wrap(x + step, model.state_angles), joseph(P, K, H, R), v, S, log_density(v, S, measured)


def inverse_weights(model, e):
    """1/G(e) of errors in standard deviations, with the kernel G(e) = exp(-e^2/(2 bandwidth^2))."""
    b = model.own.bandwidth
    return exponential(at_most(e * e * (0.5 / (b * b)), 100.0))  # finite, however far off


@dataclass(frozen=True, kw_only=True, eq=False)
class Template(PageFilter):
    """Maximum correntropy Kalman filter: measurements that fit badly have little weight.

        repeat  K = P~ H' (H P~ H' + R~)^-1,  P~ = L diag(1/G(L^-1 (x_i - x))) L',  R~ likewise of z - H x_i,
                x_i = x + K v;  at last P = (I - K H) P (I - K H)' + K R K'

    Attributes:
        bandwidth: of the kernel, in standard deviations; as it grows the filter becomes the extended one.
        iterations: of the fixed point.

    Source: Chen, Liu, Zhao, Principe (2017), "Maximum correntropy Kalman filter", Automatica 76.
    """

    name: ClassVar[str] = "mckf"
    page: ClassVar[Page] = Page(propagate, add_process_noise, update)
    unrolled: ClassVar[tuple[str, ...]] = ("iterations",)  # whole numbers that say how often a loop runs
    ranges: ClassVar[dict[str, tuple[float, float]]] = {"bandwidth": (1.0, 20.0)}  # that studies search
    bandwidth: float = 3.0
    iterations: int = 3
