"""The pictures of docs/plant.md and its tables of numbers."""

from __future__ import annotations

import math
from pathlib import Path

import gymnasium as gym
import numpy as np
from scipy.integrate import solve_ivp

from docs.scripts import by_name, digits, label_grid, returns_of, save_frame, subplots
from thruster_env.core.files import BLUE, DARK, RUST, SKY, legend_below, save_figure
from thruster_env.core.streams import episode_keys
from thruster_env.core.text_tables import markdown_table
from thruster_env.env.env import ObserveStateVector
from thruster_env.thruster.analysis import jacobians, required_substeps, run_substeps, state_range, steady_state
from thruster_env.thruster.controllers import LQRController, PIController
from thruster_env.thruster.dynamics import rates
from thruster_env.thruster.effects import AMPLIFIER_EFFECTS, FLOW_SIGNALS, REFERENCE_SIGNALS
from thruster_env.thruster.equations import copies_of, simulate
from thruster_env.thruster.parameters import PRESETS, ThrusterParameters, derive_constants
from thruster_env.thruster.plant import (
    DEFAULT_DT,
    DEFAULT_MAX_VOLTAGE,
    DEFAULT_MEASUREMENT_NOISE,
    Plant,
    Task,
    make_plant,
)

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
    "t200": "Blue Robotics' bollard table of 2019; `tuning/plants/bollard.py`",
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
    total = returns_of(env, controller, (0.0,), FIRST_SEED)
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


# Presets are told apart by colour and by dashes; open_bladed hardly turns and is left out of the pictures.
STYLES = {
    "tunnel": (BLUE, "-"),
    "tunnel_physical": (SKY, "--"),
    "open_bladed_corrected": (RUST, "-."),
    "t200": (DARK, (0, (1, 1))),
}
QUIET = {"process_noise_cov": [0.0, 0.0], "initial_state": [0.0, 0.0]}
SEED = 1


