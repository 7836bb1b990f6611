"""An autonomous underwater vehicle; `import thruster_env` registers its envs."""

from thruster_env.auv.env import SegorogeniAUVEnv
from thruster_env.auv.parameters import VehicleParameters
from thruster_env.auv.presets import PRESETS
from thruster_env.auv.tasks import SegorogeniAUVDepthEnv, SegorogeniAUVPathEnv

__all__ = ["PRESETS", "SegorogeniAUVDepthEnv", "SegorogeniAUVEnv", "SegorogeniAUVPathEnv", "VehicleParameters"]
