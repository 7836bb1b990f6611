"""Preset files: an identified thruster as data, in TOML, which every command and env takes as its preset.

    [thruster]                      the fields of `ThrusterParameters`, all of them
    [dead_band]                     low and high [V]
    [recorder]                      what belongs to the recorded runs and their sensors, not to the thruster:
                                    dt, sensors, ambient_velocity, process_noise_cov (a step of dt), and by channel
                                    measurement_noise_cov, bias, lag, clock_offset
    [identified]                    how it was found, for people

An env and its model have the thruster with its dead band; `thruster_env.thruster.logged.logged_model` takes the
recorder, too. Nothing in a file is run.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from thruster_env.core.checks import finite, one_of, positive, short_repr
from thruster_env.core.files import as_toml, read_toml, write_whole
from thruster_env.logs.write import check_not_among
from thruster_env.thruster.channels import CHANNELS
from thruster_env.thruster.parameters import ThrusterParameters, checked

SECTIONS = ("thruster", "dead_band", "recorder", "identified")
BY_CHANNEL = ("measurement_noise_cov", "bias", "lag", "clock_offset")
RECORDER = ("dt", "sensors", "ambient_velocity", "process_noise_cov", *BY_CHANNEL)


class PresetFile(NamedTuple):
    """The contents of a preset file."""

    parameters: ThrusterParameters
    dead_band: tuple[float, float] = (0.0, 0.0)  # [V]
    recorder: Mapping[str, Any] = {}
    identified: Mapping[str, Any] = {}


def is_file(preset) -> bool:
    """Whether a preset is the path of a file."""
    return isinstance(preset, (str, Path)) and str(preset).endswith(".toml")


def read_preset(path: str | Path) -> PresetFile:
    """A thruster from a preset file.

    Raises:
        ValueError: if the file is wrong; the message states the rule, the value and the path.
    """
    content = read_toml(path, "a preset file")
    try:
        return _checked(content)
    except ValueError as error:
        raise ValueError(f"{error} (in {path})") from None


def preset_mapping(path: str | Path) -> dict[str, Any]:
    """The thruster in a preset file, as a mapping that `make_plant` takes as its preset."""
    read = read_preset(path)
    band = {} if read.dead_band == (0.0, 0.0) else {"dead_band": list(read.dead_band)}
    return {**read.parameters._asdict(), **band}


def _checked(content: dict) -> PresetFile:
    unknown = sorted(set(content) - set(SECTIONS))
    if unknown or not all(isinstance(part, dict) for part in content.values()):
        raise ValueError(
            f"a preset file must have the tables {', '.join(SECTIONS)}, but got {short_repr(unknown)}"
        )
    thruster, band = content.get("thruster", {}), content.get("dead_band", {})
    missing = [name for name in ThrusterParameters._fields if name not in thruster]
    unknown = [name for name in thruster if name not in ThrusterParameters._fields]
    optional = ThrusterParameters._field_defaults
    if unknown or not set(missing) <= set(optional):
        names = ", ".join(ThrusterParameters._fields)
        off = f"{unknown[0]} is none" if unknown else f"{missing[0]} is missing"
        raise ValueError(f"thruster of a preset file must have the fields {names}, but {off}")
    if sorted(band) not in ([], ["high", "low"]):
        raise ValueError(f"dead_band of a preset file must have low and high, but got {short_repr(sorted(band))}")
    for name, value in (*thruster.items(), *band.items()):
        _check_no_switch(name, value)
    recorder = content.get("recorder", {})
    _check_recorder(recorder)
    ends = checked_band((band.get("low", 0.0), band.get("high", 0.0)))
    return PresetFile(checked(ThrusterParameters(**thruster)), ends, recorder, content.get("identified", {}))


def _check_recorder(recorder: dict) -> None:
    """Raise ValueError for what is unknown or no number, whoever reads it later."""
    unknown = sorted(set(recorder) - set(RECORDER))
    if unknown:
        raise ValueError(
            f"recorder of a preset file must have {', '.join(RECORDER)}, but got {short_repr(unknown)}"
        )
    positive("dt of a preset file", recorder.get("dt", 1.0))
    finite("ambient_velocity of a preset file", recorder.get("ambient_velocity", 0.0))
    sensors = recorder.get("sensors", [])
    if not isinstance(sensors, list) or not all(isinstance(channel, str) for channel in sensors):
        raise ValueError(f"sensors of a preset file must be a list of channels, but got {short_repr(sensors)}")
    known = [one_of("a channel of sensors", channel, tuple(CHANNELS)) for channel in sensors] or list(CHANNELS)
    for name in BY_CHANNEL:
        table = recorder.get(name, {})
        if not isinstance(table, dict):
            raise ValueError(f"{name} of a preset file must be a table by channel, but got {short_repr(table)}")
        for channel, value in table.items():
            if channel not in known:
                channels = ", ".join(known)
                raise ValueError(
                    f"{name} of a preset file must be of channels {channels}, but got {short_repr(channel)}"
                )
            check = finite if name in ("bias", "clock_offset") else partial(positive, zero_allowed=True)
            check(f"{name} of {channel}", value)


def _check_no_switch(name: str, value) -> None:
    if isinstance(value, bool):  # which Python takes for a number
        raise ValueError(f"{name} must be a finite number, but got {value}")


def checked_band(ends) -> tuple[float, float]:
    """A dead band (low, high) [V]; ValueError unless low <= 0 <= high."""
    pair = tuple(ends) if isinstance(ends, (tuple, list)) else ()
    if len(pair) != 2:
        raise ValueError(f"dead_band must be two voltages, low and high, but got {short_repr(ends)}")
    low, high = (finite("dead_band", end) for end in pair)
    if not low <= 0.0 <= high:
        raise ValueError(f"dead_band must be from low <= 0 to high >= 0, but got {short_repr(pair)}")
    return low, high


def write_preset(path: str | Path, preset: PresetFile, about: str = "") -> None:
    """Write a preset file.

    Args:
        path: ends in .toml.
        preset: its contents.
        about: a line of comment.

    Raises:
        ValueError: if the path does not end in .toml, lies beside a log of its name, or cannot be written.
    """
    if not is_file(path):
        raise ValueError(f"a preset file must end in .toml, but got {str(path)!r}")
    check_not_among(path)
    low, high = preset.dead_band
    tables = {
        "thruster": preset.parameters._asdict(),
        "dead_band": {"low": low, "high": high} if (low, high) != (0.0, 0.0) else {},
        "recorder": preset.recorder,
        "identified": preset.identified,
    }
    write_whole(path, as_toml(tables, about))