def responses(path: Path) -> Path:
    """A step from rest to half voltage and the reversal from there, over the steady values."""
    dt, steps = 1e-3, 400
    figure, axes = subplots((9.6, 6.0), 3, 2, sharex=True, sharey="row", height_ratios=(2, 2, 3))
    for name, (colour, dashes) in STYLES.items():
        top = FULL_VOLTAGE[name]
        plant = make_plant(name, dt=dt, max_voltage=top, measurement_noise_cov=0.0, **QUIET)
        settled = plant._replace(initial_mean=np.array(steady_state(plant.parameters, top / 2)[:2]))
        scale = steady_state(plant.parameters, top / 2)
        for column, start, voltage in ((0, plant, top / 2), (1, settled, -top / 2)):
            run = simulate(start, episode_keys([SEED]), np.full((1, steps), voltage))
            rows = (*run.states[0].T, run.thrusts[0])
            for axis, values, unit in zip(axes[:, column], rows, scale, strict=True):
                time = 1e3 * dt * np.arange(steps + 1)
                axis.plot(time, values / unit, color=colour, linestyle=dashes, linewidth=1.6, label=name)
    for axis, label in zip(axes[:, 0], ("motor speed", "flow velocity", "thrust"), strict=True):
        axis.set_ylabel(f"{label} over\nsteady value [-]")
    axes[0, 0].set_title("rest to half voltage", fontsize=10)
    axes[0, 1].set_title("half voltage ahead to half voltage astern", fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("time [ms]")
    figure.align_ylabels(axes[:, 0])
    legend_below(figure, axes[0, :1])
    return save_figure(figure, path)


def steady_states(path: Path) -> Path:
    """Steady thrust and speed over the voltage, and the thrust coefficient at the bollard."""
    figure, axes = subplots((9.6, 3.6), 1, 3)
    for number, (name, (colour, dashes)) in enumerate(STYLES.items()):
        p = PRESETS[name]
        voltages = np.linspace(-1, 1, 81) * FULL_VOLTAGE[name]
        points = np.array([steady_state(p, voltage) for voltage in voltages])
        look = {"color": colour, "linestyle": dashes, "linewidth": 1.6}
        axes[0].plot(voltages, points[:, 2], label=name, **look)
        axes[1].plot(voltages, points[:, 0], **look)
        for shift, fill, voltage in ((-0.12, colour, 1.0), (0.12, "white", -1.0)):
            look = {"color": colour, "markerfacecolor": fill, "markersize": 7}
            axes[2].plot(number + shift, thrust_coefficient(p, voltage), "o", **look)
    axes[2].axhspan(0.18, 0.46, color=DARK, alpha=0.12, linewidth=0, label="measured small thrusters")
    axes[2].plot([], [], "o", color=DARK, label="ahead")
    axes[2].plot([], [], "o", color=DARK, markerfacecolor="white", label="astern")
    for axis, label in zip(axes, ("steady thrust [N]", "steady motor speed [rad/s]"), strict=False):
        axis.set(xlabel="voltage [V]", ylabel=label)
    axes[2].set_yscale("log")
    axes[2].minorticks_off()
    axes[2].set_yticks([0.1, 0.2, 0.5, 1, 2], ["0.1", "0.2", "0.5", "1", "2"])
    axes[2].set(xlim=(-0.5, len(STYLES) - 0.5), ylim=(0.1, 8), ylabel="thrust coefficient $K_T$ [-]")
    axes[2].set_xticks(range(len(STYLES)), [name.replace("_", "\n") for name in STYLES], fontsize=8)
    axes[2].grid(axis="x", visible=False)
    axes[2].legend(fontsize=8, frameon=False, loc="upper left")
    legend_below(figure, axes[:1])
    return save_figure(figure, path)


def sensor_effects(path: Path) -> Path:
    """What each sensor effect does to one and the same run."""
    examples = {
        "Gaussian noise only": [],
        "student-t, scale 0.5": [{"name": "student-t", "scale": 0.5}],
        "outliers, std 5, probability 0.1": [{"name": "outliers", "std": 5.0, "probability": 0.1}],
        "bias, std 2, drift 0.2": [{"name": "bias", "std": 2.0, "drift": 0.2}],
        "quantisation, step 3": [{"name": "quantisation", "step": 3.0}],
        "saturation, $-$5 ... 10": [{"name": "saturation", "low": -5.0, "high": 10.0}],
        "dropout, 0.3, mean length 6": [{"name": "dropout", "probability": 0.3, "mean_length": 6.0}],
        "delay, 10 steps": [{"name": "delay", "steps": 10}],
    }
    voltages = 12.0 * np.cos(2 * math.pi * np.arange(150) / 150)
    figure, axes = subplots((9.6, 4.6), 2, 4, sharex=True, sharey=True)
    for axis, (title, effects) in zip(axes.flat, examples.items(), strict=True):
        record = run(make_plant(sensors={"thrust": effects}, initial_state={"voltage": 12.0}), voltages)
        valid, readings = record["valid"][:, 0] > 0, record["measurement"][:, 0]
        time = 0.01 * np.arange(len(valid))
        axis.plot(time, record["thrust"], color=DARK, linewidth=1.2, label="thrust")
        axis.plot(time[valid], readings[valid], ".", color=BLUE, markersize=3.5, label="measurement")
        missing = ~valid
        axis.plot(time[missing], readings[missing], "x", color=RUST, markersize=3.5, label="missing")
        axis.set_title(title, fontsize=9)
    label_grid(axes, "time [s]", "thrust [N]")
    legend_below(figure, axes[0, :1])
    return save_figure(figure, path)


def flow_signals(path: Path) -> Path:
    """Flow signals, and the thrust at a constant voltage in each."""
    examples = {
        "sinusoid": {"name": "sinusoid", "amplitude": 1.0, "period": 2.0},
        "gauss-markov": {"name": "gauss-markov", "std": 0.7, "time_constant": 0.5},
        "gusts": {"name": "gusts", "std": 1.0, "rate": 1.0, "duration": 0.8},
        "recorded": {"name": "recorded", "values": [0.0, 1.2, 0.4, -0.9, 0.0], "sample_time": 1.0},
    }
    plain = make_plant(process_noise_cov=[0.0, 0.0], initial_state={"voltage": 12.0})
    plants = {title: plain._replace(flow=FLOW_SIGNALS.make(signal)) for title, signal in examples.items()}
    return _signals(path, plants, plain, np.full(500, 12.0), ("ambient_velocity", "flow $U_0$ [m/s]"))


def amplifier_effects(path: Path) -> Path:
    """What the amplifier makes of a commanded voltage, and the thrust beside that of a perfect amplifier."""
    time = 0.01 * np.arange(200)
    examples = {
        "dead-band, width 3": {"name": "dead-band", "width": 3.0},
        "slew-limit, rate 60": {"name": "slew-limit", "rate": 60.0},
        "saturation, limit 8": {"name": "saturation", "limit": 8.0},
        "sag, fraction 0.3": {"name": "sag", "fraction": 0.3},
    }
    voltages = np.where(time < 1.0, 12.0 * np.sin(2 * math.pi * time), np.where(time < 1.5, 12.0, -12.0))
    plain = make_plant("t200", max_voltage=FULL_VOLTAGE["t200"], **QUIET)
    make = AMPLIFIER_EFFECTS.make
    plants = {title: plain._replace(amplifier=make(effect)) for title, effect in examples.items()}
    return _signals(path, plants, plain, voltages, ("voltage", "voltage [V]"))


def references(path: Path) -> Path:
    """The reference generators, with their defaults where they have any, and a sum of two."""
    arguments = {
        "constant": {"level": 0.5},
        "prbs": {"hold_time": 0.25},
        "recorded": {"values": [0, 30, 30, 10, 40, 5], "sample_time": 1.0},
    }
    examples = {name: [{"name": name, **arguments.get(name, {})}] for name in REFERENCE_SIGNALS.effects}
    examples["ramps + multi-sine"] = [
        {"name": "ramps"},
        {"name": "multi-sine", "offset": 0.0, "amplitude": 0.03, "periods": [0.3, 0.2]},
    ]
    plant = make_plant()
    figure, axes = subplots((9.6, 4.4), 2, 4, sharex=True, sharey=True)
    for axis, (title, signals) in zip(axes.flat, examples.items(), strict=True):
        record = run(plant, np.zeros(500), Task(REFERENCE_SIGNALS.make(signals)), seed=6)
        axis.step(0.01 * np.arange(501), record["reference"], where="post", color=BLUE, linewidth=1.4)
        axis.set_title(title, fontsize=9)
    axes[0, 0].set_ylim(0, 50)
    label_grid(axes, "time [s]", "reference thrust [N]")
    return save_figure(figure, path)


def frame(path: Path) -> Path:
    """A frame of the reversal task; the voltage is the one that would hold the reference in the steady state."""
    env = gym.make("BowThrusterReversal-v0", render_mode="rgb_array", ambient_velocity=0.5)
    top, full = env.unwrapped.plant.max_voltage, env.unwrapped.thrust_scale
    observation, _ = env.reset(seed=SEED)
    for _ in range(400):
        share = observation[1] / full  # the thrust grows nearly with the square of the voltage
        observation, *_ = env.step(np.array([top * math.copysign(abs(share) ** 0.5, share)], dtype=np.float32))
    return save_frame(env, path)


def run(plant: Plant, voltages: np.ndarray, task: Task | None = None, seed: int = SEED) -> dict[str, np.ndarray]:
    """The report of one copy under voltages (K,) by name, (K + 1,) or (K + 1, entries)."""
    copies = copies_of(plant, task or Task(), 1)
    reports = [copies.begin(episode_keys([seed]))[:, 0]]
    reports += [copies.step(np.array([voltage]))[:, 0] for voltage in voltages]
    return {name: np.array(reports)[:, rows] for name, rows in copies.report_rows.items()}


def _signals(path: Path, plants: dict[str, Plant], plain: Plant, voltages, first_row: tuple[str, str]) -> Path:
    """One column a plant: the row `first_row` above, the thrust below, each beside that of the plain plant."""
    figure, axes = subplots((9.6, 4.6), 2, 4, sharex=True, sharey="row")
    row, label = first_row
    time = 0.01 * np.arange(1, len(voltages) + 1)
    undisturbed = run(plain, voltages)
    for column, (title, plant) in zip(axes.T, plants.items(), strict=True):
        record = run(plant, voltages)
        for axis, values in zip(column, (row, "thrust"), strict=True):
            axis.plot(time, record[values][1:], color=BLUE, linewidth=1.4, label="with the effect")
            axis.plot(time, undisturbed[values][1:], color=DARK, linewidth=1.0, linestyle="--", label="without")
        column[0].set_title(title, fontsize=9)
        column[1].set_xlabel("time [s]")
    axes[0, 0].set_ylabel(label)
    axes[1, 0].set_ylabel("thrust [N]")
    figure.align_ylabels(axes[:, 0])
    legend_below(figure, axes[0, :1])
    return save_figure(figure, path)


FIGURES = {
    **{"plant_responses.png": responses, "plant_steady.png": steady_states, "plant_sensors.png": sensor_effects},
    **{"plant_flow.png": flow_signals, "plant_amplifier.png": amplifier_effects},
    **{"plant_references.png": references, "plant_frame.png": frame},
}
TABLES = by_name(parameters, presets, accuracy, returns)
