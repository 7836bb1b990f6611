"""The packages that learning policies takes, which a plain install leaves out."""

from __future__ import annotations

import importlib.util

NEEDED = ("torch", "stable_baselines3", "sb3_contrib")


def check_installed() -> None:
    """Raise ValueError, with the command that helps, unless the extra `rl` is installed."""
    for package in NEEDED:
        if importlib.util.find_spec(package) is None:
            raise ValueError(f"policies need {package}, which is not installed: pip install 'thruster-env[rl]'")
