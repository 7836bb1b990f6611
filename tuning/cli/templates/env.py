"""A Gymnasium env of your own, with a filter and a problem to tune it. Here: a mass on a spring.

Replace the code below by your own. To try it as it is:

python template.py                                              # an episode, estimated
thruster tune --problem template:problem --filter ekf --trials 50
"""

from typing import NamedTuple

import gymnasium as gym
import numpy as np

from filters import EstimateState, StateSpaceModel
from tuning.problems.env_problem import EnvProblem

MEASUREMENT_STD = 0.01  # [m], of the sensor's data sheet


class Constants(NamedTuple):
    """Constants of the plant."""

    dt: float = 0.02  # sample time [s]
    mass: float = 1.0  # [kg]
    stiffness: float = 40.0  # [N/m]
    damping: float = 1.5  # [N s/m]


def move(x, u, c):
    """The next state: x the state, u the inputs that act over the step, c the constants.

    Filters compile this: use operators, `math` and tuples; no arrays, no objects. `math.sin` is fine.
    """
    position, speed = x
    acceleration = (u[0] - c.stiffness * position - c.damping * speed) / c.mass
    speed = speed + c.dt * acceleration
    return (position + c.dt * speed, speed)


def look(x, c):
    """The measurement of a state, without noise: the position."""
    return (x[0],)


def model():
    """What a filter assumes of the env: the same equations, and variances of the model error."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=Constants(),
        process_noise_cov=[1e-7, 4e-4],  # of each state, PER STEP: they do not scale with dt
        measurement_noise_cov=[MEASUREMENT_STD**2],
        prior_mean=[0.0, 0.0],
        prior_cov=[0.01, 0.1],
        state_low=[-0.2, -1.0],
        state_high=[0.2, 1.0],
        states=[("position", "x", "m"), ("speed", "v", "m/s")],
        input_quantities=[("force", "F", "N")],
        measurements=[("measured position", "z", "m")],
    )


class SpringEnv(gym.Env):
    """The action is a force [N], the observation the measured position [m]; the speed is hidden."""

    metadata = {"render_modes": []}

    def __init__(self):
        self.action_space = gym.spaces.Box(-4.0, 4.0, (1,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.dt, self._state = Constants().dt, np.zeros(2)

    def state_space_model(self, **changes):
        """The model for filter wrappers."""
        return model().replace(**changes)

    def reset(self, *, seed=None, options=None):
        """Begin an episode at a random state."""
        super().reset(seed=seed)
        self._state = self.np_random.normal(0.0, [0.1, 0.3])
        return self._measured()

    def step(self, action):
        """Let a force act for one step."""
        noise = self.np_random.normal(0.0, [3e-4, 0.02])  # of the process: square them for Q
        self._state = np.array(move(self._state, np.clip(action, -4.0, 4.0), Constants())) + noise
        observation, info = self._measured()
        return observation, -float(self._state[0] ** 2), False, False, info

    def _measured(self):
        z = look(self._state, Constants()) + self.np_random.normal(0.0, MEASUREMENT_STD, 1)
        # The true state is for evaluation and pictures only: a filter never sees it.
        return z, {"state": self._state.copy(), "measurement": z}


# Each run is an episode under random levels of the force; a policy (a function of the observation) works as well.
problem = EnvProblem(
    SpringEnv,
    {"name": "steps", "amplitude": 4.0, "hold": 25},
    model(),
    steps=300,
    name="template",
    about="a mass on a spring whose position is measured",
)


if __name__ == "__main__":
    env = EstimateState(SpringEnv(), filter="ekf")
    observation, info = env.reset(seed=1)
    for _ in range(200):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    print("state", info["state"], "estimate", info["estimate"], "+-", info["estimate_cov"].diagonal() ** 0.5)
