"""The thruster's scenarios: `Scenario`, a named, seeded and immutable recipe, and the built-in ones.

    python -m tuning.plants.thruster [NAME ...]

recomputes their scales and prints them.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from filters.baselines import OpenLoop
from filters.bounds import has_bound
from filters.engine.batch import run
from filters.tuned_file import NOISE
from thruster_env.core.checks import at_least, positive, short_repr, vector
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.effects.effects import Effect, set_field
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster import plant as plants
from thruster_env.thruster.analysis import equilibrium, jacobians, state_range, steady_state
from thruster_env.thruster.controllers import PIController, lambda_gains
from thruster_env.thruster.effects import REFERENCE_SIGNALS
from thruster_env.thruster.equations import copies_of, simulate
from thruster_env.thruster.linear import make_linear_plant, operating_points
from thruster_env.thruster.model import model_of_plant
from thruster_env.thruster.parameters import CHANNELS, is_file, read_preset
from thruster_env.thruster.plant import DEFAULT_DT, DEFAULT_MAX_VOLTAGE, DEFAULT_PROCESS_NOISE, Plant, Task
from tuning.problems.data import Data
from tuning.problems.excitation import EXCITATIONS, BinarySequence, Dwells, Excitation, MultiSine
from tuning.problems.find import find_in
from tuning.problems.model_problem import average_bound
from tuning.problems.problem import BOUND, OPEN_LOOP
from tuning.problems.scenario import PlantScenario, print_scales

ROUNDING = 1e-6  # of the untuned noise: anything below is rounding
PARTS = (0.5, 1.0)  # of the largest voltage, where stability is checked: at rest the quadratic drag vanishes
LINEAR_NOISE: dict[str, Any] = {"process_noise_cov": (0.5, 0.5), "measurement_noise_cov": 0.5, "steps": 100}


def voltages_of(excitation: Excitation, plant: Plant, keys: np.ndarray, steps: int) -> np.ndarray:
    """Voltages (B, steps) [V] for keys (B, 2), not yet clipped to the plant's range."""
    if isinstance(excitation, ClosedLoop):
        return excitation.voltages(plant, keys, steps)
    return excitation.inputs(keys, steps, plant.dt, 1)[..., 0]


@EXCITATIONS.register("pi")
@dataclass(frozen=True)
class ClosedLoop(Excitation):
    """The voltage of a PI controller that makes the measured thrust follow a reference.

    The loop is that of `BowThrusterTracking-v0` with the same seed and reference under `PIController.for_env`. It
    is closed through the sensor with all its effects, not through a filter: all filters get the same voltages.

    Args:
        low: lowest level of the reference, as a fraction of the steady thrust at max_voltage.
        high: highest level.
        hold_time: time for which a level is held [s].
    """

    low: float = -0.5
    high: float = 0.5
    hold_time: float = 0.5

    def __post_init__(self):
        """Check the arguments."""
        for name, value in self.reference[0].as_mapping().items():
            if name != "name":
                set_field(self, name, value)

    @property
    def reference(self) -> tuple[Effect, ...]:
        """The reference's one signal."""
        levels = {"low": self.low, "high": self.high, "hold_time": self.hold_time}
        return REFERENCE_SIGNALS.make({"name": "steps", **levels})

    def inputs(self, keys: np.ndarray, steps: int, dt: float, count: int) -> np.ndarray:
        """Raise ValueError: the voltages depend on the thruster, see `voltages`."""
        raise ValueError(
            "the excitation 'pi' must be a thruster's, because it is a loop closed through its sensor"
        )

    def voltages(self, plant: Plant, keys: np.ndarray, steps: int) -> np.ndarray:
        """Voltages (B, steps) [V]; ValueError if the plant does not measure its thrust."""
        if "thrust" not in plant.channels:
            raise ValueError(f"a closed loop must measure the thrust, but got {', '.join(plant.channels)}")
        controller = PIController(
            plant, operating_points(plant), *lambda_gains(plant), plant.channels.index("thrust")
        )
        copies = copies_of(plant, Task(self.reference), len(keys))
        out, state, report = np.empty((len(keys), steps)), None, copies.begin(keys)
        measured, following = (copies.report_rows[name] for name in ("measurement", "next_reference"))
        for k in range(steps):
            # float32, as an env's observation.
            observation = np.concatenate([report[measured], report[[following]]]).T.astype(np.float32)
            action, state = controller.predict(observation, state)
            out[:, k] = action[:, 0]
            report = copies.step(out[:, k])
        return out


def preset_mapping(path: str | Path) -> dict[str, Any]:
    """The thruster in a preset file, as a mapping that `make_plant` takes as its preset."""
    read = read_preset(path)
    band = {} if read.dead_band == (0.0, 0.0) else {"dead_band": list(read.dead_band)}
    return {**read.parameters._asdict(), **band}


