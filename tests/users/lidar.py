"""Targets that drive and turn, located by a lidar: polar noise in Cartesian axes, which no constant R describes.

    x_{k+1} = x_k + v_k + a_k/2,   v_{k+1} = v_k + a_k,   z = position, off by 2 m in range and 1.5 deg in bearing

Intervals of 5 to 8 steps have each an acceleration along the path of deviation 2 and one across it, uniform
within +-15. What I had: the same motion with a white acceleration of 5 m/s^2, and R = (20 m)^2 in both axes.
Only positions count.

Source: the simulator of the package Optimized-Kalman-Filter, described in I. Greenberg, N. Yannay, S. Mannor
(2023), "Optimization or Architecture: How to Hack Kalman Filtering", NeurIPS, arXiv 2310.00675; written anew,
all runs of one length.
"""

import gymnasium as gym
import numpy as np

from filters import affine_model
from tuning.problems.env_problem import EnvProblem

STEPS = 30
RANGE, BEARING = 2.0, 1.5 * np.pi / 180.0  # deviations [m, rad]


class LidarEnv(gym.Env):
    """A target that nobody steers: the action has no entries."""

    def __init__(self):
        self.action_space = gym.spaces.Box(-1.0, 1.0, (0,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self._state, self._left, self._along, self._across = np.zeros(4), 0, 0.0, 0.0

    def reset(self, *, seed=None, options=None):
        """A target somewhere within 600 m, at 30 to 90 m/s in any direction."""
        super().reset(seed=seed)
        speed, course = self.np_random.uniform(30.0, 90.0), self.np_random.uniform(0.0, 2.0 * np.pi)
        where = self.np_random.uniform(-600.0, 600.0, 2)
        self._state, self._left = np.array([*where, speed * np.cos(course), speed * np.sin(course)]), 0
        return self._seen()

    def step(self, action):
        """One second."""
        if self._left == 0:
            self._left = int(self.np_random.integers(5, 9))
            self._along, self._across = self.np_random.normal(0.0, 2.0), self.np_random.uniform(-15.0, 15.0)
        self._left -= 1
        position, velocity = self._state[:2], self._state[2:]
        ahead = velocity / np.hypot(*velocity)
        acceleration = self._along * ahead + self._across * np.array([-ahead[1], ahead[0]])
        self._state = np.concatenate([position + velocity + acceleration / 2, velocity + acceleration])
        observation, info = self._seen()
        return observation, 0.0, False, False, info

    def _seen(self):
        x, y = self._state[:2]
        distance = np.hypot(x, y) + self.np_random.normal(0.0, RANGE)
        angle = np.arctan2(y, x) + self.np_random.normal(0.0, BEARING)
        z = distance * np.array([np.cos(angle), np.sin(angle)])
        return z, {"state": self._state.copy(), "measurement": z}


def model(sigma_a=5.0, sigma_z=20.0):
    """A white acceleration [m/s^2], and positions of some deviation [m]."""
    g = np.array([[0.5, 0.0], [0.0, 0.5], [1.0, 0.0], [0.0, 1.0]])
    return affine_model(
        a=np.eye(4) + np.eye(4, k=2),
        b=np.zeros((4, 0)),
        c=np.eye(2, 4),
        process_noise_cov=sigma_a**2 * g @ g.T,
        measurement_noise_cov=[sigma_z**2] * 2,
        prior_mean=[0.0] * 4,
        prior_cov=[350.0**2, 350.0**2, 45.0**2, 45.0**2],
        states=[("easting", "x", "m"), ("northing", "y", "m"), ("speed", "v_x", "m/s"), ("speed", "v_y", "m/s")],
        measurements=[("measured easting", "z_x", "m"), ("measured northing", "z_y", "m")],
    )


problem = EnvProblem(
    LidarEnv,
    "random",
    model(),
    steps=STEPS,
    first_scored_step=2,
    scale=(10.0, 10.0, np.inf, np.inf),
    dt=1.0,
    name="lidar",
    about="turning targets seen by a lidar; noise in range and bearing, R in Cartesian axes",
)
