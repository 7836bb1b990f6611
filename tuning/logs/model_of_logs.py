"""Whose recorded runs are: a pair (model, logs), a model, or a thruster's preset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from thruster_env.core.checks import short_repr
from thruster_env.core.modules import is_code
from thruster_env.logs.log import Log
from thruster_env.logs.recorders.registry import ENDINGS
from thruster_env.logs.table import SUFFIXES
from thruster_env.model.continuous import ContinuousModel
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.plant_packages import logs_package


def model_of_logs(logs: Any, model: Any, preset: str | Path | None) -> tuple[Any, Any, str | Path | None]:
    """Logs, their model (None for a thruster) and the preset, from what a user gives.

    Args:
        logs: recorded runs, or a pair (model, logs) as `tuning.tune` takes it.
        model: a model, what makes or offers one, "module:object", or a thruster's preset.
        preset: a thruster, by name or file.

    Raises:
        ValueError: if a model or a preset is given twice, or a model is neither code nor a preset.
    """
    if isinstance(logs, tuple) and len(logs) == 2 and _is_model(logs[0]):
        if model is not None:
            raise ValueError(f"a pair (model, logs) must come without another model, but got {short_repr(model)}")
        model, logs = logs
    if not isinstance(model, str | Path) or is_code(str(model)):
        return logs, model, preset
    if preset is not None:
        raise ValueError(
            f"give either a model or a preset, but got both, {short_repr(model)} and {short_repr(preset)}"
        )
    if not logs_package().is_preset(model):
        rule = "a model must be an object, 'module:object' or a thruster's preset"
        raise ValueError(f"{rule}, but got {short_repr(model)}")
    return logs, None, model


def _is_model(candidate: Any) -> bool:
    """Whether something is a model, what makes or offers one, code, or a thruster's preset, but no log."""
    if isinstance(candidate, str | Path):
        if Path(candidate).suffix in (*SUFFIXES, *ENDINGS):  # a log in a folder of Windows has a colon, too
            return False
        return is_code(str(candidate)) or logs_package().is_preset(candidate)
    return (
        isinstance(candidate, StateSpaceModel | ContinuousModel)
        or hasattr(candidate, "state_space_model")
        or _makes_one(candidate)
    )


def _makes_one(candidate: Any) -> bool:
    return callable(candidate) and not isinstance(candidate, Log) and not hasattr(candidate, "columns")