@dataclass(frozen=True, kw_only=True)
class Scenario(PlantScenario):
    """A plant, an excitation and what a filter assumes of the plant.

    A filter's model is the plant's, except for `parameter_factors`; it knows the distribution of the initial state
    and a constant `ambient_velocity`. It does not know sensor effects, `flow`, `amplifier` and `uncertainty`.

    Attributes, beside those of `PlantScenario`:
        measurement_noise_cov: the plant's R, the variance on the sensor's data sheet [N^2, or the channel's
            unit^2]; one for each of several channels.
        process_noise_cov: the plant's Q, two variances per step [(rad/s)^2, (m/s)^2]; they do not scale with `dt`.
        scale: bound on the standard error of each state, (omega_m [rad/s], U_a [m/s]), of the scenario's Gaussian
            core: fixed numbers, by which errors are divided, from `computed_scale`.
        system: a published linear system that is the plant, "tunnel" or "open_bladed"; None for the equations.
        preset: the thruster, as for `thruster_env.thruster.plant.make_plant`; so are all that follow. The content
            of a file is stored in place of its path.
        dt: sample time [s].
        max_voltage: voltages are clipped to plus and minus this [V].
        ambient_velocity: constant flow U_0 [m/s].
        initial_state: None, two numbers, or a mapping.
        sensors: channels, a list of their names or a mapping from each to a list of effects.
        flow: list of signals.
        amplifier: list of effects.
        uncertainty: distributions of factors on parameters, drawn for each seed.
    """

    plant_kind = "thruster"
    of_plant: ClassVar[Any] = plants
    scale_sequences = 1200
    model_of_plant = staticmethod(model_of_plant)
    process_noise_cov: tuple[float, float] = DEFAULT_PROCESS_NOISE
    measurement_noise_cov: float | Sequence[float] = CHANNELS["thrust"].variance
    scale: tuple[float, float]
    system: str | None = None
    preset: str | Mapping = "tunnel"
    dt: float = DEFAULT_DT
    max_voltage: float = DEFAULT_MAX_VOLTAGE
    ambient_velocity: float = 0.0
    initial_state: Sequence | Mapping | None = None
    sensors: Sequence | Mapping = ("thrust",)
    flow: Sequence = ()
    amplifier: Sequence = ()
    uncertainty: Mapping = field(default_factory=dict)

    __hash__ = PlantScenario.__hash__

    def own_checks(self) -> dict:
        """Sensors, variances and scale of the thruster's two states."""
        if isinstance(self.sensors, str) or not isinstance(self.sensors, Collection) or not self.sensors:
            raise ValueError(
                f"sensors of a scenario must be one channel or several, but got {short_repr(self.sensors)}"
            )
        preset = self.preset
        return {
            "preset": preset if isinstance(preset, Mapping) or not is_file(preset) else preset_mapping(preset),
            "scale": self.checked_scale(2),
            "process_noise_cov": vector("process_noise_cov", self.process_noise_cov, 2).tolist(),
            "measurement_noise_cov": _variances(self.measurement_noise_cov, len(self.sensors)),
        }

    @property
    def env_id(self) -> str:
        """`BowThruster-v0`, or `BowThrusterLinear-v0` of a linear plant."""
        return "thruster_env:BowThruster-v0" if self.system is None else "thruster_env:BowThrusterLinear-v0"

    @property
    def not_of_env(self) -> tuple[str, ...]:
        """Fields that only the other plant's env takes."""
        return ("system",) if self.system is None else ("preset", "uncertainty")

    @cached_property
    def plant(self) -> Plant:
        """The true plant."""
        return super().plant if self.system is None else make_linear_plant(**self.plant_arguments)

    def model(self, **changes) -> StateSpaceModel:
        """What the filter assumes; changes are arguments of `thruster_env.thruster.model.model_of_plant`."""
        if not self._are_noise(changes):
            return super().model(**changes)
        return self._assumed.replace(**{name: cov for name, cov in changes.items() if cov is not None})

    def _are_noise(self, changes: Mapping) -> bool:
        """Whether changes are Q and R as a study chooses them, on which no function of the model depends."""
        r, channels = changes.get("measurement_noise_cov"), len(self.plant.channels)
        fits = (
            channels == 1 if isinstance(r, float) else r is None or (isinstance(r, tuple) and len(r) == channels)
        )
        return fits and changes.keys() <= set(NOISE)

    @cached_property
    def _assumed(self) -> StateSpaceModel:
        """The model without changes; a trial changes its covariances."""
        return super().model()

    @property
    def state_ranges(self) -> np.ndarray:
        """Range (2,) of the steady states over the voltage range."""
        if self.plant.linear is None:
            return state_range(self.plant.parameters, self.plant.max_voltage)
        ends = (equilibrium(self.plant.linear, (sign * self.plant.max_voltage, 0.0)) for sign in (1.0, -1.0))
        return np.abs(np.subtract(*ends))[:2]

    @property
    def has_bound(self) -> bool:
        """Whether there is a posterior Cramér-Rao bound: its recursion needs the inverse of Q."""
        return has_bound(self.plant.process_noise_cov)

    @property
    def computed_scale_about(self) -> str:
        """A description of the scale where it is computed."""
        return BOUND if self.has_bound else f"{OPEN_LOOP}, for the true Q is singular"

    def bound(self, data: Data, truths: int = 100) -> np.ndarray:
        """Bound on the standard error of each state (2,), averaged over the data's inputs and scored steps.

        It is that of the scenario's Gaussian core: the nominal plant with the same Q, R and inputs, with no
        sensor effects, flow signals or amplifier. NaN where there is none.
        """
        if not self.has_bound:
            return np.full(2, np.nan)
        return average_bound(model_of_plant(self.plant), data, truths)

    def computed_scale(self, sequences: int, truths: int = 100) -> np.ndarray:
        """The scale (2,), over voltage sequences of the seeds 0, 1, 2, ...; this one's own is not used.

        It is `bound`, and a score is then RMSE over the bound. Where there is no bound, because Q is singular, it
        is the RMSE of the open loop: a score below 1 then shows what the measurements contribute.

        Args:
            sequences: number of seeds.
            truths: number of true paths drawn for each seed, for the bound.

        Raises:
            ValueError: if there is neither a bound nor a stable open loop, or the scale is zero or not finite.
        """
        data = self.data(range(at_least("sequences", sequences, 1)))
        if self.has_bound:
            what, scale = "the bound", self.bound(data, truths)
        elif is_stable(self.plant):
            open_loop = OpenLoop(model=model_of_plant(self.plant))
            estimates = run(open_loop, data.filter_keys, data.inputs, data.measurements)
            errors = (estimates.means - data.states)[:, data.late]
            what, scale = "the RMSE of the open loop", np.sqrt((errors**2).mean(axis=(0, 1)))
        else:
            raise ValueError(
                "a scenario needs a bound or a stable open loop as the scale of errors, but Q is singular, "
                f"{list(self.process_noise_cov)}, and the open loop is unstable"
            )
        rounding = ROUNDING * np.sqrt(self.untuned["process_noise_cov"])
        if not (np.isfinite(scale).all() and (scale > rounding).all()):
            raise ValueError(f"scale must be positive in every state, but {what} is {scale.tolist()}")
        return scale

    def make(self, seeds: tuple[int, ...]) -> Data:
        """Truth and measurements under the excitation's voltages."""
        keys, plant = episode_keys(seeds), self.plant
        voltages = voltages_of(self.excitation, plant, keys, self.steps)
        voltages = np.clip(voltages, -plant.max_voltage, plant.max_voltage)  # as the env does
        simulation = simulate(plant, keys, voltages).checked(f"the plant of scenario {self.name}")
        measurements = np.where(simulation.valid, simulation.measurements, np.nan)  # NaN: missing
        return Data(
            seeds,
            voltages[..., None],
            measurements,
            filter_keys(seeds),
            self.first_scored_step,
            simulation.states,
            {"T": simulation.thrusts},
        )


