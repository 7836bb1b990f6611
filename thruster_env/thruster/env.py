"""`BowThruster-v0`: voltage in, noisy thrust out, the state hidden."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from thruster_env.core.arguments import arguments_of, takes_arguments_of
from thruster_env.core.checks import finite
from thruster_env.core.memory import KEY_0, KEY_1, TIME
from thruster_env.env.env import PlantEnv
from thruster_env.env.report import ReportRows
from thruster_env.thruster.effects.reference import Constant
from thruster_env.thruster.effects.uncertainty import drawn_parameters
from thruster_env.thruster.engine.copies import Copies
from thruster_env.thruster.engine.memory import (
    AMBIENT,
    FLOW,
    NEXT_REFERENCE,
    OMEGA,
    READINGS,
    REFERENCE,
    THRUST,
    VALID,
)
from thruster_env.thruster.modelled import ModelledThruster
from thruster_env.thruster.parameters import ThrusterParameters
from thruster_env.thruster.plant import Plant, make_plant
from thruster_env.thruster.quantities import INPUTS
from thruster_env.thruster.rendering.env import RenderedThruster
from thruster_env.thruster.task import half_thrust, make_task, thrust_scale


class BowThrusterEnv(ModelledThruster, RenderedThruster, PlantEnv):
    """A ship's bow thruster: hold a thrust by the voltage of the motor, seeing the measured thrust only.

    ## Action space
    | num | action | min | max | unit |
    |---|---|---|---|---|
    | 0 | source voltage V_s, clipped | -max_voltage | max_voltage | V |

    ## Observation space
    | num | observation | min | max | unit |
    |---|---|---|---|---|
    | 0 | measured thrust T + v | -inf | inf | N |

    With other `sensors`, one entry per channel in their order; then, for each channel that may drop out, 1 where
    the measurement is valid and 0 where the last one is repeated.

    ## State (hidden; in `info["state"]`)
    | num | state | unit |
    |---|---|---|
    | 0 | motor speed omega_m | rad/s |
    | 1 | section-average flow velocity U_a | m/s |

    ## Reward
    | term | weight | default |
    |---|---|---|
    | -((T - reference)/T_max)^2 | tracking_weight | 1 |
    | -(V_s/max_voltage)^2 | energy_weight | 0 |
    | -(change of V_s/max_voltage)^2 | voltage_rate_weight | 0.01 |

    T is the true thrust after the step, independent of the sensors; T_max is the steady thrust at max_voltage.

    ## Info
    `state` (2,), `thrust` [N], `measurement` (m,) in float64, `reference` [N] that the reward compares with,
    `ambient_velocity` [m/s] during the step, `time` [s]; with dropout also `measurement_valid` (m,).

    ## Episode
    Starts at N(0, diag(1, 0.01)) unless `initial_state` says otherwise, or `reset(options={"state": [..]})`;
    truncated after 500 steps (5 s); terminated when the state is not finite or 100 times its range away from rest.

    ## Arguments
    The list, with units and defaults, is that of `thruster_env.thruster.plant.make_plant` (the thruster, its
    noise, sensors and disturbances; without `substeps`) and of `thruster_env.thruster.task.make_task` (`reference`
    [N] or signals, by default the steady thrust at half of max_voltage, and the weights above); `render_mode`, and
    `render_size`, (width, height) of pictures in pixels, come on top. All but the first go by name. A wrong value
    raises a ValueError.
    """

    inputs = INPUTS
    observes_reference = False

    @takes_arguments_of(make_plant, make_task, leaving_out=["substeps"])
    def __init__(self, *, render_mode: str | None = None, render_size: Sequence[int] | None = None, **arguments):
        """Build the plant; see the class for the arguments."""
        self._build(make_plant(**arguments_of(make_plant, arguments)), (render_mode, render_size), arguments)

    def _build(self, plant: Plant, rendering: tuple, arguments: dict) -> None:
        self.plant = plant
        of_task = arguments_of(make_task, arguments)
        self.task = make_task(**{**of_task, "reference": self._reference_signals(of_task["reference"])})
        m, top = len(plant.channels), plant.max_voltage
        measurement = slice(READINGS, READINGS + m)
        info: dict[str, int | slice] = {
            "state": slice(OMEGA, FLOW + 1),
            "thrust": THRUST,
            "measurement": measurement,
            "reference": REFERENCE,
            "ambient_velocity": AMBIENT,
            "time": TIME,
        }
        appended = (NEXT_REFERENCE,) if self.observes_reference else ()
        rows = ReportRows(measurement, slice(VALID, VALID + m), plant.dropping_channels, appended, info)
        self._set_up(gym.spaces.Box(-top, top, shape=(1,), dtype=np.float32), rows, *rendering)

    def copies_of(self, count: int) -> Copies:
        """Return `count` thrusters with the env's task."""
        return Copies(self.plant, self.task, count)

    def _reference_signals(self, reference):
        return [Constant(thrust=half_thrust(self.plant) if reference is None else finite("reference", reference))]

    @property
    def thrust_scale(self) -> float:
        """Steady thrust at max_voltage, T_max [N]."""
        return thrust_scale(self.plant)

    @property
    def parameters(self) -> ThrusterParameters:
        """The parameters of this episode, which differ from the plant's where these are uncertain."""
        keys = self._memory[:1, KEY_0 : KEY_1 + 1, 0]
        drawn = drawn_parameters(self.plant.parameters, self.plant.uncertainty, keys)
        values: dict[str, Any] = {name: float(getattr(drawn, name)[0]) for name in self.plant.uncertainty}
        return drawn._replace(**values)
