"""The packages for learning policies, which are not in a plain installation."""

from __future__ import annotations

import importlib.util

from thruster_env.core.modules import to_install

NEEDED = ("torch", "stable_baselines3", "sb3_contrib")


def check_installed() -> None:
    """Raise ValueError, with the command to install it, unless the extra `rl` is installed."""
    for package in NEEDED:
        if importlib.util.find_spec(package) is None:
            raise ValueError(f"policies need {package}, which is not installed: {to_install('rl')}")
