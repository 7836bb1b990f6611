"""`BowThruster-v0`: voltage in, noisy thrust out, the state hidden."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping

import gymnasium as gym
import numpy as np

from numerics.checks import finite, shown
from numerics.checks import seed as checked_seed
from numerics.streams import draw_key
from plants.disturbances.effects import Effect
from plants.disturbances.layout import KEY_0, KEY_1
from thruster_env.effects.reference import Constant
from thruster_env.effects.uncertainty import LogNormal, Uniform, as_mapping, drawn_parameters
from thruster_env.engine.copies import Copies
from thruster_env.engine.memory import (
    AMBIENT,
    COMMAND,
    FLOW,
    NEXT_REFERENCE,
    OMEGA,
    READINGS,
    REFERENCE,
    REPORTED,
    REWARD,
    TERMINATED,
    THRUST,
    TIME,
    VALID,
)
from thruster_env.parameters import ThrusterParameters
from thruster_env.plant import (
    DEFAULT_DT,
    DEFAULT_MAX_VOLTAGE,
    DEFAULT_PROCESS_NOISE,
    Plant,
    make_plant,
)
from thruster_env.rendering.env import RenderedEnv
from thruster_env.task import DEFAULT_WEIGHTS, half_thrust, make_task, thrust_scale

# What `_set_views` makes.
VIEWS = ("_memory", "_numbers", "_advance", "_report", "_state_view", "_measurement_view")


class BowThrusterEnv(RenderedEnv):
    """A ship's bow thruster: hold a thrust by the voltage of the motor, seeing the measured thrust only.

    ## Action space
    | num | action | min | max | unit |
    |---|---|---|---|---|
    | 0 | source voltage V_s, clipped | -max_voltage | max_voltage | V |

    ## Observation space
    | num | observation | min | max | unit |
    |---|---|---|---|---|
    | 0 | measured thrust T + v | -inf | inf | N |

    With other `sensors`, one entry a channel in their order; then, for each channel that may drop out, 1 where the
    measurement is valid and 0 where the last one is repeated.

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

    T is the true thrust after the step, whatever the sensors say; T_max is the steady thrust at max_voltage.

    ## Info
    `state` (2,), `thrust` [N], `measurement` (m,) in float64, `reference` [N] that the reward compares with,
    `ambient_velocity` [m/s] during the step, `time` [s]; with dropout also `measurement_valid` (m,).

    ## Episode
    Starts at N(0, diag(1, 0.01)) unless `initial_state` says otherwise, or `reset(options={"state": [..]})`;
    truncated after 500 steps (5 s); terminated when the state is not finite or 100 times its range away from rest.

    ## Arguments
    Those of `thruster_env.plant.make_plant` (`preset`, `dt`, `max_voltage`, `ambient_velocity`,
    `process_noise_cov`, `measurement_noise_cov`, `initial_state`, `sensors`, `flow`, `amplifier`,
    `uncertainty`), the weights above, and `reference` [N]: by default the steady thrust at half of max_voltage.
    A wrong one raises a ValueError.
    """

    observes_reference = False

    def __init__(
        self,
        preset: str | dict | ThrusterParameters = "tunnel",
        dt: float = DEFAULT_DT,
        max_voltage: float = DEFAULT_MAX_VOLTAGE,
        ambient_velocity: float = 0.0,
        process_noise_cov=DEFAULT_PROCESS_NOISE,
        measurement_noise_cov=None,
        reference=None,
        initial_state=None,
        sensors=None,
        flow=None,
        amplifier=None,
        uncertainty=None,
        tracking_weight: float = DEFAULT_WEIGHTS[0],
        energy_weight: float = DEFAULT_WEIGHTS[1],
        voltage_rate_weight: float = DEFAULT_WEIGHTS[2],
        render_mode: str | None = None,
    ):
        """Build the plant; see the class for the arguments."""
        plant = make_plant(
            preset=preset,
            dt=dt,
            max_voltage=max_voltage,
            ambient_velocity=ambient_velocity,
            process_noise_cov=process_noise_cov,
            measurement_noise_cov=measurement_noise_cov,
            initial_state=initial_state,
            sensors=sensors,
            flow=flow,
            amplifier=amplifier,
            uncertainty=uncertainty,
        )
        self._build(plant, reference, (tracking_weight, energy_weight, voltage_rate_weight), render_mode)

    def _build(self, plant: Plant, reference, weights, render_mode: str | None) -> None:
        self.plant = plant
        self._prepare_rendering(render_mode)
        self.task = make_task(self._reference_signals(reference), *weights)
        top, size = plant.max_voltage, len(plant.channels)
        dropping = [VALID + i for i in plant.dropping_channels]
        self._appended = [*dropping, *([NEXT_REFERENCE] if self.observes_reference else [])]
        self._readings, self._valid = slice(READINGS, READINGS + size), slice(VALID, VALID + size)
        self._drops = bool(dropping)
        self._single = size == 1 and not self._appended  # the frequent case, which has to be quick
        self.action_space = gym.spaces.Box(-top, top, shape=(1,), dtype=np.float32)
        self.observation_space = gym.spaces.Box(
            -np.inf, np.inf, shape=(size + len(self._appended),), dtype=np.float32
        )
        self._copies = Copies(plant, self.task, 1)
        self._out = np.zeros((REPORTED, 1, 1))
        self._observation_buffer = np.zeros(1, dtype=np.float32)
        self._set_views()

    def _set_views(self) -> None:
        """Short ways into the memory of the one copy, for a step has to be quick."""
        self._memory, self._numbers, self._advance = (
            self._copies.memory,
            self._copies.numbers,
            self._copies.advance,
        )
        self._report = self._out.reshape(-1)
        self._state_view, self._measurement_view = self._report[OMEGA : FLOW + 1], self._report[self._readings]

    def __getstate__(self) -> dict:
        """The state without its views, for copies and pickles, which go on with the same numbers."""
        return {key: value for key, value in vars(self).items() if key not in VIEWS}

    def __setstate__(self, state: dict) -> None:
        """Make the views on the memory that was kept."""
        vars(self).update(state)
        self._set_views()

    def __copy__(self) -> BowThrusterEnv:
        """A deep copy: two envs with one memory would move one another."""
        return copy.deepcopy(self)

    def _reference_signals(self, reference):
        return [Constant(thrust=half_thrust(self.plant) if reference is None else finite("reference", reference))]

    @property
    def appended_entries(self) -> int:
        """Entries of the observation after the measurement: validity flags and the reference."""
        return len(self._appended)

    @property
    def observed_rows(self) -> list[int]:
        """Rows of a report, see `memory`, that make the observation."""
        return [*range(self._readings.start, self._readings.stop), *self._appended]

    @property
    def thrust_scale(self) -> float:
        """Steady thrust at max_voltage, T_max [N]."""
        return thrust_scale(self.plant)

    @property
    def parameters(self) -> ThrusterParameters:
        """The parameters of this episode, which differ from the plant's where these are uncertain."""
        keys = self._memory[:1, KEY_0 : KEY_1 + 1, 0]
        drawn = drawn_parameters(self.plant.parameters, self.plant.uncertainty, keys)
        return drawn._replace(**{name: float(getattr(drawn, name)[0]) for name in self.plant.uncertainty})

    @property
    def spec(self):
        """The specification that made this env; its objects are kept as mappings, which JSON can hold."""
        return self._spec

    @spec.setter
    def spec(self, spec) -> None:
        if spec is not None:
            spec.kwargs.update({key: _as_json(value) for key, value in spec.kwargs.items()})
        self._spec = spec

    _spec = None

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode: a key from the env's generator, an initial state and a first measurement.

        `options={"state": [omega_m, U_a]}` fixes the initial state of this episode.
        """
        numbers = self._copies.numbers_from(options)
        super().reset(seed=checked_seed(seed))
        self._report[:] = self._copies.begin(draw_key(self.np_random)[None], numbers=numbers)[:, 0]
        report = self._report.tolist()
        if self.render_mode is not None:
            self._show(report, begin=True)
        return self._observation(report), self._info()

    def step(self, action):
        """Apply a voltage for one sample time.

        Raises ValueError for an action that is not one number or is NaN.
        """
        self._memory[0, COMMAND, 0] = _as_voltage(action)
        self._advance(0, 1, self._memory, self._numbers, self._out, False)
        report = self._report.tolist()
        if self.render_mode is not None:
            self._show(report)
        return self._observation(report), report[REWARD], report[TERMINATED] > 0.0, False, self._info()

    def _observation(self, report: list[float]) -> np.ndarray:
        if self._single and -3e38 < report[READINGS] < 3e38:
            self._observation_buffer[0] = report[READINGS]
            return self._observation_buffer.copy()  # twice as fast as a new array of one number
        values = report[self._readings] + [report[i] for i in self._appended]
        # float32 ends at 3.4e38; casting beyond it would warn on its way to infinity.
        values = [value if abs(value) < 3e38 else -math.inf if value < 0 else math.inf for value in values]
        return np.array(values, dtype=np.float32)

    def _info(self) -> dict:
        report = self._report  # of which NumPy's scalars come: clients ask every value for its dtype
        info = {
            "state": self._state_view.copy(),
            "thrust": report[THRUST],
            "measurement": self._measurement_view.copy(),
            "reference": report[REFERENCE],
            "ambient_velocity": report[AMBIENT],
            "time": report[TIME],
        }
        if self._drops:
            info["measurement_valid"] = report[self._valid] > 0.0
        return info


def _as_json(value):
    if isinstance(value, ThrusterParameters):
        return value._asdict()
    if isinstance(value, Effect):
        return value.as_mapping()
    if isinstance(value, (Uniform, LogNormal)):
        return as_mapping(value)
    if isinstance(value, Mapping):
        return {key: _as_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_json(entry) for entry in value]
    return value


def _as_voltage(action) -> float:
    try:
        item = action.item if hasattr(action, "item") else np.asarray(action).item
        given = item()
        voltage = math.nan if isinstance(given, (str, bytes)) else float(given)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # RuntimeError: a torch tensor of several numbers
        voltage = math.nan
    if voltage != voltage:
        raise ValueError(f"an action must be one voltage [V] and not NaN, but got {shown(action)}")
    return voltage
