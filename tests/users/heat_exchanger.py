"""A counter-flow heat exchanger that fouls, in three cells: an env with a sensor that is often silent.

    M c T_i' = c u_h (T_{i-1} - T_i) - U/3 (T_i - S_i),
    M c S_i' = c u_c (S_{i+1} - S_i) + U/3 (T_i - S_i),   U a walk

T are the hot cells, fed with 80 degC, S the cold ones, fed with 15 degC from the other end. Measured are both
outlets: the cold one by a radio thermometer that answers every third step, and then in four of five cases.

What I had: 0.1 K of noise a step everywhere and 20 W/K for the walk of U, thermometers of 0.3 K. In the plant
the hot inlet wanders by some 2 K, which no state of mine stands for, and U falls.

Source: F. P. Incropera, D. P. DeWitt (2002), Fundamentals of Heat and Mass Transfer, 5th ed., chapter 11; cells
of 1 kg of water, U A of 1500 W/K as of a small plate exchanger.
"""

from typing import NamedTuple

import gymnasium as gym
import numpy as np

from filters import StateSpaceModel
from thruster_env.core.derivatives import runge_kutta
from tuning.problems.env_problem import EnvProblem

DT, STEPS = 1.0, 200  # [s]


class Constants(NamedTuple):
    """Numbers of the exchanger."""

    substep: float = DT / 2
    mass: float = 1.0  # M, of water in a cell [kg]
    heat: float = 4180.0  # c [J/(kg K)]
    hot: float = 80.0  # inlets [degC]
    cold: float = 15.0


def rates(x, u, c):
    """Of three hot cells, three cold ones [K] and U [W/K] under the two flows [kg/s]."""
    h1, h2, h3, c1, c2, c3, transfer = x
    share, hot, cold = transfer / (3.0 * c.mass * c.heat), u[0] / c.mass, u[1] / c.mass
    return (
        hot * (c.hot - h1) - share * (h1 - c1),
        hot * (h1 - h2) - share * (h2 - c2),
        hot * (h2 - h3) - share * (h3 - c3),
        cold * (c2 - c1) + share * (h1 - c1),
        cold * (c3 - c2) + share * (h2 - c2),
        cold * (c.cold - c3) + share * (h3 - c3),
        0.0 * transfer,
    )


def look(x, c):
    """The two outlets: the last hot cell, and the cold one beside the first hot cell."""
    return (x[2], x[3])


def model(temperature=0.1, transfer=20.0, thermometer=0.3):
    """Noise of some deviation a step of temperatures [K] and of U [W/K], and a thermometer's [K]."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=Constants(),
        substeps=2,
        inputs=2,
        process_noise_cov=[temperature**2] * 6 + [transfer**2],
        measurement_noise_cov=[thermometer**2] * 2,
        prior_mean=[65.0, 55.0, 45.0, 45.0, 35.0, 25.0, 1500.0],
        prior_cov=[25.0] * 6 + [200.0**2],
        states=[(f"hot cell {i}", f"T_{i}", "degC") for i in (1, 2, 3)]
        + [(f"cold cell {i}", f"S_{i}", "degC") for i in (1, 2, 3)]
        + [("heat transfer", "U", "W/K")],
        input_quantities=[("hot flow", "u_h", "kg/s"), ("cold flow", "u_c", "kg/s")],
        measurements=[("hot outlet", "z_h", "degC"), ("cold outlet", "z_c", "degC")],
    )


move = runge_kutta(rates, 7)


class ExchangerEnv(gym.Env):
    """The action is both flows [kg/s]; info says which thermometer answered."""

    def __init__(self):
        self.action_space = gym.spaces.Box(0.1, 0.5, (2,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.dt, self._state, self._inlet, self._step = DT, (), 0.0, 0

    def reset(self, *, seed=None, options=None):
        """Some profile of temperatures and some state of fouling."""
        super().reset(seed=seed)
        assumed = model()
        spread = np.sqrt(np.diag(assumed.prior_cov))
        self._state = tuple(assumed.prior_mean + spread * self.np_random.normal(size=7) / 2)
        self._inlet, self._step = 0.0, 0
        return self._seen()

    def step(self, action):
        """One second, in which the hot inlet wanders about 80 degC and U falls by 0.5 W/K and scatters by 2."""
        self._step += 1
        self._inlet += -0.02 * self._inlet + 0.4 * self.np_random.normal()
        constants = Constants()._replace(hot=80.0 + self._inlet)
        for _ in range(2):
            self._state = move(self._state, action, constants)
        noise = self.np_random.normal(size=7) * ([0.03] * 6 + [2.0]) - np.array([0.0] * 6 + [0.5])
        self._state = tuple(np.add(self._state, noise).tolist())
        observation, info = self._seen()
        return observation, 0.0, False, False, info

    def _seen(self):
        z = look(self._state, Constants()) + self.np_random.normal(0.0, 0.3, 2)
        answers = self._step % 3 == 0 and self.np_random.random() < 0.8
        return z, {"state": np.array(self._state), "measurement": z, "measurement_valid": [True, answers]}


problem = EnvProblem(
    ExchangerEnv,
    {"name": "levels", "low": 0.1, "high": 0.5, "shortest": 20, "longest": 60},
    model(),
    steps=STEPS,
    name="heat-exchanger",
    about="temperatures and fouling of a heat exchanger, one of whose thermometers is often silent",
)
