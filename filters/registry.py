"""Filters by name, and the file format that carries a filter's numbers from one program to the next."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from filters.adaptive.robust import RobustExtendedKalmanFilter
from filters.adaptive.sage_husa import SageHusaFilter
from filters.adaptive.variational import VariationalBayesFilter
from filters.baselines import Inversion, LowPass, OpenLoop
from filters.ensembles.deterministic import DeterministicEnsembleKalmanFilter
from filters.ensembles.ensemble import EnsembleKalmanFilter
from filters.ensembles.iterated import IteratedEnsembleKalmanFilter
from filters.ensembles.serial import SerialSquareRootFilter
from filters.ensembles.transform import EnsembleTransformFilter
from filters.filter import Filter
from filters.gaussian.cubature import CubatureKalmanFilter
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.gaussian.fuzzy import FuzzyKalmanFilter
from filters.gaussian.gaussian_sum import GaussianSumFilter
from filters.gaussian.iterated import IteratedExtendedKalmanFilter
from filters.gaussian.kalman import KalmanFilter
from filters.gaussian.steady_state import SteadyStateKalmanFilter
from filters.gaussian.unscented import UnscentedKalmanFilter
from filters.model import StateSpaceModel
from filters.particles.auxiliary import AuxiliaryParticleFilter
from filters.particles.particle import ParticleFilter
from thruster_env.checks import one_of, shown

FILTERS: dict[str, type[Filter]] = {
    kind.name: kind
    for kind in (
        KalmanFilter,
        SteadyStateKalmanFilter,
        ExtendedKalmanFilter,
        IteratedExtendedKalmanFilter,
        UnscentedKalmanFilter,
        CubatureKalmanFilter,
        EnsembleKalmanFilter,
        EnsembleTransformFilter,
        SerialSquareRootFilter,
        DeterministicEnsembleKalmanFilter,
        IteratedEnsembleKalmanFilter,
        ParticleFilter,
        AuxiliaryParticleFilter,
        GaussianSumFilter,
        FuzzyKalmanFilter,
        SageHusaFilter,
        VariationalBayesFilter,
        RobustExtendedKalmanFilter,
        OpenLoop,
        LowPass,
        Inversion,
    )
}
FILE_FORMAT = "thruster-env tuned filter"
FILE_VERSION = 2  # 2: held-out metrics by scenario, the study's whole plan, a hash


def filter_class(name: str) -> type[Filter]:
    """The class of a filter by name; ValueError for an unknown one."""
    return FILTERS[one_of("filter", name, tuple(FILTERS))]


def tunable_numbers(name: str) -> tuple[str, ...]:
    """Names of the numbers that a filter has beside its model."""
    return tuple(field.name for field in dataclasses.fields(filter_class(name)) if field.name != "model")


def make_filter(name: str, model: StateSpaceModel, **numbers) -> Filter:
    """A filter by name, for a model, with its own numbers; ValueError for an unknown name or number."""
    known = tunable_numbers(name)
    for number in numbers:
        one_of(f"a number of filter {name!r}", number, known)
    return filter_class(name)(model=model, **numbers)


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a tuned file with its hash, the SHA-256 of everything else as JSON with sorted keys."""
    rest = {key: value for key, value in content.items() if key != "hash"}
    return {**rest, "hash": hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()}


def read_tuned_file(path: str | Path) -> dict[str, Any]:
    """Content of a tuned file; its "filter" entry holds `name`, `numbers` and the `model` arguments.

    Raises:
        ValueError: if the file cannot be read, is damaged, was edited or was written by another version.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"a tuned file must be readable, but {path} is not: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"a tuned file must be whole JSON, but {path} is not: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FILE_FORMAT:
        raise ValueError(f"a tuned file must say format: {FILE_FORMAT!r}, but {path} does not")
    _check_version(path, content.get("version"))
    if content.get("hash") != sealed(content)["hash"]:
        raise ValueError(
            "a tuned file must be as it was written, with the hash of its content, "
            f"but {path} was edited: its hash is {shown(content.get('hash'))}"
        )
    entry = content.get("filter")
    if not isinstance(entry, dict) or set(entry) != {"name", "numbers", "model"}:
        raise ValueError(f"a tuned file must have a filter with name, numbers and model, but {path} has not")
    for part in ("numbers", "model"):
        if not isinstance(entry[part], dict):
            raise ValueError(f"the {part} of a tuned file must be a mapping, but {path} has {shown(entry[part])}")
    for name in ("process_noise_cov", "measurement_noise_cov"):
        if entry["model"].get(name) is None:
            raise ValueError(f"the model of a tuned file must have a {name}, but {path} has none")
    one_of("the filter of a tuned file", entry["name"], tuple(FILTERS))
    return content


def _check_version(path: str | Path, version) -> None:
    if version == FILE_VERSION:
        return
    advice = ""
    if isinstance(version, int):
        advice = ": update thruster-env" if version > FILE_VERSION else ": tune again"
    raise ValueError(
        f"a tuned file must be of version {FILE_VERSION}, but {path} is of version {shown(version)}{advice}"
    )
