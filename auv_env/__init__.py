"""An autonomous underwater vehicle as Gymnasium environments; importing this package registers them."""

from gymnasium.envs.registration import register, registry

from auv_env.env import SegorogeniAUVEnv
from auv_env.parameters import VehicleParameters
from auv_env.presets import PRESETS
from auv_env.tasks import SegorogeniAUVDepthEnv, SegorogeniAUVPathEnv
from thruster_env.numerics.compiled import may_be_inlined

may_be_inlined(__name__, "thruster_env.plants")

__all__ = ["PRESETS", "SegorogeniAUVDepthEnv", "SegorogeniAUVEnv", "SegorogeniAUVPathEnv", "VehicleParameters"]

# Steps, and the mean return of PD on measurements over 100 held-out episodes; without a task nobody sees a path.
for _task, _steps, _threshold in (("", 1200, None), ("Path", 600, -17.6), ("Depth", 1200, -694.0)):
    if f"SegorogeniAUV{_task}-v0" not in registry:
        register(
            id=f"SegorogeniAUV{_task}-v0",
            entry_point=f"auv_env.{'tasks' if _task else 'env'}:SegorogeniAUV{_task}Env",
            vector_entry_point=f"auv_env.vector_env:SegorogeniAUV{_task}VectorEnv",
            max_episode_steps=_steps,
            reward_threshold=_threshold,
        )
