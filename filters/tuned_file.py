"""Tuned files: a filter's parameters with the model that they were tuned for.

One reader serves all callers. Its values become arguments of filters, so it accepts known keys only, with finite
numbers or lists of these.
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filters.registry import FILTERS, LISTED, filter_type
from thruster_env.core.checks import finite, one_of, positive, short_repr
from thruster_env.logs.log import of_one_step
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel

VECTORS = {"states": "states", "inputs": "input_quantities", "measurements": "measurements"}
KEYS = ("digest", "dt", *VECTORS)
FILE_FORMAT = "tuned filter"
OLD_FORMAT = "thruster-env tuned filter"  # of versions 2 and 3
FILE_VERSION = (
    4  # 4: any problem, and its model as data; 3: the plant, and scenarios of files, as data; 2: no such
)
READ_VERSIONS = (2, 3, 4)
NOISE = ("process_noise_cov", "measurement_noise_cov")
PRIOR = "prior_cov_factor"  # on P_0
FACTORS = "parameter_factors"  # a mapping of names to factors
STATES = "states"  # which of its states a model has, by a name that the plant knows
AUGMENTED = "augmented_constants"  # a mapping of constants that are states to [std, walk, mean]
OPTION_NAMES = {"sensors": "sensor", "columns": "column", "clock_offset": "clock-offset", "held_out": "held-out"}
MODEL_KEYS = (*NOISE, PRIOR, FACTORS, STATES, AUGMENTED)  # what every plant with data of its own knows


def model_data(model: StateSpaceModel, dt: float | None) -> dict:
    """A model's digest, sample time [s] and quantities, as JSON can hold them; of any steps, of one of dt."""
    model = of_one_step(model)
    named = {key: [list(quantity) for quantity in getattr(model, name)] for key, name in VECTORS.items()}
    return {"digest": model.digest, "dt": dt, **named}


def check_same_quantities(tuned_for: Mapping, model: StateSpaceModel, dt: float | None, file: str | Path) -> None:
    """Raise ValueError, with what differs, unless a model has the states, inputs, sensors and dt of a tuned file.

    Args:
        tuned_for: the file's `model_data`.
        model: on which it is to be used.
        dt: its sample time [s]; None if unknown, which is not compared.
        file: its path.
    """
    here = model_data(model, dt)
    differing = [
        f"{key} {_listed(tuned_for[key])} (here {_listed(here[key])})"
        for key in VECTORS
        if [q[1:] for q in tuned_for[key]] != [q[1:] for q in here[key]]  # symbols may differ
    ]
    then = tuned_for["dt"]
    if then is not None and dt is not None and abs(then - dt) > 1e-9 * then:
        differing.append(f"dt {then:g} (here {dt:g})")
    if differing:
        rule = "a tuned file must be for the model it is used with"
        raise ValueError(f"{rule}, but {file} was tuned for {', '.join(differing)}")


def check_model_data(data) -> None:
    """Raise ValueError unless data are such as `model_data` makes."""
    sound = isinstance(data, dict) and set(data) == set(KEYS) and isinstance(data["digest"], str)
    sound = sound and (data["dt"] is None or (isinstance(data["dt"], float | int) and data["dt"] > 0))
    if not sound or not all(isinstance(data[key], list) and all(map(_is_quantity, data[key])) for key in VECTORS):
        raise ValueError(f"the model of a tuned file must have {', '.join(KEYS)}, but got {short_repr(data)}")


def _is_quantity(entry) -> bool:
    return isinstance(entry, list) and [type(part) for part in entry] == [str, str, str, bool]


def _listed(entries: list) -> str:
    quantities = [Quantity(*entry) for entry in entries]
    return ", ".join(f"{q.symbol} [{q.unit}]" if q.unit else q.symbol for q in quantities) or "none"


OPTION_NAMES |= {"grid": "no-grid", "hold_gaps": "hold-gaps"}


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a tuned file with its hash, the SHA-256 of everything else as JSON with sorted keys.

    The hash detects damage and edits by hand; it does not show who wrote the file.
    """
    rest = {key: value for key, value in content.items() if key != "hash"}
    return {**rest, "hash": hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()}


def read_tuned_file(path: str | Path) -> dict[str, Any]:
    """Content of a tuned file; its "filter" entry holds `name`, `numbers` and the `model` arguments.

    Of `numbers` only the filter's own numbers are known, and of `model` only MODEL_KEYS where the file is for a
    plant that it holds as data; of others it holds what their model takes. All are finite, Q and R among them.
    In every version "problem" names the problem it was tuned on, and "problems" holds problems as data.

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
    if not isinstance(content, dict) or content.get("format") not in (FILE_FORMAT, OLD_FORMAT):
        raise ValueError(f"a tuned file must say format: {FILE_FORMAT!r}, but {path} does not")
    _check_version(path, content.get("version"))
    if content.get("hash") != sealed(content)["hash"]:
        rule = "a tuned file must be unchanged, with the hash of its content"
        raise ValueError(f"{rule}, but {path} was edited: its hash is {short_repr(content.get('hash'))}")
    try:
        content = _upgraded(content)
        of_a_plant = content["version"] < FILE_VERSION or content.get("plant") is not None
        _check_filter(content.get("filter"), known=MODEL_KEYS if of_a_plant else None)
    except ValueError as error:
        raise ValueError(f"{error} (in the tuned file {path})") from None
    return content


