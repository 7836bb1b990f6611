"""The thruster near an operating point as a linear system: poles, controllability, observability, responses.

    dx/dt = A x + B u,  T = C x

for small deviations of the state x = (omega_m [rad/s], U_a [m/s]), the inputs u = (V_s [V], U_0 [m/s]) and the
thrust T [N] from their values at the operating point. No input acts on the thrust directly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import one_of
from thruster_env.core.linear_systems import observability, zero_order_hold
from thruster_env.thruster.linear.steady_state import jacobians
from thruster_env.thruster.parameters import ThrusterParameters

INPUTS = ("V_s", "U_0")
GAIN_UNITS = {"V_s": "N/V", "U_0": "N s/m"}  # of thrust over each input


class LinearModel(NamedTuple):
    """The matrices of a linear thruster, float64."""

    a: np.ndarray  # A (2, 2)
    b: np.ndarray  # B (2, 2), one column per input
    c: np.ndarray  # C (1, 2)


def linear_model(p: ThrusterParameters, x, voltage: float = 0.0, ambient_velocity: float = 0.0) -> LinearModel:
    """The slopes of rates and thrust at state x = (omega_m, U_a), voltage [V] and ambient flow [m/s].

        B = [[K2, 0], [0, 2 (K4/K3) |U_a - U_0|]]

    Beside `linear.jacobians` it has the ambient flow as second input: the form in which the papers print theirs.
    """
    a, b, c = jacobians(p, x, voltage, ambient_velocity)
    by_ambient = 2.0 * p.momentum_drag / p.added_mass * abs(float(x[1]) - ambient_velocity)
    return LinearModel(a, np.column_stack([b, [0.0, by_ambient]]), c)


def equilibrium(model: LinearModel, u) -> np.ndarray:
    """Equilibrium (omega_m, U_a, T) of a linear system under u = (V_s, U_0); not reached if it is unstable."""
    x = -np.linalg.solve(model.a, model.b @ np.asarray(u, dtype=np.float64))
    return np.append(x, model.c @ x)


def controllability(a: np.ndarray, b: np.ndarray) -> tuple[int, float]:
    """Rank and condition number of the controllability matrix [B, A B, ...] of a discrete pair (A, B)."""
    return observability(a.T, b.T)  # the transposed matrix of the dual pair


def dc_gain(model: LinearModel) -> np.ndarray:
    """Steady-state gains: rows omega_m, U_a and T, columns the inputs, (3, 2).

    The states are x = -A^-1 B u and the thrust is C x. NaN unless the model is stable.
    """
    if np.linalg.eigvals(model.a).real.max() >= 0:
        return np.full((3, len(INPUTS)), np.nan)
    states = -np.linalg.solve(model.a, model.b)
    return np.vstack([states, model.c @ states])


def transfer_function(model: LinearModel, input_name: str = "V_s") -> tuple[np.ndarray, np.ndarray]:
    """Numerator (3,) and denominator (3,) of C (s I - A)^-1 B from an input to thrust, falling powers of s.

    Raises:
        ValueError: if the input is not one of INPUTS.
    """
    from scipy.signal import ss2tf

    numerator, denominator = ss2tf(*model, np.zeros((1, len(INPUTS))), input=_column(input_name))
    return numerator[0], denominator


def frequency_response(model: LinearModel, frequencies, input_name: str = "V_s") -> np.ndarray:
    """Complex gain C (j w I - A)^-1 B from an input to thrust at frequencies w [rad/s], of their shape.

    Raises:
        ValueError: if the input is not one of INPUTS.
    """
    from scipy.signal import freqs

    return freqs(*transfer_function(model, input_name), worN=np.asarray(frequencies, dtype=np.float64))[1]


def step_response(model: LinearModel, times, input_name: str = "V_s") -> np.ndarray:
    """Deviations (K, 3) of omega_m, U_a and T at times (K,) [s] after an input grew by one unit.

    Args:
        model: the linear thruster.
        times: evenly spaced, from 0 on.
        input_name: "V_s" (a step of 1 V) or "U_0" (1 m/s).

    Raises:
        ValueError: if the input is not one of INPUTS, or times are not even.
    """
    from scipy.signal import step

    column = _column(input_name)
    outputs = np.vstack([np.eye(2), model.c])
    return step((model.a, model.b[:, [column]], outputs, np.zeros((3, 1))), T=np.asarray(times))[1]


def _column(input_name: str) -> int:
    return INPUTS.index(one_of("input_name", input_name, INPUTS))


def response_grids(model: LinearModel, points: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [rad/s] and times [s] that show all of a model: each (points,).

    The frequencies reach a hundred times below the slowest and above the fastest eigenvalue, the times to five
    time constants of the slowest. Eigenvalues of zero (at rest) are left out.
    """
    speeds = np.abs(np.linalg.eigvals(model.a))
    slowest, fastest = speeds[speeds > 0].min(), speeds.max()
    return np.geomspace(slowest / 100, 100 * fastest, points), np.linspace(0.0, 5.0 / slowest, points)


class Analysis(NamedTuple):
    """Results of the analysis of a linear thruster that is sampled every dt seconds."""

    model: LinearModel
    eigenvalues: np.ndarray  # (2,) complex [1/s], the fastest first
    a_d: np.ndarray  # A_d (2, 2), zero-order hold
    b_d: np.ndarray  # B_d (2, 2)
    controllability: tuple[int, float]  # rank and condition number of [B_d, A_d B_d], of the voltage alone
    observability: tuple[int, float]  # rank and condition number of [C; C A_d]
    denominator: np.ndarray  # (3,) det(s I - A), falling powers of s
    numerators: dict[str, np.ndarray]  # (3,) by input: thrust over input is numerator/denominator
    dc_gain: np.ndarray  # (3, 2): omega_m, U_a and T that a constant unit input settles to


def analyse(model: LinearModel, dt: float, scale) -> Analysis:
    """Analyse a linear thruster.

    Args:
        model: the linear thruster.
        dt: sample time [s].
        scale: ranges (2,) of omega_m [rad/s] and U_a [m/s], positive. Condition numbers depend on units; each
            state is scaled by its range, so that a large number is a property of the thruster and not of rad/s.
    """
    a_d, b_d = zero_order_hold(model.a, model.b, dt)
    scale = np.asarray(scale, dtype=np.float64)
    scaled_a, scaled_b = a_d * scale / scale[:, None], b_d[:, :1] / scale[:, None]
    return Analysis(
        model=model,
        eigenvalues=np.sort_complex(np.linalg.eigvals(model.a)),
        a_d=a_d,
        b_d=b_d,
        controllability=controllability(scaled_a, scaled_b),
        observability=observability(scaled_a, model.c * scale),
        denominator=transfer_function(model)[1],
        numerators={name: transfer_function(model, name)[0] for name in INPUTS},
        dc_gain=dc_gain(model),
    )
