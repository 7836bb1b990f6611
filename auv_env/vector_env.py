"""The envs in number: all copies advanced by one compiled call, noise included."""

from __future__ import annotations

from auv_env.env import SegorogeniAUVEnv
from auv_env.modelled import ModelledVehicle
from auv_env.tasks import SegorogeniAUVDepthEnv, SegorogeniAUVPathEnv
from plants.vector_env import PlantVectorEnv


class SegorogeniAUVVectorEnv(ModelledVehicle, PlantVectorEnv):
    """`SegorogeniAUV-v0` in number; see `PlantVectorEnv`.

    `num_envs`, `max_episode_steps` and `autoreset_mode` are those of `PlantVectorEnv`, the others those of the
    single env.
    """

    single_env: type[SegorogeniAUVEnv] = SegorogeniAUVEnv


class SegorogeniAUVPathVectorEnv(SegorogeniAUVVectorEnv):
    """`SegorogeniAUVPath-v0` in number."""

    single_env = SegorogeniAUVPathEnv


class SegorogeniAUVDepthVectorEnv(SegorogeniAUVVectorEnv):
    """`SegorogeniAUVDepth-v0` in number."""

    single_env = SegorogeniAUVDepthEnv
