"""Estimators with a network in them, trained on runs whose states are known; this needs torch and safetensors.

estimator   what all have in common, and a model's equations over whole steps, on batches of tensors
filters     `kalmannet`, `recursive-kalmannet`, which learn a gain; `differentiable-enkf`, which learns its noise;
            and their files

`tuning.train_estimator` and `thruster train-estimator` train them.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from thruster_env.core.modules import to_install

if TYPE_CHECKING:
    from filters.learned.filters import TrainedEstimator

NEEDED = ("torch", "safetensors")


def check_installed() -> None:
    """Raise ValueError unless what learned estimators need is installed."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        rule = f"a learned estimator needs {' and '.join(missing)}"
        raise ValueError(f"{rule}, but got none: {to_install('learned')}")


def check_file(path: str | Path) -> None:
    """Raise ValueError if there is no file, before torch is imported."""
    if not Path(path).is_file():
        raise ValueError(f"a trained estimator must be a file, but there is none at {path}")


def read_estimator(path: str | Path) -> TrainedEstimator:
    """The trained estimator of a file, which makes an estimator for a model.

    Raises:
        ValueError: if there is no file, torch or safetensors is not installed, or the file is none of `thruster
            train-estimator`.
    """
    check_file(path)
    check_installed()
    from filters.learned.filters import read  # torch takes seconds to import

    return read(path)
