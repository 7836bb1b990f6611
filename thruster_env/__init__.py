"""A ship's bow thruster as Gymnasium environments; importing this package registers them."""

from gymnasium.envs.registration import register, registry

from thruster_env.env import BowThrusterEnv
from thruster_env.numerics.compiled import may_be_inlined
from thruster_env.old_names import keep_old_names
from thruster_env.parameters import PRESETS, ThrusterParameters
from thruster_env.tasks import BowThrusterLinearEnv, BowThrusterReversalEnv, BowThrusterTrackingEnv

keep_old_names()
may_be_inlined(__name__, "thruster_env.plants")

__version__ = "0.1.0"
__all__ = [
    "PRESETS",
    "BowThrusterEnv",
    "BowThrusterLinearEnv",
    "BowThrusterReversalEnv",
    "BowThrusterTrackingEnv",
    "ThrusterParameters",
    "__version__",
]

for _task in ("", "Tracking", "Reversal", "Linear"):
    if f"BowThruster{_task}-v0" not in registry:
        register(
            id=f"BowThruster{_task}-v0",
            entry_point=f"thruster_env.{'tasks' if _task else 'env'}:BowThruster{_task}Env",
            vector_entry_point=f"thruster_env.vector_env:BowThruster{_task}VectorEnv",
            max_episode_steps=500,
        )
