"""
Policies on an estimate
=======================

Reinforcement learning from the raw sensor, or from a filter's estimate? This script trains both
with Stable-Baselines3 (``pip install '.[rl]'``), for some seconds each.
"""

# %%
# The env
# -------
#
# ``BowThrusterTracking-v0`` has a thrust reference that changes. ``gym.make_vec`` steps all copies in one compiled
# call; ``filters:BowThrusterTracking-EKF-v0`` is the same env with an extended Kalman filter beside each copy.
# ``NativeVecEnv`` passes either to Stable-Baselines3, with actions in [-1, 1] for voltages in [-24, 24].

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

import thruster_env
from tuning.policies.environments import NativeVecEnv

COPIES = 64
TRAINING_STEPS = 60_000
EPISODES = 50

torch.set_num_threads(1)  # the networks are small
SENSOR = {"measurement_noise_cov": [16.0]}  # a standard deviation of 4 N


def make(env_id, copies):
    """Copies of an env, side by side."""
    return NativeVecEnv(
        gym.make_vec(env_id, num_envs=copies, autoreset_mode="SameStep", **SENSOR)
    )


# %%
# Train and score
# ---------------
#
# The same algorithm and the same hyperparameters for both. The discount is small because the thruster responds
# within some ten steps. Scores are on the same held-out episodes for both: a :term:`paired` comparison.


def train(env_id, seed=0):
    """A policy, and the normalisation of its observations."""
    envs = VecNormalize(make(env_id, COPIES), gamma=0.5)
    envs.seed(seed)
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=64,
        batch_size=256,
        n_epochs=5,
        learning_rate=1e-3,
        gamma=0.5,
        gae_lambda=0.9,
        policy_kwargs={"log_std_init": -1.0},
        seed=seed,
        device="cpu",
    )
    model.learn(TRAINING_STEPS)
    return model, envs


def score(env_id, model, training_envs, first_seed=1_000_000):
    """The return of each held-out episode."""
    envs = make(env_id, EPISODES)
    envs.seed(first_seed)
    observations, returns = envs.reset(), np.zeros(EPISODES)
    for _ in range(500):
        actions, _ = model.predict(
            training_envs.normalize_obs(observations), deterministic=True
        )
        observations, rewards, dones, _ = envs.step(actions)
        returns += rewards
    assert dones.all()
    return returns


RAW, FILTERED = "BowThrusterTracking-v0", "filters:BowThrusterTracking-EKF-v0"
raw = score(RAW, *train(RAW))
filtered = score(FILTERED, *train(FILTERED))

# %%
# Results
# -------
#
# The return is minus the mean squared error of the thrust over the range, summed; nearer to zero is better.

difference = filtered - raw
print(f"return on the measurement: {raw.mean():.2f}")
print(f"return on the estimate:    {filtered.mean():.2f}")
print(f"better on {np.mean(difference > 0):.0%} of {EPISODES} held-out episodes")

# %%
# One training seed says little about an algorithm. :doc:`/policies` has five for each case, all observations from
# raw to true state, and MPC for comparison, computed by ``thruster train``, ``thruster score`` and ``thruster
# reproduce policies``.
