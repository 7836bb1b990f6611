"""Policies on raw, filtered and true state. Needs the extra `rl`; importing this package alone does not.

Stable-Baselines3 takes a `NativeVecEnv`: a vector env of this package, all copies stepped in one call. Wrappers of
VecEnvs add the views of the state and the corrections of a controller, so they serve native and single envs alike.
Learnt and classical policies share `predict`, run on the same envs and are scored by the same code (`score`).
Controllers plan with the plant's own code (`thruster_env.thruster.controllers`): their cost is the reward's.

Infos are empty except at the end of an episode: a dictionary per copy and step costs more than the plant. Torch is
set up for small networks (`learn`): fused optimizers and minibatches as views take a step from 36 to 28 us and
change only rounding. A configuration is plain data beside each saved network, with the numbers of its tuned file
and not its path.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tuning.policies.environments import NativeVecEnv

__all__ = ["NativeVecEnv"]


def __getattr__(name: str) -> Any:
    """`NativeVecEnv`, which imports Stable-Baselines3 and torch; ValueError unless they are installed."""
    if name in __all__:
        from tuning.policies.algorithms import check_installed

        check_installed()
        return getattr(import_module("tuning.policies.environments"), name)
    raise AttributeError(f"module 'tuning.policies' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Public names, whether or not they are imported yet."""
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
