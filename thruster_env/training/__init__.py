"""Policies on raw, filtered and true state. Needs the extra `rl`; importing this package alone does not.

`NativeVecEnv` is what Stable-Baselines3 takes: a vector env of this package, all copies stepped in one call.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thruster_env.training.vec_env import NativeVecEnv

__all__ = ["NativeVecEnv"]


def __getattr__(name: str) -> Any:
    """`NativeVecEnv`, which imports Stable-Baselines3 and torch; ValueError unless they are installed."""
    if name in __all__:
        from thruster_env.training.extras import check_installed

        check_installed()
        return getattr(import_module("thruster_env.training.vec_env"), name)
    raise AttributeError(f"module 'thruster_env.training' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Public names, whether or not they are imported yet."""
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
