"""Versions of the packages that numerical results depend on."""

from __future__ import annotations

import importlib.metadata

PACKAGES = ("thruster-env", "optuna", "numpy", "numba", "gymnasium")


def versions() -> dict[str, str]:
    """Installed versions of the packages that a tuned file depends on."""
    return {name: _version(name) for name in PACKAGES}


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
