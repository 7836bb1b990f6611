"""The tables of docs/plant.md that hold computed numbers, as Markdown: `TABLES` has them by name."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
from scipy.integrate import solve_ivp

from pages.page import digits
from thruster_env.core.text_tables import markdown_table
from thruster_env.env.commands import ObserveStateVector
from thruster_env.thruster.control.controllers import LQRController, PIController
from thruster_env.thruster.dynamics import rates
from thruster_env.thruster.linear.analysis import (
    jacobians,
    required_substeps,
    run_substeps,
    state_range,
    steady_state,
)
from thruster_env.thruster.parameters import PRESETS, ThrusterParameters, derive_constants
from thruster_env.thruster.plant import DEFAULT_DT, DEFAULT_MAX_VOLTAGE, DEFAULT_MEASUREMENT_NOISE

FULL_VOLTAGE = dict.fromkeys(PRESETS, DEFAULT_MAX_VOLTAGE) | {"t200": 13.0}  # [V]
SHARES = (0.25, 0.5, 1.0)  # of the full voltage
COUNTS = (1, 2, 3, 4, 6, 8)  # of Runge-Kutta steps a sample time
TASKS = ("BowThruster-v0", "BowThrusterTracking-v0", "BowThrusterReversal-v0", "BowThrusterLinear-v0")
EPISODES, FIRST_SEED = 200, 1000

SYMBOLS = {
    "lift_coefficient": "C_Lmax [-]",
    "drag_coefficient": "C_Dmax [-]",
    "motor_damping": "K1 [1/s]",
    "voltage_gain": "K2 [rad/(s^2 V)]",
    "load_gain": "K_h [1/(kg m^2)]",
    "added_mass": "K3 [kg]",
    "momentum_drag": "K4 [kg/m]",
    "area": "A [m^2]",
    "diameter": "D = 2 R [m]",
    "gear_ratio": "N [-]",
    "density": "rho [kg/m^3]",
    "blade_angle": "p [rad]",
    "angles": "angle pair",
    "thrust_asymmetry": "e [-]",
}
SOURCES = {
    "tunnel": "Healey 1995, as printed by Kiki 2020 and Nurhadi 2022",
    "open_bladed": "the same",
    "tunnel_physical": "`tunnel`, corrected",
    "open_bladed_corrected": "`open_bladed`, corrected",
    "t200": "Blue Robotics' bollard table of 2019; `tuning/experiments/bollard.py`",
}
INFERRED = {
    "tunnel": "nothing: K_h = 17.79, as printed",
    "open_bladed": "nothing: K2 = 0.65, as printed",
    "tunnel_physical": "K_h = 17 790, A = pi D^2/4, rotor-plane angles",
    "open_bladed_corrected": "K2 = 650, A = pi D^2/4",
    "t200": "K_h, K3, K4, p; a motor without friction",
}


def presets() -> str:
    """What each preset does at a quarter, half and full voltage, where it is from and what is inferred."""
    rows = {
        "full voltage [V]": lambda name, p: f"{FULL_VOLTAGE[name]:g}",
        "steady thrust [N]": lambda name, p: _list(point.thrust for point in _points(name, p)),
        "... astern [N]": lambda name, p: _astern(name, p),
        "steady motor speed [rad/s]": lambda name, p: _list(point.omega_m for point in _points(name, p)),
        "steady flow velocity [m/s]": lambda name, p: _list(point.U_a for point in _points(name, p)),
        "time constants at half voltage [ms]": lambda name, p: _list(1e3 / _poles(p, FULL_VOLTAGE[name] / 2)),
        "stiffness, dt times the fastest pole at full voltage": lambda name, p: (
            f"{DEFAULT_DT * _poles(p, FULL_VOLTAGE[name]).max():.2f}"
        ),
        "sub-steps in 10 ms": lambda name, p: f"{required_substeps(p, DEFAULT_DT, FULL_VOLTAGE[name])}",
        "K_T at the bollard": lambda name, p: _thrust_coefficients(p),
        "default sensor noise over thrust at half voltage": lambda name, p: digits(
            math.sqrt(DEFAULT_MEASUREMENT_NOISE) / _points(name, p)[1].thrust, 2
        ),
        "source": lambda name, p: SOURCES[name],
        "inferred": lambda name, p: INFERRED[name],
    }
    cells = [[label, *(cell(name, p) for name, p in PRESETS.items())] for label, cell in rows.items()]
    return markdown_table(["", *(f"`{name}`" for name in PRESETS)], cells)


def parameters() -> str:
    """The parameters of every preset, with their names in code, symbols and units."""

    def cell(value) -> str:
        return value if isinstance(value, str) else digits(value, 5)

    rows = [
        [f"`{field}`", symbol, *(cell(getattr(p, field)) for p in PRESETS.values())]
        for field, symbol in SYMBOLS.items()
    ]
    return markdown_table(["field", "symbol", *(f"`{name}`" for name in PRESETS)], rows)


def accuracy() -> str:
    """Largest error of one sample time of 10 ms against scipy's DOP853, over each state's range."""
    rows = []
    for name, p in PRESETS.items():
        top = FULL_VOLTAGE[name]
        chosen = required_substeps(p, DEFAULT_DT, top)
        errors = {count: one_step_error(p, top, count) for count in COUNTS}
        cells = {count: _small(error) for count, error in errors.items()}
        cells[chosen] = f"**{cells[chosen]}**"
        rows.append([f"`{name}`", *cells.values()])
    return markdown_table(["preset", *map(str, COUNTS)], rows)


def one_step_error(p: ThrusterParameters, max_voltage: float, substeps: int) -> float:
    """Largest error of one sample time over each state's range, over states, voltages and full reversals."""
    top = np.array(steady_state(p, max_voltage)[:2])
    grid = np.linspace(-1.0, 1.0, 9)
    omega, flow, voltage = (g.ravel() for g in np.meshgrid(*([grid] * 3), indexing="ij"))
    x, u = (omega * top[0], flow * top[1]), (voltage * max_voltage, 0.0)
    c = derive_constants(p)

    def slopes(_, y):
        return np.concatenate(rates(tuple(y.reshape(2, -1)), u, c))

    exact = solve_ivp(slopes, (0, DEFAULT_DT), np.concatenate(x), method="DOP853", rtol=1e-10, atol=1e-13)
    error = np.array(run_substeps(x, u, p, DEFAULT_DT, substeps)) - exact.y[:, -1].reshape(2, -1)
    return float((np.abs(error).max(axis=1) / state_range(p, max_voltage)).max())


