"""Recorded runs: trajectories of many copies, and `ReplayEnv`, a log as a Gymnasium env."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import as_floats, short_repr
from thruster_env.core.checks import seed as checked_seed
from thruster_env.core.modules import error_line, object_named
from thruster_env.env.copies import PlantCopies
from thruster_env.env.model_env import with_noise
from thruster_env.env.plant_data import some_numbers
from thruster_env.logs.log import Log, seen_by
from thruster_env.logs.read import read_log
from thruster_env.model.continuous import ContinuousModel, continuous_of, in_discrete_time
from thruster_env.model.state_space import StateSpaceModel


def record(
    copies_of: Callable[[int], PlantCopies], keys: np.ndarray, inputs: np.ndarray, name: str, count: int
) -> tuple[np.ndarray, dict[str, Any]]:
    """Reports (B, K + 1, reported) of a batch of B copies from their start on, and the row or rows by name.

    Args:
        copies_of: `copies_of(count)` makes that many copies.
        keys: of their episodes, (B, 2).
        inputs: (B, K, p), or (B, K) if p is 1.
        name: the name of the inputs, for messages.
        count: their number p.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    keys, inputs = (np.ascontiguousarray(as_floats(a)) for a in (keys, inputs))
    if keys.ndim != 2 or keys.shape[1] != 2 or not np.isfinite(keys).all():
        raise ValueError(f"keys must be finite and of shape (B, 2), but got shape {keys.shape}")
    rest = () if count == 1 else (count,)
    fits = inputs.ndim == 2 + len(rest) and len(inputs) == len(keys) and inputs.shape[2:] == rest
    if not fits or np.isnan(inputs).any():
        shape = f"({len(keys)}, K{''.join(f', {size}' for size in rest)})"
        rule = f"{name} must be without NaN and of shape {shape}, one row per key"
        raise ValueError(f"{rule}, but got shape {inputs.shape}")
    copies = copies_of(len(keys))
    reports = np.empty((inputs.shape[1] + 1, copies.reported, len(keys)))
    reports[0] = copies.begin(keys)
    for k in range(inputs.shape[1]):
        reports[k + 1] = copies.step(inputs[:, k])
    return np.ascontiguousarray(reports.transpose(2, 0, 1)), copies.report_rows


def check_finite(what: str, *parts: np.ndarray) -> None:
    """Raise ValueError that names the first step at which a number of the parts (B, K + 1, ...) is not finite."""
    finite = np.all([np.isfinite(part).all(axis=(0, 2)) for part in parts], axis=0)
    if not finite.all():
        raise ValueError(
            f"{what} must stay finite, but it is not from step {np.argmin(finite)} of {len(finite) - 1} on: "
            "check dt and the noise covariances"
        )


ANY_DT = 0.01  # [s], of a model that is asked for its quantities before the sample time of the log is known


