"""Voltages of the thruster's scenarios: any excitation of one input, and the closed loop that only it has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thruster_env.effects.effects import Effect, set_field
from thruster_env.thruster.control.controllers import PIController, lambda_gains
from thruster_env.thruster.effects.reference import REFERENCE_SIGNALS
from thruster_env.thruster.engine.copies import Copies
from thruster_env.thruster.engine.memory import NEXT_REFERENCE, READINGS
from thruster_env.thruster.linear.operating import operating_points
from thruster_env.thruster.plant import Plant
from thruster_env.thruster.task import Task
from tuning.problems.excitation import EXCITATIONS, Excitation


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
        copies = Copies(plant, Task(self.reference), len(keys))
        out, state, report = np.empty((len(keys), steps)), None, copies.begin(keys)
        measured = slice(READINGS, READINGS + len(plant.channels))
        for k in range(steps):
            # float32, as an env's observation.
            observation = np.concatenate([report[measured], report[[NEXT_REFERENCE]]]).T.astype(np.float32)
            action, state = controller.predict(observation, state)
            out[:, k] = action[:, 0]
            report = copies.step(out[:, k])
        return out
