"""`BowThruster-v0` and its tasks, as single and vector envs: voltage in, noisy thrust out, the state hidden."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import arguments_of, finite, takes_arguments_of
from thruster_env.env.copies import KEY_0, KEY_1, TIME
from thruster_env.env.env import PlantEnv, PlantVectorEnv
from thruster_env.env.model_env import ModelledEnv
from thruster_env.graphs.draws import Draws
from thruster_env.render.renderer import MODES
from thruster_env.thruster.analysis import equilibrium, state_range, steady_state
from thruster_env.thruster.dynamics import Constants, thrust_and_torque
from thruster_env.thruster.effects import Constant, drawn_parameters
from thruster_env.thruster.equations import page_of
from thruster_env.thruster.linear import PUBLISHED_NOISE, make_linear_plant
from thruster_env.thruster.model import observe_jacobian
from thruster_env.thruster.parameters import INPUTS, ThrusterParameters
from thruster_env.thruster.plant import Plant, make_plant, make_task, thrust_scale
from thruster_env.thruster.rendering import ChartEntry, Overlay, Renderer

if TYPE_CHECKING:
    from thruster_env.model.state_space import StateSpaceModel


def overlay_of(label: str, model: StateSpaceModel, mean: np.ndarray, cov: np.ndarray) -> Overlay:
    """Overlay of a belief on a rendered thruster: the state and its thrust, each with a standard deviation."""
    # A model may have more states, such as parameters, behind these two.
    (omega, flow), (omega_std, flow_std) = mean[:2].tolist(), np.sqrt(np.diag(cov))[:2].tolist()
    if not isinstance(model.constants, Constants):  # a linear plant's model
        return Overlay(label, None, None, omega, omega_std, flow, flow_std)
    thrust, _ = thrust_and_torque((omega, flow), model.constants)
    slopes = np.array(observe_jacobian((omega, flow), model.constants)[0])
    thrust_std = float(slopes @ cov @ slopes) ** 0.5
    return Overlay(label, thrust, thrust_std, omega, omega_std, flow, flow_std)


class ModelledThruster(ModelledEnv):
    """An env with a `plant` that offers its model to filters; changes are those of `model.model_of_plant`."""

    plant_name = "a bow thruster"
    plant: Plant

    def model_maker(self) -> Callable[..., StateSpaceModel]:
        """`model.model_of_plant`."""
        from thruster_env.thruster.model import model_of_plant

        return model_of_plant

    def tuned_differences(self, tuned_for: Mapping, file: str) -> list[str]:
        """See `plant.check_same_plant`."""
        from thruster_env.thruster.plant import check_same_plant

        return check_same_plant(tuned_for, self.plant, file)

    def overlay(self, label: str, model: StateSpaceModel, mean: np.ndarray, cov: np.ndarray) -> Overlay:
        """The belief that a rendered thruster shows beside the truth."""
        return overlay_of(label, model, mean, cov)


def renderer_of(
    plant: Plant, mode: str, frames_per_second: float, size: tuple[int, int] | None = None
) -> Renderer:
    """What draws a plant, its scales those of the full voltage; arguments are those of `Renderer`."""
    p, top = plant.parameters, plant.max_voltage
    speed, flow = state_range(p, top) / 2
    return Renderer(
        mode,
        gear_ratio=p.gear_ratio,
        diameter=p.diameter,
        max_voltage=top,
        thrust_scale=thrust_scale(plant),
        speed_scale=speed,
        flow_scale=flow,
        dt=plant.dt,
        frames_per_second=frames_per_second,
        size=size,
    )


def half_thrust(plant: Plant) -> float:
    """Steady thrust at half of max_voltage [N]: the reference where no other one is given."""
    if plant.linear is None:
        return steady_state(plant.parameters, plant.max_voltage / 2).thrust
    return float(equilibrium(plant.linear, (plant.max_voltage / 2, 0.0))[2])


class BowThrusterEnv(ModelledThruster, PlantEnv):
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
    noise, sensors and disturbances; without `substeps`) and of `make_task` there (`reference` [N] or signals, by
    default the steady thrust at half of max_voltage, and the weights above); `render_mode`, and `render_size`,
    (width, height) of pictures in pixels, come on top. All but the first go by name. A wrong value
    raises a ValueError.
    """

    metadata: dict[str, Any] = {"render_modes": list(MODES), "render_fps": 100}
    inputs = INPUTS
    page_of = staticmethod(page_of)
    observes_reference = False

    @takes_arguments_of(make_plant, make_task, leaving_out=["substeps"])
    def __init__(self, *, render_mode: str | None = None, render_size: Sequence[int] | None = None, **arguments):
        """Build the plant; see the class for the arguments."""
        self._build(make_plant(**arguments_of(make_plant, arguments)), (render_mode, render_size), arguments)

    def _build(self, plant: Plant, rendering: tuple, arguments: dict) -> None:
        self.plant = plant
        of_task = arguments_of(make_task, arguments)
        self.task = make_task(**{**of_task, "reference": self._reference_signals(of_task["reference"])})
        top, appended = plant.max_voltage, ("next_reference",) if self.observes_reference else ()
        info = "state", "thrust", "measurement", "reference", "ambient_velocity", "time"
        space = gym.spaces.Box(-top, top, shape=(1,), dtype=np.float32)
        self._set_up(space, info, appended, plant.dropping_channels, *rendering)

    def make_renderer(self) -> Renderer:
        """What draws the thruster in its water."""
        assert self.render_mode is not None  # a renderer is made for a mode only
        return renderer_of(self.plant, self.render_mode, self.metadata["render_fps"], self.render_size)

    def moment_of(self, report: list[float]) -> ChartEntry:
        """What the renderer adds of a report: truth, measured thrust, reference and voltage."""
        values = self._by_name(report)
        omega, flow = values["state"]
        readings = dict(zip(self.plant.channels, values["measurement"], strict=True))
        return ChartEntry(
            time=report[TIME],
            omega_m=omega,
            U_a=flow,
            thrust=values["thrust"],
            measured_thrust=readings.get("thrust", math.nan),
            reference=values["reference"],
            voltage=float(np.clip(self._command[0], -self.plant.max_voltage, self.plant.max_voltage)),
            ambient_velocity=values["ambient_velocity"],
        )

    def _reference_signals(self, reference):
        return [Constant(thrust=half_thrust(self.plant) if reference is None else finite("reference", reference))]

    @property
    def thrust_scale(self) -> float:
        """Steady thrust at max_voltage, T_max [N]."""
        return thrust_scale(self.plant)

    @property
    def parameters(self) -> ThrusterParameters:
        """The parameters of this episode, which differ from the plant's where these are uncertain."""
        key = self._copies.memory[0, [KEY_0, KEY_1], 0]
        uncertain = {name: (type(kind), kind.numbers) for name, kind in self.plant.uncertainty.items()}
        drawn = drawn_parameters(self.plant.parameters, uncertain, Draws(tuple(key), 0))
        values: dict[str, Any] = {name: float(getattr(drawn, name)) for name in uncertain}
        return drawn._replace(**values)


