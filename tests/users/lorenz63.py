"""Lorenz's three equations, of which only x is measured: a chaotic plant that a filter must not lose.

    x' = 10 (y - x),   y' = x (28 - z) - y,   z' = x y - 8/3 z

What I had: Q = 0.1 in each state and R = 2, both twice the truth's: only their ratio is right. No unit anywhere:
time is that of the equations, and `dt` need not be given.

Source: E. N. Lorenz (1963), "Deterministic nonperiodic flow", J. Atmospheric Sciences 20, 130-141.
"""

from typing import NamedTuple

from filters import StateSpaceModel
from thruster_env.core.derivatives import runge_kutta
from tuning.problems.model_problem import ModelProblem


class Constants(NamedTuple):
    """Numbers of the equations."""

    substep: float = 0.01
    sigma: float = 10.0
    rho: float = 28.0
    beta: float = 8.0 / 3.0


def rates(x, u, c):
    """(x', y', z')."""
    return (c.sigma * (x[1] - x[0]), x[0] * (c.rho - x[2]) - x[1], x[0] * x[1] - c.beta * x[2])


def look(x, c):
    """The first state."""
    return (x[0],)


def model(q, r):
    """The equations over 0.05 of their time, with a variance of each state and one of the measurement."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=Constants(),
        substeps=5,
        inputs=0,
        process_noise_cov=[q] * 3,
        measurement_noise_cov=[r],
        prior_mean=[1.5, -1.5, 25.5],
        prior_cov=[2.0] * 3,
        states=["x", "y", "z"],
    )


move = runge_kutta(rates, 3)
problem = ModelProblem(
    model(q=0.05, r=1.0),
    model(q=0.1, r=2.0),
    steps=300,
    scale=(0.5, 1.0, 1.0),
    name="lorenz63",
    about="chaos, seen in x alone, with Q and R both twice what they are",
)
