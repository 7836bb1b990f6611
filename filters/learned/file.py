"""Trained estimators as files: numbers and their description, in the format safetensors.

Nothing in a file names code to run.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

from filters.learned import check_file
from filters.learned.estimator import LearnedEstimator
from filters.learned.filters import DifferentiableEnsembleFilter, GatedRecurrentUnit, KalmanNet, RecursiveKalmanNet
from thruster_env.core.checks import one_of
from thruster_env.core.files import write_whole
from thruster_env.model.state_space import StateSpaceModel

LEARNED = {
    kind.kind: kind for kind in (KalmanNet, RecursiveKalmanNet, GatedRecurrentUnit, DifferentiableEnsembleFilter)
}
FORMAT = 1
MOST_NAMED = 5  # differing constants in an error
DESCRIPTION = "estimator"  # the entry of a file's metadata that describes it


class TrainedEstimator:
    """A trained estimator as it lies in a file; called with a model it makes the estimator.

    Attributes:
        path: of the file.
        name: of the estimator, such as "kalmannet".
        about: what the file says: `kind`, `options`, `model` (a digest of its equations), `sizes`, `quantities`
            (names and units, which older files lack), `training`.
    """

    def __init__(self, path: str | Path):
        from safetensors import SafetensorError, safe_open

        self.path = str(path)
        try:
            with safe_open(self.path, framework="pt") as file:
                self.about = json.loads((file.metadata() or {})[DESCRIPTION])
                self._numbers = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
            wrong = [name for name, tensor in self._numbers.items() if not tensor.isfinite().all()]
            if wrong:
                raise ValueError(f"{', '.join(wrong)} must be finite, but have NaN or infinity")
            if self.about["format"] != FORMAT:
                raise ValueError(f"its format is not {FORMAT}")
            kind, self._options = str(self.about["kind"]), dict(self.about["options"])
            self._digest, self._quantities = self.about["model"], self.about.get("quantities")
            self.training = dict(self.about.get("training") or {})
            constants = dict(self.about.get("constants") or {})  # older files have none
            self._constants = {str(key): float(value) for key, value in constants.items()}
            if self._quantities is not None:
                self._quantities = [
                    [tuple(map(str, quantity)) for quantity in entries] for entries in self._quantities
                ]
        except (SafetensorError, KeyError, TypeError, ValueError, AttributeError) as error:
            rule = "an estimator's file must be one of `thruster train-estimator`"
            raise ValueError(f"{rule}, but {self.path} is not: {error}") from None
        self.name = one_of("a trained estimator", kind, tuple(LEARNED))

    def __call__(self, model: StateSpaceModel) -> LearnedEstimator:
        """The estimator for a model; ValueError for another model than that of the training."""
        kind = LEARNED[self.name]
        self._check(model, kind.needs_model)
        estimator = kind(model, **self._options)
        try:
            estimator.load_state_dict(self._numbers)
        except RuntimeError as error:
            reason = "; ".join(line.strip() for line in str(error).splitlines()[1:]) or str(error)
            raise ValueError(f"{self.path} must have the numbers of a {self.name}, but: {reason}") from None
        return estimator

    def _check(self, model: StateSpaceModel, needs_model: bool) -> None:
        """Raise ValueError for another model; without a model's equations for other names and units of quantities.

        Default names, such as x_1 without a unit, or missing names do not identify a plant: then the equations
        must agree.
        """
        quantities = quantities_of(model)
        if model.digest == self._digest:
            return
        if not needs_model and quantities == self._quantities and not _are_unnamed(model):
            return
        rule = f"{self.path} must be used with the model that it was trained with"
        if self._quantities is not None and quantities != self._quantities:
            both = zip(self._quantities, quantities, strict=True)
            expected, actual = next((_listed(stored), _listed(other)) for stored, other in both if stored != other)
            raise ValueError(f"{rule}, {expected}, but got {actual}")
        then, now = self._constants, constants_of(model)
        differing = [
            f"{name} {then[name]:.4g} (here {value:.4g})"
            for name, value in now.items()
            if name in then and then[name] != value
        ]
        more = len(differing) - MOST_NAMED
        differing = differing[:MOST_NAMED] + ([f"{more} more"] if more > 0 else [])
        problem = self.training.get("problem")
        of_problem = "" if problem is None else f", that of {problem}"
        raise ValueError(f"{rule}{of_problem}, but that had {', '.join(differing) or 'other equations'}")


def quantities_of(model: StateSpaceModel) -> list[list[tuple[str, str]]]:
    """Symbols and units of states, inputs and measurements."""
    return [[(quantity.symbol, quantity.unit) for quantity in quantities] for quantities in model.quantities]


def constants_of(model: StateSpaceModel) -> dict[str, float]:
    """The named constants of a model that are numbers, which tell one preset from another."""
    named: dict = getattr(model.constants, "_asdict", dict)()
    return {name: float(constant) for name, constant in named.items() if isinstance(constant, int | float)}


def _are_unnamed(model: StateSpaceModel) -> bool:
    """Whether all quantities have the symbols that they get of themselves, and no unit."""
    pairs = zip("xuz", model.quantities, strict=True)
    return quantities_of(model) == [
        [(f"{letter}_{i + 1}", "") for i in range(len(quantities))] for letter, quantities in pairs
    ]


def _listed(quantities: list[tuple[str, str]]) -> str:
    return ", ".join(f"{symbol} [{unit}]" if unit else symbol for symbol, unit in quantities) or "none"


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
        "quantities": quantities_of(estimator.model),
        "constants": constants_of(estimator.model),
        "training": training,
    }
    numbers = {name: tensor.contiguous() for name, tensor in estimator.state_dict().items()}
    write_whole(path, save(numbers, {DESCRIPTION: json.dumps(about)}))


@lru_cache(maxsize=32)
def _read(path: str, changed: int) -> TrainedEstimator:
    return TrainedEstimator(path)


def read(path: str | Path) -> TrainedEstimator:
    """The trained estimator of a file; read again only after a change."""
    check_file(path)
    return _read(str(path), Path(path).stat().st_mtime_ns)
