"""What commands on logs share: whose log it is, which column is what, and the clocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numerics.checks import shown
from numerics.modules import object_named
from plants.logs.log import Log
from plants.replay import ANY_DT, read_for
from plants.state_space import StateSpaceModel
from thruster_env.logged import NO_BAND, logged_plant, with_shown
from thruster_env.model import model_of_plant
from thruster_env.modelled import ModelledThruster

DEFAULT_PRESET = "tunnel"


class Preset(ModelledThruster):
    """A thruster of a preset, of which logs are: it offers the model, and checks tuned files.

    Of a preset file the model has the recorder, too: biases, lags, ambient flow, Q and R.
    """

    def __init__(self, preset: str, sensors: Sequence[str] | None, dt: float):
        """Make the plant."""
        self.plant, self._seen = logged_plant(
            preset=preset, dt=dt, **({"sensors": tuple(sensors)} if sensors else {})
        )

    def state_space_model(self, **changes) -> StateSpaceModel:
        """The model, with what logs show beside the equations."""
        bare = self.plant._replace(dead_band=NO_BAND)
        return with_shown(model_of_plant(bare, **changes), bare, self._seen)


def read_named(
    path: str | Path,
    preset: str | None = None,
    model: str | None = None,
    sensors: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    clock_offset: Sequence[str] | None = None,
    dt: float | None = None,
) -> tuple[Log, Any]:
    """A log, and what offers its model at its sample time, from the options of a command.

    Raises:
        ValueError: states the rule and the value.
    """
    if model is not None and (sensors or (preset is not None and not str(preset).endswith(".toml"))):
        raise ValueError("a log must be of --model or of a thruster (--preset, --sensor), but got both")
    options = {
        "columns": pairs("--column", columns),
        "clock_offset": {
            name: _seconds(name, value) for name, value in pairs("--clock-offset", clock_offset).items()
        },
        "dt": dt,
    }
    if model is not None:
        offer = object_named(model, "model")
        if preset is not None:
            from tuning.identification.values import with_values  # which imports Optuna

            offer = with_values(offer, preset)
        return read_for(path, offer, **options)[0], offer
    log, _ = read_for(path, _states_of(preset or DEFAULT_PRESET, sensors), **options)
    return log, Preset(preset or DEFAULT_PRESET, sensors, log.dt)


def pairs(option: str, given: Sequence[str] | None) -> Mapping[str, str]:
    """A mapping from options NAME=VALUE; ValueError for another form, or a name that comes twice."""
    found: dict[str, str] = {}
    for text in given or []:
        name, equals, value = text.partition("=")
        if not (name and equals and value) or name in found:
            rule = "be given once for each name" if name in found else "have the form NAME=VALUE"
            raise ValueError(f"{option} must {rule}, but got {shown(text)}")
        found[name.strip()] = value.strip()
    return found


def _states_of(preset: str, sensors: Sequence[str] | None) -> StateSpaceModel:
    """A model of a thruster whose quantities are those of any sample time."""
    return Preset(preset, sensors, ANY_DT).state_space_model()


def _seconds(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"--clock-offset {name} must be seconds, but got {shown(text)}") from None
