"""How well policies do on held-out episodes: return, and thrust error in transients, steadily and at reversals.

Learnt and classical policies run in the same loop, on the same seeds, in native envs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from thruster_env.task import thrust_scale
from training.environments import make_environments
from training.setup import Setup

TRANSIENT = 0.15  # [s] after a step of the reference; what comes later is steady tracking
STEP_OF_REFERENCE = 0.02  # a change within one sample time that counts as a step [T_max]
FIRST_SCORED_STEP = 50  # of the observed thrust's RMSE, as of every estimate's


class Policy(Protocol):
    """What acts on observations (n, d), as Stable-Baselines3's models do."""

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Actions (n, 1) in [-1, 1], and what the policy remembers."""


class Part(NamedTuple):
    """Squared thrust errors of episodes, summed over some of their steps."""

    squares: np.ndarray  # (B,) [N^2]
    steps: np.ndarray  # (B,)

    @property
    def rms(self) -> float:
        """Root of the mean square [N], pooled over episodes; NaN if no step counts."""
        steps = self.steps.sum()
        return float(np.sqrt(self.squares.sum() / steps)) if steps else float("nan")


class Scores(NamedTuple):
    """How a policy did in B episodes."""

    returns: np.ndarray  # (B,)
    all: Part  # error of the true thrust against the reference, over all steps
    transient: Part  # the same within TRANSIENT of a step of the reference
    steady: Part  # over the other steps
    reversal: Part  # within TRANSIENT of a change of the reference's sign
    observed: Part  # of the thrust that the policy is shown, against the true one


def score(policy: Policy, setup: Setup, seeds: Sequence[int]) -> Scores:
    """Run a policy, deterministic, for one episode of each seed in the envs of a setup.

    Args:
        policy: learnt or classical.
        setup: of the envs; what is observed has to be what the policy needs.
        seeds: held-out ones.
    """
    steps = gym.spec(setup.env_id).max_episode_steps
    venv = make_environments(setup, seeds, endless=True)
    plant = venv.unwrapped.env.unwrapped.plant
    returns, thrusts, references, shown = run_episodes(policy, venv, steps)
    transient, reversal = _windows(
        references, STEP_OF_REFERENCE * thrust_scale(plant), round(TRANSIENT / plant.dt)
    )
    errors = thrusts - references
    whole = np.ones_like(transient)
    scored = whole & (np.arange(steps) >= FIRST_SCORED_STEP)
    return Scores(
        returns,
        *(_part(errors, chosen) for chosen in (whole, transient, ~transient, reversal)),
        _part(shown - thrusts, scored),
    )


def run_episodes(policy: Policy, venv: VecEnv, steps: int) -> tuple[np.ndarray, ...]:
    """Returns (B,), then true thrusts, references and the thrusts that the policy was shown, all (B, K) [N]."""
    observations, state = venv.reset(), None
    starts = np.ones(venv.num_envs, dtype=bool)
    returns, rows = np.zeros(venv.num_envs), []
    for _ in range(steps):
        actions, state = policy.predict(observations, state, starts, deterministic=True)
        observations, rewards, _, _ = venv.step(actions)
        starts = np.zeros(venv.num_envs, dtype=bool)
        arrays = venv.unwrapped.arrays
        returns += rewards
        rows.append((arrays["thrust"].copy(), arrays["reference"].copy(), observations[:, 0].astype(np.float64)))
    return returns, *np.array(rows).transpose(1, 2, 0)


def _windows(references: np.ndarray, least: float, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Steps (B, K) soon after the reference steps, and soon after its sign changes."""
    before = np.concatenate([np.zeros_like(references[:, :1]), references[:, :-1]], axis=1)
    stepped = np.abs(references - before) > least
    crossed = references * before < 0
    return _soon_after(stepped, length), _soon_after(crossed, length)


def _soon_after(events: np.ndarray, length: int) -> np.ndarray:
    """Whether one of the last `length` steps, this one included, had an event."""
    count = np.cumsum(events, axis=1)
    past = np.pad(count, ((0, 0), (length, 0)))[:, : events.shape[1]]
    return count > past


def _part(errors: np.ndarray, chosen: np.ndarray) -> Part:
    return Part((errors**2 * chosen).sum(axis=1), chosen.sum(axis=1))