def _variances(variances, channels: int) -> float | tuple[float, ...]:
    """R as a scenario stores it: the variance of one channel, or one variance for each of several."""
    if channels == 1 and not isinstance(variances, list | tuple | np.ndarray):
        return positive("measurement_noise_cov", variances)
    each = tuple(
        positive("measurement_noise_cov", v) for v in vector("measurement_noise_cov", variances, channels)
    )
    return each[0] if channels == 1 else each


def is_stable(plant: Plant) -> bool:
    """Whether the plant without feedback is stable: all modes decay, ahead and astern."""
    if plant.linear is not None:
        matrices = [plant.linear.a]
    else:
        voltages = (sign * part * plant.max_voltage for sign in (1.0, -1.0) for part in PARTS)
        flow = plant.ambient_velocity
        matrices = [
            jacobians(plant.parameters, steady_state(plant.parameters, v, flow)[:2], v, flow)[0] for v in voltages
        ]
    return all(np.linalg.eigvals(a).real.max() < 0.0 for a in matrices)


# Bounds from 1200 voltage sequences and 100 truths each, accurate to half a per cent; a test recomputes them.
NOMINAL_SCALE = (1.0753, 0.0464)

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            name="nominal",
            about="a perfect model and small noise: every good filter sits on the bound",
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="published_noise",
            about="the noise of the published experiments on the nonlinear plant: filters differ",
            process_noise_cov=(0.5, 0.5),
            measurement_noise_cov=0.5,
            scale=(0.8069, 0.0720),
        ),
        Scenario(
            name="mismatch",
            about="the filter assumes 15 % more lift and 5 % less voltage gain K2 than the plant has",
            parameter_factors={"lift_coefficient": 1.15, "voltage_gain": 0.95},
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="ambient",
            about="a slowly changing ambient flow of about 0.5 m/s, unknown to the filter",
            flow=[{"name": "gauss-markov", "std": 0.5, "time_constant": 10.0}],
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="outliers",
            about="one measured thrust in twenty has an error of about 10 N",
            sensors={"thrust": [{"name": "outliers", "std": 10.0, "probability": 0.05}]},
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="dropout",
            about="half of the measurements are missing, in gaps of 0.2 s on average",
            sensors={"thrust": [{"name": "dropout", "probability": 0.5, "mean_length": 20}]},
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="bias",
            about="the sensor has a bias of about 1.5 N that drifts, while the voltage jumps between two levels",
            sensors={"thrust": [{"name": "bias", "std": 1.5, "drift": 0.03}]},
            excitation=BinarySequence(amplitude=8.0, hold=40),
            scale=(1.0424, 0.0384),
        ),
        Scenario(
            name="quantised",
            about="the sensor reads multiples of 4 N, under a sum of sines",
            sensors={"thrust": [{"name": "quantisation", "step": 4.0}]},
            excitation=MultiSine(),
            scale=(1.1042, 0.0512),
        ),
        Scenario(
            name="deadband",
            about="the amplifier has a dead band of 1 V, unknown to the filter, under a sum of sines",
            amplifier=[{"name": "dead-band", "width": 1.0}],
            excitation=MultiSine(),
            scale=(1.1042, 0.0512),
        ),
        Scenario(
            name="reversal",
            about="slow crossings of 0 V and dwells there, where the flow is not observable from thrust",
            excitation=Dwells(amplitude=4.0),
            scale=(1.1452, 0.0806),
        ),
        Scenario(
            name="speed_magnitude",
            about="a tachometer without a sign, at slow crossings of 0 V and dwells there",
            measurement_noise_cov=0.25,
            sensors=["speed-magnitude"],
            excitation=Dwells(amplitude=1.0),
            scale=(0.4493, 0.1365),
        ),
        Scenario(
            name="startup",
            about="the thruster may already turn, in either direction, when a run starts; every step counts",
            first_scored_step=0,
            initial_state={"mean": [0.0, 0.0], "cov": [[100.0**2, 0.0], [0.0, 2.0**2]]},
            scale=(1.0917, 0.0456),
        ),
        Scenario(
            name="published_tunnel",
            about="the linear tunnel thruster as published: the Kalman filter is optimal",
            system="tunnel",
            **LINEAR_NOISE,
            scale=(0.8066, 0.1457),
        ),
        Scenario(
            name="published_open_bladed",
            about="the linear open-bladed thruster as published, unstable, measured by its own C",
            system="open_bladed",
            **LINEAR_NOISE,
            scale=(4.8663, 2.1588),
        ),
        *(
            Scenario(
                name=name,
                about=f"strong process noise, and a thrust sensor with {about}: for policies on what it shows",
                process_noise_cov=(4.0, 0.01),
                measurement_noise_cov=variance,
                scale=scale,
            )
            for name, about, variance, scale in (
                ("low_noise", "0.5 N of noise", 0.25, (2.1173, 0.1068)),
                ("medium_noise", "2 N of noise", 4.0, (2.2619, 0.1846)),
                ("high_noise", "4 N of noise", 16.0, (2.2885, 0.2292)),
            )
        ),
        Scenario(
            name="mixed",
            about="outliers, dropout, gusts, a dead band and a wrong model, in a closed loop with PI",
            parameter_factors={"lift_coefficient": 1.1},
            sensors={
                "thrust": [
                    {"name": "outliers", "std": 10.0, "probability": 0.02},
                    {"name": "dropout", "probability": 0.1, "mean_length": 5},
                ]
            },
            flow=[{"name": "gusts", "std": 0.5, "rate": 0.5, "duration": 1.0}],
            amplifier=[{"name": "dead-band", "width": 0.5}],
            excitation=ClosedLoop(),
            scale=(1.0179, 0.0362),
        ),
    )
}


# The thruster's scenarios by name or file, for `tuning.problems.find`.
NOMINAL = "nominal"


def find_scenario(name: str) -> Scenario:
    """A scenario by its name, or from a file that ends in .toml; ValueError for another."""
    return find_in(SCENARIOS, Scenario, name)


if __name__ == "__main__":
    print_scales(SCENARIOS, sys.argv[1:])
