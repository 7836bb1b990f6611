"""A ship's bow thruster as a Gymnasium environment; importing this package registers `BowThruster-v0`."""

from gymnasium.envs.registration import register, registry

from thruster_env.env import BowThrusterEnv
from thruster_env.parameters import PRESETS, ThrusterParameters

__version__ = "0.1.0"
__all__ = ["PRESETS", "BowThrusterEnv", "ThrusterParameters", "__version__"]

if "BowThruster-v0" not in registry:
    register(id="BowThruster-v0", entry_point="thruster_env.env:BowThrusterEnv", max_episode_steps=500)
