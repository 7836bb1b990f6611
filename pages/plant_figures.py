"""Make the pictures of docs/plant.md and its computed tables.

    python -m pages.plant_figures [FOLDER]

The pictures go into FOLDER, docs/ by default. If there is a plant.md in it, its tables between the comments
`<!-- table NAME -->` and `<!-- end -->` are written anew. Every run gives the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np

from pages.page import label_grid, legend_below, make_page
from pages.plant_tables import FULL_VOLTAGE, TABLES, thrust_coefficient
from thruster_env.core.files import write_whole
from thruster_env.core.plots import BLUE, DARK, RUST, SKY, new_figure, save_figure, tidy
from thruster_env.core.streams import episode_keys
from thruster_env.thruster.effects.amplifier import AMPLIFIER_EFFECTS, FLOW_SIGNALS
from thruster_env.thruster.effects.reference import REFERENCE_SIGNALS
from thruster_env.thruster.engine.copies import Copies, simulate
from thruster_env.thruster.engine.memory import AMBIENT, FIXED_ROWS, READINGS, REFERENCE, THRUST, VALID, VOLTAGE
from thruster_env.thruster.linear.analysis import steady_state
from thruster_env.thruster.parameters import PRESETS
from thruster_env.thruster.plant import Plant, make_plant
from thruster_env.thruster.task import Task

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
    figure = new_figure((9.6, 6.0))
    axes = figure.subplots(3, 2, sharex=True, sharey="row", height_ratios=(2, 2, 3))
    tidy(axes.flat)
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
    legend_below(figure, axes[0, 0])
    return save_figure(figure, path)


def steady_states(path: Path) -> Path:
    """Steady thrust and speed over the voltage, and the thrust coefficient at the bollard."""
    figure = new_figure((9.6, 3.6))
    axes = figure.subplots(1, 3)
    tidy(axes)
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
        axis.set_xlabel("voltage [V]")
        axis.set_ylabel(label)
    axes[2].set_yscale("log")
    axes[2].minorticks_off()
    axes[2].set_yticks([0.1, 0.2, 0.5, 1, 2], ["0.1", "0.2", "0.5", "1", "2"])
    axes[2].set_xlim(-0.5, len(STYLES) - 0.5)
    axes[2].set_ylim(0.1, 8)
    axes[2].set_ylabel("thrust coefficient $K_T$ [-]")
    axes[2].set_xticks(range(len(STYLES)), [name.replace("_", "\n") for name in STYLES], fontsize=8)
    axes[2].grid(axis="x", visible=False)
    axes[2].legend(fontsize=8, frameon=False, loc="upper left")
    legend_below(figure, axes[0])
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
    figure = new_figure((9.6, 4.6))
    axes = figure.subplots(2, 4, sharex=True, sharey=True)
    tidy(axes.flat)
    for axis, (title, effects) in zip(axes.flat, examples.items(), strict=True):
        record = run(make_plant(sensors={"thrust": effects}, initial_state={"voltage": 12.0}), voltages)
        valid, time = record[:, VALID] > 0, 0.01 * np.arange(len(record))
        axis.plot(time, record[:, THRUST], color=DARK, linewidth=1.2, label="thrust")
        axis.plot(time[valid], record[valid, READINGS], ".", color=BLUE, markersize=3.5, label="measurement")
        missing = ~valid
        axis.plot(time[missing], record[missing, READINGS], "x", color=RUST, markersize=3.5, label="missing")
        axis.set_title(title, fontsize=9)
    label_grid(axes, "time [s]", "thrust [N]")
    legend_below(figure, axes[0, 0])
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
    return _signals(path, plants, plain, np.full(500, 12.0), (AMBIENT, "flow $U_0$ [m/s]"))


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
    plants = {
        title: plain._replace(amplifier=AMPLIFIER_EFFECTS.make(effect)) for title, effect in examples.items()
    }
    return _signals(path, plants, plain, voltages, (VOLTAGE, "voltage [V]"))


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
    figure = new_figure((9.6, 4.4))
    axes = figure.subplots(2, 4, sharex=True, sharey=True)
    tidy(axes.flat)
    for axis, (title, signals) in zip(axes.flat, examples.items(), strict=True):
        record = run(plant, np.zeros(500), Task(REFERENCE_SIGNALS.make(signals)), seed=6)
        axis.step(0.01 * np.arange(501), record[:, REFERENCE], where="post", color=BLUE, linewidth=1.4)
        axis.set_title(title, fontsize=9)
    axes[0, 0].set_ylim(0, 50)
    label_grid(axes, "time [s]", "reference thrust [N]")
    return save_figure(figure, path)


def frame(path: Path) -> Path:
    """A frame of the reversal task; the voltage is the one that would hold the reference in the steady state."""
    from matplotlib.image import imsave

    env = gym.make("BowThrusterReversal-v0", render_mode="rgb_array", ambient_velocity=0.5)
    top, full = env.unwrapped.plant.max_voltage, env.unwrapped.thrust_scale
    observation, _ = env.reset(seed=SEED)
    for _ in range(400):
        share = observation[1] / full  # the thrust grows nearly with the square of the voltage
        observation, *_ = env.step(np.array([top * math.copysign(abs(share) ** 0.5, share)], dtype=np.float32))
    picture = env.render()
    env.close()
    write_whole(path, lambda stream: imsave(stream, picture, format="png"))
    return path


def run(plant: Plant, voltages: np.ndarray, task: Task | None = None, seed: int = SEED) -> np.ndarray:
    """Record (K + 1, rows) of one copy under voltages (K,); `engine.memory` names the rows."""
    copies = Copies(plant, task or Task(), 1)
    copies.begin(episode_keys([seed]))
    record = [copies.memory[0, :FIXED_ROWS, 0].copy()]
    for voltage in voltages:
        copies.step(np.array([voltage]))
        record.append(copies.memory[0, :FIXED_ROWS, 0].copy())
    return np.array(record)


def _signals(path: Path, plants: dict[str, Plant], plain: Plant, voltages, first_row: tuple[int, str]) -> Path:
    """One column a plant: the row `first_row` above, the thrust below, each beside that of the plain plant."""
    figure = new_figure((9.6, 4.6))
    axes = figure.subplots(2, 4, sharex=True, sharey="row")
    tidy(axes.flat)
    row, label = first_row
    time = 0.01 * np.arange(1, len(voltages) + 1)
    undisturbed = run(plain, voltages)[1:]
    for column, (title, plant) in zip(axes.T, plants.items(), strict=True):
        record = run(plant, voltages)[1:]
        for axis, values in zip(column, (row, THRUST), strict=True):
            axis.plot(time, record[:, values], color=BLUE, linewidth=1.4, label="with the effect")
            axis.plot(time, undisturbed[:, values], color=DARK, linewidth=1.0, linestyle="--", label="without")
        column[0].set_title(title, fontsize=9)
        column[1].set_xlabel("time [s]")
    axes[0, 0].set_ylabel(label)
    axes[1, 0].set_ylabel("thrust [N]")
    figure.align_ylabels(axes[:, 0])
    legend_below(figure, axes[0, 0])
    return save_figure(figure, path)


FIGURES = {
    "plant_responses.png": responses,
    "plant_steady.png": steady_states,
    "plant_sensors.png": sensor_effects,
    "plant_flow.png": flow_signals,
    "plant_amplifier.png": amplifier_effects,
    "plant_references.png": references,
    "plant_frame.png": frame,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("plant", "pages.plant_figures", FIGURES, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
