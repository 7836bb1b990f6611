"""The vector envs: all copies advanced by one compiled call, noise included."""

from __future__ import annotations

from typing import ClassVar

from thruster_env.auv.env import SegorogeniAUVEnv
from thruster_env.auv.modelled import ModelledVehicle
from thruster_env.auv.tasks import SegorogeniAUVDepthEnv, SegorogeniAUVPathEnv
from thruster_env.env.vector_env import PlantVectorEnv


class SegorogeniAUVVectorEnv(ModelledVehicle, PlantVectorEnv):
    """Vector env of `SegorogeniAUV-v0`; see `PlantVectorEnv`.

    `num_envs`, `max_episode_steps` and `autoreset_mode` are those of `PlantVectorEnv`, the others those of the
    single env.
    """

    single_env: ClassVar[type[SegorogeniAUVEnv]] = SegorogeniAUVEnv


class SegorogeniAUVPathVectorEnv(SegorogeniAUVVectorEnv):
    """Vector env of `SegorogeniAUVPath-v0`."""

    single_env = SegorogeniAUVPathEnv


class SegorogeniAUVDepthVectorEnv(SegorogeniAUVVectorEnv):
    """Vector env of `SegorogeniAUVDepth-v0`."""

    single_env = SegorogeniAUVDepthEnv
