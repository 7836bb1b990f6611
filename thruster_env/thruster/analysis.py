"""The thruster near an operating point as a linear system: poles, controllability, observability, responses.

    dx/dt = A x + B u,  T = C x

for small deviations of the state x = (omega_m [rad/s], U_a [m/s]), the inputs u = (V_s [V], U_0 [m/s]) and the
thrust T [N] from their values at the operating point. No input acts on the thrust directly.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import one_of, short_repr
from thruster_env.core.files import BLUE, DARK, RUST, new_figure, save_figure, tidy
from thruster_env.core.matrices import observability, zero_order_hold
from thruster_env.thruster.dynamics import (
    rates,
    rates_tangent,
    substep,
    thrust_and_torque,
    thrust_and_torque_tangent,
)
from thruster_env.thruster.parameters import ThrusterParameters, derive_constants

ONE_STEP_ACCURACY = 1e-4  # of each state's range, over the whole voltage range


class SteadyState(NamedTuple):
    """A thruster at rest under a constant voltage."""

    omega_m: float  # [rad/s]
    U_a: float  # [m/s]
    thrust: float  # [N]


@lru_cache(maxsize=256)
def steady_state(p: ThrusterParameters, voltage: float, ambient_velocity: float = 0.0) -> SteadyState:
    """Solve rates(x, (V_s, U_0)) = 0 for the state that a constant voltage [V] settles to.

    Thrust, torque and momentum drag are homogeneous of degree two, so at U_0 = 0 the ratio r = U_a/omega_m
    solves T(1, r) = K4 r |r| at any voltage (in reverse T(-1, -r) = -K4 r |r|), and omega_m is the root of a
    quadratic. That point is the start of a simulation where U_0 is not zero; a Newton-type solution then polishes
    where that settles. (Against the flow there are saddles too, on which Newton's method may end.)

    Raises ValueError if no steady state is found.
    """
    c = derive_constants(p, ambient_velocity)
    if voltage == 0 and ambient_velocity == 0:
        return SteadyState(0.0, 0.0, 0.0)

    sign = -1.0 if voltage < 0 else 1.0

    def forces(r):
        return [sign * force for force in thrust_and_torque((sign, sign * r), c)]

    def imbalance(r):
        return forces(r)[0] * c.inverse_mass - c.flow_drag * r * abs(r)

    # U_a = -U_p turns the attack angle past zero lift for every preset, so the root lies between.
    if not imbalance(0.0) * imbalance(20.0 * c.blade_speed) < 0:
        raise ValueError(f"blade_angle must allow a steady state, but got {p.blade_angle}")
    ratio = _bisected(imbalance, 0.0, 20.0 * c.blade_speed)
    load = c.load_gain * forces(ratio)[1]
    drive = c.voltage_gain * abs(voltage)
    # load omega^2 + K1 omega - K2 |V| = 0, in the form that survives load -> 0
    omega = 2.0 * drive / (c.motor_damping + (c.motor_damping**2 + 4.0 * load * drive) ** 0.5)
    x = np.array([omega, ratio * omega]) * (sign if voltage else 0.0)
    if ambient_velocity != 0:
        from scipy.integrate import solve_ivp  # a tenth of a second, which others need not wait
        from scipy.optimize import root

        u = (voltage, ambient_velocity)
        settled = solve_ivp(lambda t, y: rates(tuple(y), u, c), (0.0, 1e5), x, method="LSODA", rtol=1e-8)
        solution = root(lambda y: rates(tuple(y), u, c), settled.y[:, -1], jac=lambda y: _plant_matrix(y, u, c))
        if not solution.success:
            raise ValueError(f"voltage {voltage} V at {ambient_velocity} m/s has no steady state that was found")
        x = solution.x
    return SteadyState(float(x[0]), float(x[1]), float(thrust_and_torque((float(x[0]), float(x[1])), c)[0]))


def _bisected(function: Callable[[float], float], low: float, high: float) -> float:
    """The number between two at which a function changes its sign; importing SciPy would take longer."""
    rises = function(high) > 0.0
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (low, middle) if (function(middle) > 0.0) == rises else (middle, high)
    return middle


def state_range(p: ThrusterParameters, max_voltage: float) -> np.ndarray:
    """Range (2,) of (omega_m [rad/s], U_a [m/s]) over the voltages +-max_voltage [V]: largest minus smallest."""
    ahead, astern = steady_state(p, float(max_voltage)), steady_state(p, -float(max_voltage))
    return np.abs(np.array(ahead[:2]) - np.array(astern[:2]))


def _plant_matrix(x, u, c) -> np.ndarray:
    x = (float(x[0]), float(x[1]))
    return np.column_stack([rates_tangent(x, (1.0, 0.0), u, c), rates_tangent(x, (0.0, 1.0), u, c)])


def jacobians(
    p: ThrusterParameters, x, voltage: float = 0.0, ambient_velocity: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Continuous-time A (2, 2), B (2, 1) for the voltage, and C (1, 2) of the thrust at state x, analytic.

    dx/dt = A x + B V_s and T = C x for small deviations; units follow from (rad/s, m/s), V and N.
    """
    c = derive_constants(p, ambient_velocity)
    x = (float(x[0]), float(x[1]))
    a = _plant_matrix(x, (voltage, ambient_velocity), c)
    thrust_slopes = [thrust_and_torque_tangent(x, dx, c)[0] for dx in ((1.0, 0.0), (0.0, 1.0))]
    return a, np.array([[c.voltage_gain], [0.0]]), np.array([thrust_slopes])


def run_substeps(x: tuple, u: tuple, p: ThrusterParameters, dt: float, substeps: int) -> tuple:
    """State after dt [s] of constant input u = (V_s, U_0), in `substeps` Runge-Kutta steps; arrays allowed."""
    c = derive_constants(p, substep=dt / substeps)
    for _ in range(substeps):
        x = substep(x, u, c)
    return x


def required_substeps(p: ThrusterParameters, dt: float, max_voltage: float, ambient_velocity: float = 0.0) -> int:
    """Fewest Runge-Kutta steps a sample time that hold the one-step accuracy over the whole voltage range.

    The one-step map is compared with one of 512 substeps from every state on a grid that spans the steady
    states of +-max_voltage, under voltages up to full reversal.

    Raises ValueError if 256 substeps do not suffice: dt is then far too long for the plant.
    """
    return required_substeps_of_all(((p, ambient_velocity),), dt, max_voltage)


@lru_cache(maxsize=64)
def required_substeps_of_all(
    cases: tuple[tuple[ThrusterParameters, float], ...], dt: float, max_voltage: float
) -> int:
    """`required_substeps` that suffice for several thrusters, each with a flow U_0 [m/s], computed at once."""
    limits = np.stack([ONE_STEP_ACCURACY * state_range(p, max_voltage) for p, _ in cases], axis=1)
    ends = [(steady_state(p, max_voltage), steady_state(p, -max_voltage)) for p, _ in cases]
    fastest = np.array([max(ahead.omega_m, -astern.omega_m) for ahead, astern in ends])
    fastest_flow = np.array([max(ahead.U_a, -astern.U_a) for ahead, astern in ends])
    grid = np.linspace(-1.0, 1.0, 5)
    omega, flow, voltage = (g.ravel() for g in np.meshgrid(grid, grid, grid, indexing="ij"))
    ambient = np.array([u_0 for _, u_0 in cases])[:, None]
    p = _stacked([p for p, _ in cases])
    x = omega * fastest[:, None], flow * (fastest_flow[:, None] + np.abs(ambient))
    u, needed = (voltage * max_voltage, ambient), np.zeros(len(cases), dtype=int)
    with np.errstate(all="ignore"):
        exact = np.array(run_substeps(x, u, p, dt, 512))
        for count in (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256):
            error = np.abs(np.array(run_substeps(x, u, p, dt, count)) - exact).max(axis=2)
            needed[(needed == 0) & (error <= limits).all(axis=0)] = count
            if needed.all():
                return int(needed.max())
    raise ValueError(f"dt must be short enough for 256 Runge-Kutta steps to follow the plant, but got {dt!r}")


def _stacked(several: list[ThrusterParameters]) -> ThrusterParameters:
    """Parameters (C, 1) of several thrusters of one convention of angles; a number where all have the same."""
    columns = {name: [getattr(p, name) for p in several] for name in ThrusterParameters._fields}
    differing: dict[str, Any] = {
        name: np.array(values)[:, None] for name, values in columns.items() if len(set(values)) > 1
    }
    return several[0]._replace(**differing)


INPUTS = ("V_s", "U_0")
STATES = (("motor speed $\\omega_m$", "rad/s"), ("flow velocity $U_a$", "m/s"))  # labels in pictures


class LinearModel(NamedTuple):
    """The matrices of a linear thruster, float64."""

    a: np.ndarray  # A (2, 2)
    b: np.ndarray  # B (2, 2), one column per input
    c: np.ndarray  # C (1, 2)


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
    denominator = np.poly(model.a)
    column = model.b[:, [_column(input_name)]]
    return np.poly(model.a - column @ model.c) - denominator, denominator


def frequency_response(model: LinearModel, frequencies, input_name: str = "V_s") -> np.ndarray:
    """Complex gain C (j w I - A)^-1 B from an input to thrust at frequencies w [rad/s], of their shape.

    Raises:
        ValueError: if the input is not one of INPUTS.
    """
    numerator, denominator = transfer_function(model, input_name)
    s = 1j * np.asarray(frequencies, dtype=np.float64)
    return np.polyval(numerator, s) / np.polyval(denominator, s)


def step_response(model: LinearModel, times, input_name: str = "V_s") -> np.ndarray:
    """Deviations (K, 3) of omega_m, U_a and T at times (K,) [s] after an input grew by one unit.

    Args:
        model: the linear thruster.
        times: evenly spaced, from 0 on.
        input_name: "V_s" (a step of 1 V) or "U_0" (1 m/s).

    Raises:
        ValueError: if the input is not one of INPUTS, or times are not even.
    """
    times = np.asarray(times, dtype=np.float64)
    if times[0] != 0 or not np.allclose(np.diff(times), times[1]):
        raise ValueError(f"times must be even and begin at 0, but got {short_repr(times)}")
    a_d, b_d = zero_order_hold(model.a, model.b[:, [_column(input_name)]], times[1])
    states = np.zeros((len(times), 2))
    for k in range(1, len(times)):
        states[k] = a_d @ states[k - 1] + b_d[:, 0]
    return np.hstack([states, states @ model.c.T])


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


def linear_model(p: ThrusterParameters, x, voltage: float = 0.0, ambient_velocity: float = 0.0) -> LinearModel:
    """The slopes of rates and thrust at state x = (omega_m, U_a), voltage [V] and ambient flow [m/s].

        B = [[K2, 0], [0, 2 (K4/K3) |U_a - U_0|]]

    Beside `jacobians` it has the ambient flow as second input: the form in which the papers print theirs.
    """
    a, b, c = jacobians(p, x, voltage, ambient_velocity)
    by_ambient = 2.0 * p.momentum_drag / p.added_mass * abs(float(x[1]) - ambient_velocity)
    return LinearModel(a, np.column_stack([b, [0.0, by_ambient]]), c)


def response_figure(path: str | Path, model: LinearModel, dt: float, title: str) -> Path:
    """Bode plot of the thrust over the voltage, and the response to a step of 1 V.

    Marked are the frequencies of the eigenvalues and the Nyquist frequency pi/dt, and the values that the
    step settles to.

    Args:
        path: file to write, .png, .svg or .pdf.
        model: the thruster near an operating point.
        dt: sample time [s].
        title: said above the picture.

    Raises:
        ValueError: if the voltage does not move the thrust to first order, as at rest, or nothing can be written.
    """
    frequencies, times = response_grids(model)
    gain = frequency_response(model, frequencies)
    if not gain.all():
        rule = "the thrust must move with the voltage for its Bode plot to be drawn (at rest it does not)"
        raise ValueError(f"{rule}, but got C = {model.c[0].tolist()}")
    figure = new_figure((9.6, 6.0))
    left, right = figure.subfigures(1, 2)
    _draw_bode(left.subplots(2, 1, sharex=True), frequencies, gain, np.linalg.eigvals(model.a), dt)
    _draw_step(right.subplots(3, 1, sharex=True), times, step_response(model, times), model)
    for part in (left, right):
        part.align_ylabels()
    figure.suptitle(title, fontsize=11)
    return save_figure(figure, path)


def _draw_bode(axes, frequencies, gain, eigenvalues, dt) -> None:
    from matplotlib.ticker import MaxNLocator

    tidy(axes)
    magnitude, phase = axes
    magnitude.loglog(frequencies, np.abs(gain), color=BLUE)
    phase.semilogx(frequencies, np.rad2deg(np.unwrap(np.angle(gain))), color=BLUE)
    for axis in axes:
        for index, value in enumerate(np.abs(eigenvalues)):
            axis.axvline(value, color=DARK, linestyle=":", linewidth=1, label="" if index else "eigenvalues")
        axis.axvline(np.pi / dt, color=RUST, linestyle="--", linewidth=1, label=f"Nyquist, dt = {dt:g} s")
    magnitude.set_title("thrust over voltage", fontsize=10)
    magnitude.set_ylabel("magnitude [N/V]")
    magnitude.legend(loc="lower left", fontsize=9, framealpha=1, edgecolor="none")
    phase.yaxis.set_major_locator(MaxNLocator(6, steps=[1.5, 3, 4.5, 9, 10]))
    phase.set_ylabel("phase [deg]")
    phase.set_xlabel("frequency [rad/s]")


def _draw_step(axes, times, response, model) -> None:
    tidy(axes)
    labels = (*STATES, ("thrust $T$", "N"))
    for axis, (label, unit), values, settled in zip(axes, labels, response.T, dc_gain(model)[:, 0], strict=True):
        axis.axhline(settled, color=DARK, linestyle=":", linewidth=1, label="settled")
        axis.plot(times, values, color=BLUE)
        axis.set_ylabel(f"{label}\n[{unit}]")
    axes[0].set_title("deviation after a step of 1 V", fontsize=10)
    axes[0].legend(frameon=False, fontsize=9)
    axes[-1].set_xlabel("time [s]")
