"""`BowThruster-v0`: voltage in, noisy thrust out, the state hidden."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np

from thruster_env.checks import finite
from thruster_env.linear import state_range, steady_state
from thruster_env.parameters import ThrusterParameters
from thruster_env.plant import (
    DEFAULT_DT,
    DEFAULT_MAX_VOLTAGE,
    DEFAULT_MEASUREMENT_NOISE,
    DEFAULT_PROCESS_NOISE,
    KEY_0,
    KEY_1,
    MEMORY_ROWS,
    make_plant,
    single_step,
)
from thruster_env.streams import draw_key

VOLTAGE_RATE_COST = 0.01  # reward lost for a jump of the voltage by max_voltage within one step
ABSURD = 100.0  # a state this many times its range away from rest ends the episode


class BowThrusterEnv(gym.Env):
    """A ship's bow thruster: hold a thrust by the voltage of the motor, seeing the measured thrust only.

    ## Action space
    | num | action | min | max | unit |
    |---|---|---|---|---|
    | 0 | source voltage V_s, clipped | -max_voltage | max_voltage | V |

    ## Observation space
    | num | observation | min | max | unit |
    |---|---|---|---|---|
    | 0 | measured thrust T + v | -inf | inf | N |

    ## State (hidden; in `info["state"]`)
    | num | state | unit |
    |---|---|---|
    | 0 | motor speed omega_m | rad/s |
    | 1 | section-average flow velocity U_a | m/s |

    ## Reward
    -((T - reference)/T_max)^2 - 0.01 (change of voltage/max_voltage)^2, from the true thrust T after the step;
    T_max is the steady thrust at max_voltage.

    ## Info
    `state` (2,), `thrust` [N], `measurement` (1,) in float64 [N], `reference` [N], `time` [s].

    ## Episode
    Starts at N(0, diag(1, 0.01)) unless `initial_state` says otherwise; truncated after 500 steps (5 s);
    terminated when the state is not finite or 100 times its range away from rest.

    ## Arguments
    `preset`, `dt`, `max_voltage`, `ambient_velocity`, `process_noise_cov`, `measurement_noise_cov` and
    `initial_state` are those of `thruster_env.plant.make_plant`; `reference` is the thrust to hold [N], by
    default the steady thrust at half of max_voltage. A wrong one raises a ValueError.
    """

    metadata = {"render_modes": [], "render_fps": 100}

    def __init__(
        self,
        preset: str | dict | ThrusterParameters = "tunnel",
        dt: float = DEFAULT_DT,
        max_voltage: float = DEFAULT_MAX_VOLTAGE,
        ambient_velocity: float = 0.0,
        process_noise_cov=DEFAULT_PROCESS_NOISE,
        measurement_noise_cov: float = DEFAULT_MEASUREMENT_NOISE,
        reference: float | None = None,
        initial_state=None,
        render_mode: str | None = None,
    ):
        """Build the plant; see the class for the arguments."""
        if render_mode is not None:
            raise ValueError(f"render_mode must be None, but got {render_mode!r}")
        self.render_mode = render_mode
        self.plant = make_plant(
            preset, dt, max_voltage, ambient_velocity, process_noise_cov, measurement_noise_cov, initial_state
        )
        top = self.plant.max_voltage
        self.thrust_scale = steady_state(self.plant.parameters, top).thrust
        if reference is None:
            self.reference = steady_state(self.plant.parameters, top / 2).thrust
        else:
            self.reference = finite("reference", reference)
        self.action_space = gym.spaces.Box(-top, top, shape=(1,), dtype=np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, shape=(1,), dtype=np.float32)
        flow = abs(self.plant.ambient_velocity)
        turned_by_flow = np.array([flow / self.plant.constants.blade_speed, flow])
        self._limits = (ABSURD * (state_range(self.plant.parameters, top) + turned_by_flow)).tolist()
        self._numbers = self.plant.numbers
        self._memory = np.zeros((MEMORY_ROWS, 1))
        self._step = single_step()
        self._steps = 0
        self._voltage = 0.0

    @property
    def spec(self):
        """The specification that made this env; parameters are kept in it as a mapping, which JSON can hold."""
        return self._spec

    @spec.setter
    def spec(self, spec) -> None:
        if spec is not None and isinstance(spec.kwargs.get("preset"), ThrusterParameters):
            spec.kwargs["preset"] = spec.kwargs["preset"]._asdict()
        self._spec = spec

    _spec = None

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode: a key from the env's generator, an initial state and a first measurement."""
        super().reset(seed=seed)
        self._memory[KEY_0 : KEY_1 + 1, 0] = draw_key(self.np_random)
        self._steps = 0
        omega, flow, thrust, measured, self._voltage = self._step(self._memory, 0.0, self._numbers, True)
        return _as_observation(measured), self._info(omega, flow, thrust, measured)

    def step(self, action):
        """Apply a voltage for one sample time.

        Raises ValueError for an action that is not one number or is NaN.
        """
        voltage = _as_voltage(action)
        previous = self._voltage
        omega, flow, thrust, measured, self._voltage = self._step(self._memory, voltage, self._numbers, False)
        self._steps += 1
        error = (thrust - self.reference) / self.thrust_scale
        rate = (self._voltage - previous) / self.plant.max_voltage
        reward = -error * error - VOLTAGE_RATE_COST * rate * rate
        terminated = not (abs(omega) < self._limits[0] and abs(flow) < self._limits[1])
        observation = _as_observation(measured)
        return observation, reward, terminated, False, self._info(omega, flow, thrust, measured)

    def _info(self, omega, flow, thrust, measured) -> dict:
        return {
            "state": np.array((omega, flow)),
            "thrust": thrust,
            "measurement": np.array((measured,)),
            "reference": self.reference,
            "time": self._steps * self.plant.dt,
        }


def _as_voltage(action) -> float:
    try:
        voltage = float(action.item() if hasattr(action, "item") else np.asarray(action, dtype=np.float64).item())
    except (TypeError, ValueError, OverflowError, RuntimeError):  # RuntimeError: a torch tensor of several numbers
        voltage = math.nan
    if voltage != voltage:
        raise ValueError(f"an action must be one voltage [V] and not NaN, but got {action!r}")
    return voltage


def _as_observation(measured: float) -> np.ndarray:
    # float32 ends at 3.4e38; casting beyond it would warn on its way to infinity.
    if not abs(measured) < 3e38:
        measured = math.copysign(math.inf, measured)
    return np.array((measured,), dtype=np.float32)