class BowThrusterTrackingEnv(BowThrusterEnv):
    """A ship's bow thruster: follow a reference thrust that changes, ahead.

    As `BowThrusterEnv`, except for these:

    ## Observation space
    | num | observation | min | max | unit |
    |---|---|---|---|---|
    | 0 | measured thrust T + v at time k | -inf | inf | N |
    | 1 | reference r at time k + 1 | -inf | inf | N |

    With other `sensors`, their channels and validity flags come first, the reference last.

    ## Reward
    That of step k compares T with r of time k + 1, the one that the action saw.

    ## Arguments `reference` is a list of signals of `effects.REFERENCE_SIGNALS`, which are added, each a
    mapping with its `name` ("constant", "steps", "ramps", "prbs", "multi-sine", "band-limited-noise", "recorded");
    levels are fractions of the steady thrust at max_voltage. By default steps between 0.1 and 0.8, held for 1 s.
    """

    observes_reference = True
    default_reference = ({"name": "steps", "low": 0.1, "high": 0.8, "hold_time": 1.0},)

    def _reference_signals(self, reference):
        return self.default_reference if reference is None else reference


class BowThrusterReversalEnv(BowThrusterTrackingEnv):
    """A ship's bow thruster: follow a reference thrust that crosses zero, ahead and astern.

    As `BowThrusterTrackingEnv`; by default the reference runs in straight lines of 1 s between levels drawn from
    -0.6 to 0.6 of the steady thrust at max_voltage. Near zero the thrust contains hardly any information on the
    state.
    """

    default_reference = ({"name": "ramps", "low": -0.6, "high": 0.6, "hold_time": 1.0},)


class BowThrusterLinearEnv(BowThrusterEnv):
    """A linear system that Kiki (2020) and Nurhadi et al. (2022) print in place of the bow thruster.

        x_{k+1} = A_d x_k + B_d (V_s, U_0)_k + w_k,    z_k = C x_k + v_k

    Here the Kalman filter is optimal. Observation, action, reward, info and episode are those of `BowThrusterEnv`;
    T_max and the range of the state are those of the equilibrium at max_voltage. (The open-bladed system is
    unstable.)

    ## Arguments
    The list is that of `thruster_env.thruster.linear.make_linear_plant` (`system` is "tunnel" or
    "open_bladed"; `process_noise_cov` and `measurement_noise_cov` are the published 0.5 of each state and
    measurement by default) and of `thruster_env.thruster.plant.make_task`; `render_mode` and `render_size` come on
    top.
    """

    @takes_arguments_of(
        make_linear_plant, make_task, defaults={"process_noise_cov": (PUBLISHED_NOISE, PUBLISHED_NOISE)}
    )
    def __init__(self, *, render_mode: str | None = None, render_size: Sequence[int] | None = None, **arguments):
        """Build the plant; see the class for the arguments."""
        plant = make_linear_plant(**arguments_of(make_linear_plant, arguments))
        self._build(plant, (render_mode, render_size), arguments)


class BowThrusterVectorEnv(ModelledThruster, PlantVectorEnv):
    """Vector env of `BowThruster-v0`; see `PlantVectorEnv`. Uncertain parameters are drawn per copy and episode.

    `num_envs`, `max_episode_steps` and `autoreset_mode` are those of `PlantVectorEnv`, the others those of the
    single env.
    """

    single_env: ClassVar[type[BowThrusterEnv]] = BowThrusterEnv


class BowThrusterTrackingVectorEnv(BowThrusterVectorEnv):
    """Vector env of `BowThrusterTracking-v0`."""

    single_env = BowThrusterTrackingEnv


class BowThrusterReversalVectorEnv(BowThrusterVectorEnv):
    """Vector env of `BowThrusterReversal-v0`."""

    single_env = BowThrusterReversalEnv


class BowThrusterLinearVectorEnv(BowThrusterVectorEnv):
    """Vector env of `BowThrusterLinear-v0`."""

    single_env = BowThrusterLinearEnv
