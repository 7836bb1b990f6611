"""`ContinuousModel`: rates of a plant in continuous time, from which follows a model for any sample time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg import expm

from thruster_env.numerics.checks import at_least, covariance, positive, shown, vector
from thruster_env.numerics.derivatives import jacobian
from thruster_env.numerics.integration import runge_kutta
from thruster_env.plants.state_space import StateSpaceModel


@dataclass(frozen=True, kw_only=True, eq=False)
class ContinuousModel:
    """A plant in continuous time, whose noise is white, measured at any times.

        dx/dt = rates(x, u, c) + w(t),  E[w(t) w(s)'] = S delta(t - s);   z = h(x, c) + v,  v ~ N(0, R)

    `rates(x, u, c)` takes and returns tuples, as the functions of a `StateSpaceModel`; the constants c are a
    NamedTuple with a field `substep`, the length of a Runge-Kutta step [s], which `at` sets.

    Attributes:
        rates: dx/dt without noise.
        observe: h, without noise.
        densities: S, (n, n) or n numbers, in the square of each state's unit per second.
        constants: of rates and h.
        arguments: the other fields of `StateSpaceModel`: R, prior, quantities, operating point and the like.

    Raises:
        ValueError: for constants without `substep`, or a density that is no covariance.

    Source: van Loan (1978), "Computing integrals involving the matrix exponential", for Q; Sarkka, Solin (2019),
    Applied Stochastic Differential Equations, section 6.3.
    """

    rates: Callable
    observe: Callable
    densities: Any
    constants: Any
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        """Check what is given; raise ValueError that states the rule and the value."""
        names = getattr(self.constants, "_fields", ())
        if "substep" not in names:
            raise ValueError(
                f"constants must be a NamedTuple with a field substep, but got {shown(self.constants)}"
            )
        mean = vector("prior_mean", self.arguments.get("prior_mean", ()))
        object.__setattr__(self, "densities", covariance("densities", self.densities, len(mean)))

    def at(self, dt: float, substeps: int = 1) -> StateSpaceModel:
        """The model for a sample time [s]: Runge-Kutta in some equal parts, and Q by van Loan.

        A filter of it can be `live`, with `noise=continuous.noise`.
        """
        dt, substeps = positive("dt", dt), at_least("substeps", substeps, 1, 10_000)
        return StateSpaceModel(
            transition=runge_kutta(self.rates, len(self.densities)),
            observe=self.observe,
            constants=self.constants._replace(substep=dt / substeps),
            substeps=substeps,
            process_noise_cov=self.noise(dt),
            **self.arguments,
        )

    def noise(self, dt: float) -> np.ndarray:
        """Q of a step of length dt [s], of the rates linearised at the operating point, or at the prior mean.

        Q = int_0^dt e^{A t} S e^{A' t} dt,   exp([-A, S; 0, A'] dt) = [., G; 0, F'],   Q = F G
        """
        a, n = self.slope, len(self.densities)
        block = np.block([[-a, self.densities], [np.zeros((n, n)), a.T]])
        found = expm(block * positive("dt", dt))
        q = found[n:, n:].T @ found[:n, n:]
        return 0.5 * (q + q.T)

    @property
    def slope(self) -> np.ndarray:
        """A, the derivative of the rates by the state, (n, n)."""
        given = self.arguments
        x = given.get("operating_state")
        x = np.asarray(given["prior_mean"] if x is None else x, dtype=np.float64)
        u = given.get("operating_input")
        count = given.get("inputs") or len(given.get("input_quantities") or ())
        u = np.zeros(count) if u is None else np.asarray(u, dtype=np.float64)
        slopes = jacobian(self.rates, None, len(x), len(x), "u, c")
        return np.array(slopes(tuple(x.tolist()), (1.0,) * len(x), tuple(u.tolist()), self.constants))
