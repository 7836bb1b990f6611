"""The envs in number: all copies advanced by one compiled call, noise included."""

from __future__ import annotations

from plants.vector_env import PlantVectorEnv
from thruster_env.env import BowThrusterEnv
from thruster_env.modelled import ModelledThruster
from thruster_env.tasks import BowThrusterLinearEnv, BowThrusterReversalEnv, BowThrusterTrackingEnv


class BowThrusterVectorEnv(ModelledThruster, PlantVectorEnv):
    """`BowThruster-v0` in number; see `PlantVectorEnv`. Uncertain parameters are drawn for each copy and episode.

    `num_envs`, `max_episode_steps` and `autoreset_mode` are those of `PlantVectorEnv`, the others those of the
    single env.
    """

    single_env: type[BowThrusterEnv] = BowThrusterEnv


class BowThrusterTrackingVectorEnv(BowThrusterVectorEnv):
    """`BowThrusterTracking-v0` in number."""

    single_env = BowThrusterTrackingEnv


class BowThrusterReversalVectorEnv(BowThrusterVectorEnv):
    """`BowThrusterReversal-v0` in number."""

    single_env = BowThrusterReversalEnv


class BowThrusterLinearVectorEnv(BowThrusterVectorEnv):
    """`BowThrusterLinear-v0` in number."""

    single_env = BowThrusterLinearEnv
