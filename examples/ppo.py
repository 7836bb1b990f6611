"""
PPO in a script of one's own
============================

This script trains a policy by which the thrust follows a reference, from a Kalman filter's estimate, with
Stable-Baselines3 (``pip install '.[rl]'``) and hyperparameters for this plant. It takes a third of the
steps of ``thruster train``; for all of them::

    python examples/ppo.py --steps 401408 --out ppo_thruster

This page is not run when the site is built, because training takes about a minute. Its recorded output is at the
end.
"""

import argparse

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers import RescaleAction
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import thruster_env  # noqa: F401 - registers the envs
from filters import EstimateState, EstimateStates
from tuning.policies import NativeVecEnv

ENV, FILTER = "BowThrusterTracking-v0", "ekf"
COPIES = 64  # stepped side by side, in one compiled call
ROLLOUT = 64  # steps of each between two updates: batches of 4096 steps
DISCOUNT = 0.5  # the voltage sets the thrust of the very next step, so a short horizon suffices
PPO_NUMBERS = {
    "n_steps": ROLLOUT,
    "batch_size": 256,
    "n_epochs": 5,
    "gamma": DISCOUNT,
    "gae_lambda": 0.9,
    "policy_kwargs": {"net_arch": [64, 64, 64], "log_std_init": -1.0},
}

# %%
# The envs
# --------
#
# For training, all copies of the thruster and their filters are stepped together. ``NativeVecEnv`` passes them to
# Stable-Baselines3, and takes actions in [-1, 1] for the range of the voltage, as PPO's Gaussian policy requires.
# Observations and rewards are normalised, which matters because the states differ widely in magnitude.


def make_training(copies=COPIES, seed=0):
    """Copies of the env with a filter each, as PPO takes them."""
    envs = gym.make_vec(ENV, num_envs=copies, autoreset_mode="SameStep")
    venv = VecNormalize(
        VecMonitor(NativeVecEnv(EstimateStates(envs, FILTER))), gamma=DISCOUNT
    )
    venv.seed(seed)
    return venv


# %%
# The trained policy is used on one thruster. ``RescaleAction`` gives it the same actions in [-1, 1].


def make_single():
    """One env with its filter, for the policy at work."""
    return RescaleAction(
        EstimateState(gym.make(ENV), FILTER), np.float32(-1.0), np.float32(1.0)
    )


# %%
# Learn
# -----


def learn(steps, copies=COPIES, seed=0):
    """The policy after so many steps, and the normalisation that belongs to it."""
    torch.set_num_threads(1)  # fastest for such small networks
    venv = make_training(copies, seed)
    rate = 1e-3

    def falling(remaining):  # linearly to zero with the remaining share of the steps
        return rate * max(remaining, 0.0)

    model = PPO(
        "MlpPolicy", venv, learning_rate=falling, seed=seed, device="cpu", **PPO_NUMBERS
    )
    model.learn(steps)
    return model, venv


# %%
# Use it
# ------
#
# The policy was trained on normalised observations and needs them here, too.


def episode_return(model, venv, seed):
    """Sum of the rewards of one episode."""
    env, total, done = make_single(), 0.0, False
    observation, _ = env.reset(seed=seed)
    while not done:
        action, _ = model.predict(venv.normalize_obs(observation), deterministic=True)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, done = total + reward, terminated or truncated
    return total


def main(arguments=None):
    """Train a policy, evaluate it on held-out episodes, and save it."""
    parser = argparse.ArgumentParser(description="PPO on the estimate of a filter.")
    parser.add_argument(
        "--steps",
        type=int,
        default=131_072,
        help="training steps; 401408 is best",
    )
    parser.add_argument("--copies", type=int, default=COPIES, help="copies of the env")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=5, help="held-out episodes")
    parser.add_argument(
        "--out", help="where to save: OUT.zip, and OUT.pkl with the normalisation"
    )
    options = parser.parse_args(arguments)
    model, venv = learn(options.steps, options.copies, options.seed)
    returns = [
        episode_return(model, venv, 1_000_000 + seed)
        for seed in range(options.episodes)
    ]
    print(
        f"mean return of {options.episodes} held-out episodes: {np.mean(returns):.3f}"
    )
    if options.out:
        model.save(options.out)
        venv.save(f"{options.out}.pkl")
    return returns


if __name__ == "__main__":
    main()

# %%
# Its output on two cores, within a minute, after 131072 steps::
#
#    mean return of 5 held-out episodes: -0.917
#
# The return is minus a squared error, so nearer to zero is better.