class ReplayEnv(gym.Env):
    """A log as an env: step k returns the measurement of row k for any action; an episode is the whole log.

    The inputs come from the log, too: `info["recorded_input"]` (p,) is the input of the step, and filter wrappers
    predict with it instead of the action. For a missing measurement, the observation repeats the last value
    (0 at first), and `info["measurement_valid"]` is false. `info["references"]` holds the values of the
    reference channels in the row. The reward is 0.

    Args:
        log: a `Log`, or the path of a file that `thruster_env.logs.read.read_log` reads.
        model: defines the log's columns and is the `state_space_model` offered to filters: a `StateSpaceModel`; a
            function that makes one, for the log's sample time if it has an argument `dt`; a `ContinuousModel`, or
            a function that makes one, at that sample time; an object that offers `state_space_model`, such as an
            env; or "module:object" for any of these.
        columns: headers by quantity, as `read_log` takes them.
        clock_offset: clock offsets [s] by quantity, as `read_log` takes them.
        dt: sample time [s], as `read_log` takes it.
        grid: as `read_log` takes it; a log on its own stamps cannot be replayed.
        stamps: as `read_log` takes it.

    Raises:
        ValueError: if the file cannot be used, or the model is not one or does not fit the log.
    """

    metadata = {"render_modes": []}

    def __init__(
        self,
        log: Log | str | Path,
        model,
        *,
        columns: Mapping[str, str] | None = None,
        clock_offset: Mapping[str, float] | None = None,
        dt: float | None = None,
        grid: bool = True,
        stamps: str | None = None,
    ):
        """Read the log and make spaces; see the class for the arguments."""
        options = {"columns": columns, "clock_offset": clock_offset, "dt": dt, "grid": grid, "stamps": stamps}
        self.log, maker = read_for(log, model, **options)
        offer = object_named(model, "model") if isinstance(model, str) else model
        self.continuous = None if self.log.stamps is None else continuous_of(offer)
        self.dt, self.state_space_model = self.log.dt, maker
        if hasattr(model, "check_tuned_for"):
            self.check_tuned_for = model.check_tuned_for
        m, p = self.log.measurements.shape[1], self.log.inputs.shape[1]
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (m,), np.float64)
        self.action_space = gym.spaces.Box(-np.inf, np.inf, (p,), np.float64)
        self._row, self._last = 0, np.zeros(m)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Go back to the first row; ValueError for a log on its own stamps, whose steps differ in length."""
        if self.log.stamps is not None:
            raise ValueError(f"a log must lie on a grid to be replayed, but {self.log.name} has its own stamps")
        super().reset(seed=checked_seed(seed))
        self._row, self._last = 0, np.zeros_like(self._last)
        return self._observed()

    def step(self, action):
        """Go to the next row; ValueError for an action that is not p numbers, or after the last row."""
        some_numbers(action, self.log.input_quantities)
        if self._row == self.log.steps:
            raise ValueError(f"a log must be reset after its last row, but {self.log.name} was stepped beyond it")
        self._row += 1
        observation, info = self._observed()
        info["recorded_input"] = self.log.inputs[self._row - 1].copy()
        return observation, 0.0, False, self._row == self.log.steps, info

    def _observed(self) -> tuple[np.ndarray, dict]:
        z = self.log.measurements[self._row]
        valid = ~np.isnan(z)
        self._last = np.where(valid, z, self._last)
        info = {"measurement": self._last.copy(), "measurement_valid": valid}
        references = {key: float(values[self._row]) for key, values in self.log.references.items()}
        info["references"] = {key: value for key, value in references.items() if value == value}
        return self._last.copy(), info


def read_for(log: Any, model, **options) -> tuple[Log, Callable[..., StateSpaceModel]]:
    """A log, read if it is a path or a table, and the function of changes that makes the model at its sample time.

    Arguments and errors are those of `ReplayEnv`.
    """
    offer = object_named(model, "model") if isinstance(model, str) else model
    if not isinstance(log, Log):
        known = {name: value for name, value in options.items() if value is not None}
        log = read_log(log, _model_of(_maker(offer, options.get("dt") or ANY_DT), model), **known)
    maker = _maker(offer, log.dt)
    made_model = _model_of(maker, model)
    for logged, modelled, what in (
        (log.input_quantities, made_model.input_quantities, "inputs"),
        (log.measured, made_model.measurements, "measurements"),
    ):
        if [(quantity.symbol, quantity.unit) for quantity in logged] != [
            (quantity.symbol, quantity.unit) for quantity in modelled
        ]:
            listed = [
                ", ".join(quantity.short_label for quantity in quantities) or "none"
                for quantities in (logged, modelled)
            ]
            raise ValueError(f"{what} of log {log.name} must be the model's, {listed[1]}, but it has {listed[0]}")
    return replace(log, measurements=seen_by(made_model, log.measurements)), maker


def _maker(offer: Any, dt: float) -> Callable[..., StateSpaceModel]:
    """The function of changes that makes a model of what is offered, at a sample time."""
    offer = offer.at(dt) if isinstance(offer, ContinuousModel) else in_discrete_time(offer)
    if isinstance(offer, StateSpaceModel):
        return partial(with_noise, offer)
    if hasattr(offer, "state_space_model"):
        return offer.state_space_model
    if callable(offer):
        try:
            takes_dt = "dt" in inspect.signature(offer).parameters
        except (TypeError, ValueError):  # some are written in C
            takes_dt = False
        return partial(offer, dt=dt) if takes_dt else offer
    raise ValueError(
        "the model of a log must be a StateSpaceModel, a function that makes one, or an object with "
        f"state_space_model, but got {short_repr(offer)}"
    )


def _model_of(maker: Callable[..., StateSpaceModel], named) -> StateSpaceModel:
    try:
        result = maker()
    except ValueError:
        raise
    except Exception as error:
        raise ValueError(
            f"the model of a log must be made without arguments, but {short_repr(named)} raised "
            f"{error_line(error)}"
        ) from error
    if not isinstance(result, StateSpaceModel):
        raise ValueError(
            f"the model of a log must be a StateSpaceModel, but {short_repr(named)} makes {short_repr(result)}"
        )
    return result
