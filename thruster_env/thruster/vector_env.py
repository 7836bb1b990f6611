"""The vector envs: all copies advanced by one compiled call, noise included."""

from __future__ import annotations

from typing import ClassVar

from thruster_env.env.vector_env import PlantVectorEnv
from thruster_env.thruster.env import BowThrusterEnv
from thruster_env.thruster.modelled import ModelledThruster
from thruster_env.thruster.tasks import BowThrusterLinearEnv, BowThrusterReversalEnv, BowThrusterTrackingEnv


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
