"""A bow thruster and an underwater vehicle as Gymnasium environments; importing this package registers them."""

from importlib import import_module
from typing import TYPE_CHECKING

from thruster_env.core.modules import when_imported

if TYPE_CHECKING:
    from thruster_env.thruster.env import (
        BowThrusterEnv,
        BowThrusterLinearEnv,
        BowThrusterReversalEnv,
        BowThrusterTrackingEnv,
    )
    from thruster_env.thruster.parameters import PRESETS, ThrusterParameters


__version__ = "0.2.0"
__all__ = [
    "PRESETS",
    "BowThrusterEnv",
    "BowThrusterLinearEnv",
    "BowThrusterReversalEnv",
    "BowThrusterTrackingEnv",
    "ThrusterParameters",
    "__version__",
]


def __getattr__(name: str):
    """The thruster's envs, which import Gymnasium, and its presets, when they are first asked for."""
    if name in __all__:
        module = "env" if name.endswith("Env") else "parameters"
        return getattr(import_module(f"thruster_env.thruster.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _register(env_id: str, package: str, name: str, **options) -> None:
    from gymnasium.envs.registration import register, registry

    if env_id not in registry:
        register(
            id=env_id,
            entry_point=f"thruster_env.{package}.env:{name}Env",
            vector_entry_point=f"thruster_env.{package}.env:{name}VectorEnv",
            **options,
        )


def _register_all() -> None:
    from gymnasium.envs.registration import register, registry

    for task in ("", "Tracking", "Reversal", "Linear"):
        _register(f"BowThruster{task}-v0", "thruster", f"BowThruster{task}", max_episode_steps=500)
    # Steps, and the mean return of PD on measurements over 100 held-out episodes; without a task there is none.
    for task, steps, threshold in (("", 1200, None), ("Path", 600, -17.6), ("Depth", 1200, -694.0)):
        _register(
            *(f"SegorogeniAUV{task}-v0", "auv", f"SegorogeniAUV{task}"),
            max_episode_steps=steps,
            reward_threshold=threshold,
        )
    if "Replay-v0" not in registry:
        register(id="Replay-v0", entry_point="thruster_env.env.model_env:ReplayEnv")


when_imported("gymnasium", _register_all)