def returns() -> str:
    """Mean return of an episode of each task under the classical controllers, with half its 95 % interval."""
    rows = []
    for task in TASKS:
        env = gym.make_vec(task, num_envs=EPISODES)
        with_state = ObserveStateVector(env)
        policies = [
            (env, None),
            (env, PIController.for_env(env, proportional_gain=0.0, integral_gain=0.0)),
            (env, PIController.for_env(env)),
            (with_state, LQRController.for_env(with_state)),
        ]
        rows.append([f"`{task}`", *(_mean_return(*policy) for policy in policies)])
    return markdown_table(["", "0 V", "feed-forward alone", "PI with feed-forward", "LQR on the true state"], rows)


def _mean_return(env, controller) -> str:
    observations, _ = env.reset(seed=FIRST_SEED)
    voltages, state, total = np.zeros((env.num_envs, 1), dtype=np.float32), None, 0.0
    for _ in range(env.spec.max_episode_steps):
        if controller is not None:
            voltages, state = controller.predict(observations, state)
        observations, rewards, *_ = env.step(voltages)
        total = total + rewards
    return f"{total.mean():.3g} ± {1.96 * total.std(ddof=1) / len(total) ** 0.5:.2g}"


def _points(name: str, p: ThrusterParameters, sign: int = 1) -> list:
    return [steady_state(p, sign * share * FULL_VOLTAGE[name]) for share in SHARES]


def _astern(name: str, p: ThrusterParameters) -> str:
    return _list(-point.thrust for point in _points(name, p, -1)) if p.thrust_asymmetry else "the same"


def _poles(p: ThrusterParameters, voltage: float) -> np.ndarray:
    """Magnitudes of the eigenvalues [1/s] at the steady state of a voltage, the fastest first; all are real."""
    a, _, _ = jacobians(p, steady_state(p, voltage)[:2], voltage)
    return np.sort(-np.linalg.eigvals(a).real)[::-1]


def thrust_coefficient(p: ThrusterParameters, voltage: float) -> float:
    """K_T = T/(rho n |n| D^4) in the steady state without ambient flow, n in turns of the propeller a second."""
    omega, _, thrust = steady_state(p, voltage)
    turns = omega / p.gear_ratio / (2 * math.pi)
    return thrust / (p.density * turns * abs(turns) * p.diameter**4)


def _thrust_coefficients(p: ThrusterParameters) -> str:
    ahead, astern = (digits(thrust_coefficient(p, voltage)) for voltage in (1.0, -1.0))
    return f"{ahead}, {astern} astern" if p.thrust_asymmetry else ahead


def _list(values) -> str:
    return ", ".join(digits(value) for value in values)


def _small(error: float) -> str:
    if error < 1e-6:  # the reference is not much better
        return "< 1e-6"
    return f"{error:.1e}".replace("e-0", "e-").replace("e+00", "")


TABLES = {"parameters": parameters, "presets": presets, "accuracy": accuracy, "returns": returns}
