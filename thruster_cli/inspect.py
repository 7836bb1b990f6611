"""`thruster inspect`: a thruster at an operating point."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import typer

from thruster_cli.output import JsonOption, SeedOption, emit, table
from thruster_env.checks import within
from thruster_env.linear import jacobians, observability, state_range, steady_state, zero_order_hold
from thruster_env.plant import DEFAULT_DT, DEFAULT_MAX_VOLTAGE, make_plant


def command(
    preset: Annotated[
        str, typer.Option(help="tunnel, tunnel_physical, open_bladed, open_bladed_corrected.")
    ] = "tunnel",
    voltage: Annotated[float, typer.Option(help="Operating voltage [V].")] = 12.0,
    ambient_velocity: Annotated[float, typer.Option(help="Ambient flow along the axis U_0 [m/s].")] = 0.0,
    dt: Annotated[float, typer.Option(help="Sample time [s].")] = DEFAULT_DT,
    max_voltage: Annotated[
        float, typer.Option(help="Voltage range the integration must follow [V].")
    ] = DEFAULT_MAX_VOLTAGE,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Show a thruster's steady state, linearisation, stiffness and observability at a voltage.

    Nothing here is random; --seed is accepted, as by every command, and changes nothing.
    """
    plant = make_plant(preset, dt, max_voltage, ambient_velocity)
    voltage = within("voltage", voltage, max_voltage)
    point = steady_state(plant.parameters, voltage, ambient_velocity)
    a, b, c = jacobians(plant.parameters, point[:2], voltage, ambient_velocity)
    a_d, _ = zero_order_hold(a, b, dt)
    eigenvalues = np.linalg.eigvals(a)
    rank, condition = observability(a_d, c)
    spread = state_range(plant.parameters, max_voltage)
    rows = [
        ["steady motor speed omega_m [rad/s]", f"{point.omega_m:.4g}"],
        ["steady flow velocity U_a [m/s]", f"{point.U_a:.4g}"],
        ["steady thrust T [N]", f"{point.thrust:.4g}"],
        ["range of omega_m over the voltages [rad/s]", f"{spread[0]:.4g}"],
        ["range of U_a over the voltages [m/s]", f"{spread[1]:.4g}"],
        ["A = d(rates)/d(omega_m, U_a), row 1", _numbers(a[0])],
        ["A, row 2", _numbers(a[1])],
        ["B = d(rates)/dV_s", _numbers(b[:, 0])],
        ["C = dT/d(omega_m, U_a) [N s/rad, N s/m]", _numbers(c[0])],
        ["eigenvalues [1/s]", _numbers(np.sort_complex(eigenvalues))],
        ["stiffness: largest |eigenvalue| dt", f"{np.abs(eigenvalues).max() * dt:.3g}"],
        ["Runge-Kutta substeps a sample time", str(plant.substeps)],
        ["observability: rank, condition number", f"{rank}, {condition:.3g}"],
    ]
    data = {
        "preset": preset,
        "voltage": voltage,
        "ambient_velocity": ambient_velocity,
        "dt": dt,
        "steady_state": dict(zip(("omega_m [rad/s]", "U_a [m/s]", "thrust [N]"), point, strict=True)),
        "range": spread,
        "A": a,
        "B": b,
        "C": c,
        "eigenvalues": [[value.real, value.imag] for value in eigenvalues],
        "substeps": plant.substeps,
        "observability": {"rank": rank, "condition_number": condition},
    }
    title = f"Preset {preset} at {voltage:g} V, U_0 = {ambient_velocity:g} m/s, dt = {dt:g} s"
    emit([table(title, ["quantity", "value"], rows)], data, json)


def _numbers(values) -> str:
    return "  ".join(f"{value.real:.4g}" if value.imag == 0 else f"{value:.4g}" for value in values)