def tune_options(content: Mapping[str, Any]) -> dict[str, Any]:
    """What named the problem when a tuned file was made: `log` and how logs were read, or `problem`; `preset`."""
    entry = content["problems"].get(content["problem"])
    stored = entry.get("content") if isinstance(entry, dict) else None
    if isinstance(stored, dict) and isinstance(stored.get("of"), dict):  # that of an augmented problem
        stored = stored["of"].get("content")
    name, *constants = re.split(r"\+(?=[A-Za-z_])", str(content["problem"]))
    augment = {"augment": constants} if constants else {}
    if isinstance(stored, dict) and isinstance(stored.get("logs"), list):
        logs = [log.get("file") for log in stored["logs"] if isinstance(log, dict)]
        return {"log": logs, **(stored["options"] if isinstance(stored.get("options"), dict) else {}), **augment}
    scenario, bracket, preset = name.removesuffix(")").partition(" (")
    return {"problem": scenario, **({"preset": preset} if bracket else {}), **augment}


def made_with(content: Mapping[str, Any]) -> str:
    """The same as options of `thruster tune`, such as "--log run1.csv --preset mine.toml"."""
    parts = []
    for key, value in tune_options(content).items():
        option = f"--{OPTION_NAMES.get(key, key)}"
        if isinstance(value, bool):  # only what is not the default is stored
            parts.append(option)
        else:
            parts += [
                f"{option} {shlex.quote(str(entry))}" for entry in (value if isinstance(value, list) else [value])
            ]
    return " ".join(parts)


def check_preset_file(options: Mapping[str, Any], user_preset: Any, path: str | Path) -> None:
    """Raise ValueError if a tuned file names a preset file that does not exist, and the caller passes no other.

    Args:
        options: from `tune_options`.
        user_preset: the preset that the caller passes, or None.
        path: of the tuned file.
    """
    preset = options.get("preset")
    if user_preset is None and isinstance(preset, str) and preset.endswith(".toml") and not Path(preset).is_file():
        rule = f"the preset of {path} must be where it was"
        raise ValueError(f"{rule}, but there is no file {preset}: say where it is now (--preset FILE)")


@contextmanager
def compared(content: Mapping[str, Any], path: str | Path) -> Iterator[None]:
    """Add to an error of a comparison with a tuned file the options with which that was made."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{error}; {path} was made with {made_with(content)}") from None


def _upgraded(content: dict) -> dict:
    """Content of any version, checked, with the entries of this version that follow from it."""
    if content["version"] < FILE_VERSION:
        if content["version"] > 2:
            for part in ("plant", "scenarios"):
                _mapping(part, content.get(part))
        return content | {"problem": content.get("scenario"), "problems": content.get("scenarios", {})}
    _mapping("problems", content.get("problems"))
    check_model_data(content.get("model"))
    if content.get("plant") is not None:
        _mapping("plant", content["plant"])
    for part in ("problem", "digest"):
        if not isinstance(content.get(part), str):
            raise ValueError(f"the {part} of a tuned file must be text, but got {short_repr(content.get(part))}")
    return content


def _check_version(path: str | Path, version) -> None:
    if type(version) is int and version in READ_VERSIONS:
        return
    advice = ""
    if isinstance(version, int):
        advice = ": update thruster-env" if version > FILE_VERSION else ": tune again"
    known = f"{', '.join(map(str, READ_VERSIONS[:-1]))} or {READ_VERSIONS[-1]}"
    rule = f"a tuned file must be of version {known}"
    raise ValueError(f"{rule}, but {path} is of version {short_repr(version)}{advice}")


def _check_filter(entry, known: tuple[str, ...] | None) -> None:
    """Raise ValueError unless an entry names a filter, some of its numbers and its model's arguments, as data.

    Arguments of the model are those that are known, or any names if None.
    """
    if not isinstance(entry, dict) or set(entry) != {"name", "numbers", "model"}:
        rule = "a tuned file must have a filter with name, numbers and model"
        raise ValueError(f"{rule}, but got {short_repr(entry)}")
    name = one_of("the filter of a tuned file", entry["name"], tuple(FILTERS), LISTED)
    numbers = filter_type(name).numbers
    for key, value in _mapping("numbers", entry["numbers"]).items():
        one_of(f"a number of filter {name!r}", key, numbers)
        _check_finite(key, value)
    model = _mapping("model", entry["model"])
    for key in model:
        if known is not None:
            one_of("an argument of the model of a tuned file", key, known)
        elif not key.isidentifier():
            raise ValueError(f"an argument of the model of a tuned file must be a name, but got {short_repr(key)}")
    for key in NOISE:
        if model.get(key) is None:
            raise ValueError(f"the model of a tuned file must have a {key}, but got {short_repr(model)}")
    for key, value in model.items():
        if key == STATES and isinstance(value, str):
            continue
        if key not in (FACTORS, AUGMENTED):
            _check_finite(key, value)
    if PRIOR in model:
        positive(PRIOR, model[PRIOR])
    for key, value in _mapping(FACTORS, model.get(FACTORS, {})).items():
        _check_finite(f"{FACTORS}, {key}", value)
        positive(f"{FACTORS}, {key}", value)
    for key, value in _mapping(AUGMENTED, model.get(AUGMENTED, {})).items():
        _check_finite(f"{AUGMENTED}, {key}", value)
        if not isinstance(value, list) or len(value) != 3:
            raise ValueError(f"{AUGMENTED}, {key} must be std, walk and mean, but got {short_repr(value)}")


def _check_finite(name: str, value) -> None:
    """Raise ValueError unless a value is a finite number, or a list (of lists) of such; true and text are none."""
    rows = value if isinstance(value, list) and value else [value]
    for part in (part for row in rows for part in (row if isinstance(row, list) and row else [row])):
        if isinstance(part, bool) or not isinstance(part, int | float):
            raise ValueError(f"{name} must be made of finite numbers, but got {short_repr(value)}")
        finite(name, part)


def _mapping(part: str, value) -> dict:
    if not isinstance(value, dict):
        raise ValueError(f"the {part} of a tuned file must be a mapping, but got {short_repr(value)}")
    return value
