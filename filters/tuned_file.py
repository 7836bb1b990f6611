"""The tuned file as every program reads it: data, checked entry by entry, that can name no code.

One reader for all: what it lets through goes into a filter's arguments, so it knows every key, and every value is
a finite number or made of such.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from filters.registry import FILTERS, tunable_numbers
from numerics.checks import finite, one_of, positive, shown

FILE_FORMAT = "thruster-env tuned filter"
FILE_VERSION = 3  # 3: the plant that it is for, and scenarios of files, as data; 2: no such, still read
READ_VERSIONS = (2, 3)
MODEL_KEYS = ("process_noise_cov", "measurement_noise_cov", "prior_cov_factor", "parameter_factors")
NEEDED = MODEL_KEYS[:2]


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a tuned file with its hash, the SHA-256 of everything else as JSON with sorted keys.

    The hash tells damage and edits by hand; it does not tell who wrote the file.
    """
    rest = {key: value for key, value in content.items() if key != "hash"}
    return {**rest, "hash": hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()}


def read_tuned_file(path: str | Path) -> dict[str, Any]:
    """Content of a tuned file; its "filter" entry holds `name`, `numbers` and the `model` arguments.

    Of `numbers` only the filter's own numbers are known, of `model` only MODEL_KEYS, and all are finite.

    Raises:
        ValueError: if the file cannot be read, is damaged, was edited, was written by a later version, or holds
            what no tuned file has.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"a tuned file must be readable, but {path} is not: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"a tuned file must be whole JSON, but {path} is not: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FILE_FORMAT:
        raise ValueError(f"a tuned file must say format: {FILE_FORMAT!r}, but {path} does not")
    _check_version(path, content.get("version"))
    if content.get("hash") != sealed(content)["hash"]:
        raise ValueError(
            "a tuned file must be as it was written, with the hash of its content, "
            f"but {path} was edited: its hash is {shown(content.get('hash'))}"
        )
    try:
        _check_filter(content.get("filter"))
        if content["version"] > 2:
            for part in ("plant", "scenarios"):
                _mapping(part, content.get(part))
    except ValueError as error:
        raise ValueError(f"{error} (in the tuned file {path})") from None
    return content


def _check_version(path: str | Path, version) -> None:
    if type(version) is int and version in READ_VERSIONS:
        return
    advice = ""
    if isinstance(version, int):
        advice = ": update thruster-env" if version > FILE_VERSION else ": tune again"
    known = " or ".join(map(str, READ_VERSIONS))
    raise ValueError(f"a tuned file must be of version {known}, but {path} is of version {shown(version)}{advice}")


def _check_filter(entry) -> None:
    """Raise ValueError unless an entry names a filter, some of its numbers, and what it assumes, all as data."""
    if not isinstance(entry, dict) or set(entry) != {"name", "numbers", "model"}:
        raise ValueError(f"a tuned file must have a filter with name, numbers and model, but got {shown(entry)}")
    name = one_of("the filter of a tuned file", entry["name"], tuple(FILTERS))
    known = tunable_numbers(name)
    for key, value in _mapping("numbers", entry["numbers"]).items():
        one_of(f"a number of filter {name!r}", key, known)
        _check_finite(key, value)
    model = _mapping("model", entry["model"])
    for key in model:
        one_of("an argument of the model of a tuned file", key, MODEL_KEYS)
    for key in NEEDED:
        if model.get(key) is None:
            raise ValueError(f"the model of a tuned file must have a {key}, but got {shown(model)}")
        _check_finite(key, model[key])
    if "prior_cov_factor" in model:
        _check_finite("prior_cov_factor", model["prior_cov_factor"])
        positive("prior_cov_factor", model["prior_cov_factor"])
    for key, value in _mapping("parameter_factors", model.get("parameter_factors", {})).items():
        _check_finite(f"parameter_factors, {key}", value)
        positive(f"parameter_factors, {key}", value)


def _check_finite(name: str, value) -> None:
    """Raise ValueError unless a value is a finite number, or a list (of lists) of such; true and text are none."""
    rows = value if isinstance(value, list) and value else [value]
    for part in (part for row in rows for part in (row if isinstance(row, list) and row else [row])):
        if isinstance(part, bool) or not isinstance(part, int | float):
            raise ValueError(f"{name} must be made of finite numbers, but got {shown(value)}")
        finite(name, part)


def _mapping(part: str, value) -> dict:
    if not isinstance(value, dict):
        raise ValueError(f"the {part} of a tuned file must be a mapping, but got {shown(value)}")
    return value
