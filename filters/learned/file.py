"""Trained estimators as files: numbers and their description, in the format safetensors.

Nothing in a file names code to run.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

from filters.learned.ensemble import DifferentiableEnsembleFilter
from filters.learned.estimator import LearnedEstimator
from filters.learned.gains import KalmanNet, RecursiveKalmanNet
from filters.learned.recurrent import GatedRecurrentUnit
from thruster_env.numerics.checks import one_of
from thruster_env.numerics.files import write_whole
from thruster_env.plants.state_space import StateSpaceModel

LEARNED = {
    one.kind: one for one in (KalmanNet, RecursiveKalmanNet, GatedRecurrentUnit, DifferentiableEnsembleFilter)
}
FORMAT = 1
DESCRIPTION = "estimator"  # the entry of a file's metadata that describes it


class TrainedEstimator:
    """A trained estimator as it lies in a file; called with a model it makes the estimator.

    Attributes:
        path: of the file.
        name: of the estimator, such as "kalmannet".
        about: what the file says: `kind`, `options`, `model` (a digest of its equations), `sizes`, `training`.
    """

    def __init__(self, path: str | Path):
        """Read a file; ValueError if it is not one of a trained estimator."""
        from safetensors import SafetensorError, safe_open

        self.path = str(path)
        try:
            with safe_open(self.path, framework="pt") as file:
                self.about = json.loads((file.metadata() or {})[DESCRIPTION])
                self._numbers = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
            if self.about["format"] != FORMAT:
                raise ValueError(f"its format is not {FORMAT}")
            kind, self._options = str(self.about["kind"]), dict(self.about["options"])
            self._made_for = {True: self.about["model"], False: self.about["sizes"]}
        except (SafetensorError, KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"an estimator's file must be one of `thruster train-estimator`, but {self.path} is not: {error}"
            ) from None
        self.name = one_of("a trained estimator", kind, tuple(LEARNED))

    def __call__(self, model: StateSpaceModel) -> LearnedEstimator:
        """The estimator for a model; ValueError for another model than that of the training."""
        kind = LEARNED[self.name]
        own, found = self._made_for[kind.needs_model], model.digest if kind.needs_model else sizes_of(model)
        if own != found:
            raise ValueError(
                f"{self.path} must be used with the model that it was trained with, {own}, but got {found}"
            )
        made = kind(model, **self._options)
        try:
            made.load_state_dict(self._numbers)
        except RuntimeError as error:
            raise ValueError(f"{self.path} must have the numbers of a {self.name}, but: {error}") from None
        return made


def sizes_of(model: StateSpaceModel) -> list[int]:
    """Numbers of states, inputs and measurements."""
    return [model.n, model.inputs, model.m]


def write_estimator(path: str | Path, estimator: LearnedEstimator, training: dict[str, Any]) -> None:
    """Write a trained estimator to a file, whole or not at all.

    Args:
        path: of the file, which ends in .safetensors.
        estimator: the estimator.
        training: what is to be known of its training, as data for JSON.
    """
    from safetensors.torch import save

    about = {
        "format": FORMAT,
        "kind": estimator.kind,
        "options": estimator.chosen,
        "model": estimator.model.digest,
        "sizes": sizes_of(estimator.model),
        "training": training,
    }
    numbers = {name: one.contiguous() for name, one in estimator.state_dict().items()}
    write_whole(path, save(numbers, {DESCRIPTION: json.dumps(about)}))


@lru_cache(maxsize=32)
def _read(path: str, changed: int) -> TrainedEstimator:
    return TrainedEstimator(path)


def read(path: str | Path) -> TrainedEstimator:
    """The trained estimator of a file; read again only after a change."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"a trained estimator must be a file, but there is none at {path}")
    return _read(str(path), path.stat().st_mtime_ns)
