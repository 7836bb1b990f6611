"""An autonomous underwater vehicle; `import thruster_env` registers its envs."""

from thruster_env.auv.env import SegorogeniAUVDepthEnv, SegorogeniAUVEnv, SegorogeniAUVPathEnv
from thruster_env.auv.parameters import PRESETS, VehicleParameters

__all__ = ["PRESETS", "SegorogeniAUVDepthEnv", "SegorogeniAUVEnv", "SegorogeniAUVPathEnv", "VehicleParameters"]
