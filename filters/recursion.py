"""The algebra of a Kalman filter and of its derivatives along a parameter, for a model's sizes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

from filters.likelihood_slopes import present_rows_of
from numerics.angles import kept
from numerics.formulas import formula
from numerics.matrices import cholesky_factor, masked, row_solver
from numerics.tuples import matrix_reader, matrix_writer, vector_reader, vector_writer
from plants.layout import constants_reader, number_places
from plants.shape import Shape, innovation_of


class Recursion(NamedTuple):
    """What a filter's recursion reads of a model's row and of a parameter's, and what it works out."""

    constants: Callable
    scales: Callable
    control: Callable
    reading: Callable
    prior_mean: Callable
    prior_cov: Callable
    q: Callable
    r: Callable
    q_slope: Callable
    r_slope: Callable
    mean_slope: Callable
    cov_slope: Callable
    store_mean_slope: Callable
    store_cov_slope: Callable
    difference: Callable
    root_of: Callable
    divide: Callable
    present_rows: Callable
    present: Callable
    moved: Callable
    moved_slope: Callable
    grown: Callable
    seen: Callable
    seen_slope: Callable
    correlation: Callable
    uneven_gain: Callable
    corrected: Callable
    corrected_slope: Callable
    reduced: Callable
    reduced_slope: Callable


@cache
def recursion_of(shape: Shape) -> Recursion:
    """The functions for a model's sizes and angles; a parameter's row is dx (n,), then dP (n, n)."""
    n, m = shape.n, shape.m
    places = number_places(n, m)
    nn, mn, mm, nm = (n, n), (m, n), (m, m), (n, m)
    return Recursion(
        constants=constants_reader(shape),
        scales=vector_reader(n, places.scales),
        control=vector_reader(shape.inputs),
        reading=vector_reader(m),
        prior_mean=kept(vector_reader(n, places.prior_mean), "numbers", shape.state_angles),
        prior_cov=matrix_reader(n, n, places.prior_cov),
        q=matrix_reader(n, n, places.q),
        r=matrix_reader(m, m, places.r),
        q_slope=matrix_reader(n, n),
        r_slope=matrix_reader(m, m),
        mean_slope=vector_reader(n),
        cov_slope=matrix_reader(n, n, n),
        store_mean_slope=vector_writer(n),
        store_cov_slope=matrix_writer(n, n, n),
        difference=innovation_of(shape),
        root_of=cholesky_factor(m),
        divide=row_solver(n, m),  # by S
        present_rows=present_rows_of(m, n),
        present=masked(m),
        moved=formula("F P F'", F=nn, P=nn),
        moved_slope=formula("dF P F' + F dP F' + F P dF'", F=nn, dF=nn, P=nn, dP=nn),
        grown=formula("P + Q", P=nn, Q=nn),
        seen=formula("H P H' + R", H=mn, P=nn, R=mm),
        seen_slope=formula("dH P H' + H dP H' + H P dH' + dR", H=mn, dH=mn, P=nn, dP=nn, dR=mm),
        correlation=formula("P H'", P=nn, H=mn),
        uneven_gain=formula("dP H' + P dH' - K dS", H=mn, dH=mn, P=nn, dP=nn, K=nm, dS=mm),
        corrected=kept(formula("x + K v", x=(n,), K=nm, v=(m,)), "x, K, v", shape.state_angles),
        corrected_slope=formula("dx + dK v - K dy", dx=(n,), K=nm, dK=nm, v=(m,), dy=(m,)),
        reduced=formula("P - K S K'", P=nn, K=nm, S=mm),
        reduced_slope=formula("dP - dK S K' - K dS K' - K S dK'", dP=nn, K=nm, dK=nm, S=mm, dS=mm),
    )
