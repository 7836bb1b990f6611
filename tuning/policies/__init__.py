"""Policies on raw, filtered and true state. Needs the extra `rl`; importing this package alone does not.

`NativeVecEnv` is what Stable-Baselines3 takes: a vector env of this package, all copies stepped in one call.

Learned and classical policies share `predict`, run on the same envs and are scored by the same code (`score`).
Controllers plan with the plant's own code (`thruster_env.thruster.planning`), so their cost cannot drift
from the reward. A policy may correct a controller: a wrapper of VecEnvs adds the two actions. Views of the state
are wrappers of VecEnvs (`views`), which serve native and single envs alike. Infos are empty but at the end of an
episode: a dictionary a copy and step costs more than the plant. Torch is set up for small networks
(`torch_settings`): fused optimizers and minibatches as views take a step from 36 to 28 us and change rounding
alone. A setup is plain data beside each saved network, with the numbers of its tuned file and not its path.
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
