"""Profile likelihoods, with one parameter held elsewhere, and validation of the model on other runs.

Validation compares the model's prediction, simulation and likelihood before and after identification.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from filters.engine.batch import Estimates
from filters.starts import Starts, as_the_prior_says
from thruster_env.core.angles import difference, on_one_branch
from thruster_env.core.checks import one_of
from thruster_env.core.files import BLUE, DARK, RUST, panels
from thruster_env.core.sources import as_value
from thruster_env.core.text_tables import verbatim
from thruster_env.logs.log import Log
from thruster_env.model.simulate import inputs_until
from thruster_env.model.state_space import StateSpaceModel
from tuning.identification.objective import of_changed
from tuning.identification.result import Identification
from tuning.identification.starts import estimates_of, starts_of
from tuning.likelihood.ascent import climb
from tuning.likelihood.identifiability import SIGNIFICANT
from tuning.problems.data import Data
from tuning.search.study import stop_on_interrupt

REACH = (0.75, 1.5, 2.5)  # standard errors at which a parameter is held
WIDE = 10.0  # ends of a range whose ratio is beyond this are told apart on a logarithmic axis alone
LEGS = 6  # iterations of the other parameters at each


class Profile(NamedTuple):
    """log L maximised over all other parameters, with one parameter held at several values."""

    name: str
    values: np.ndarray  # (count,), rising
    log_likelihoods: np.ndarray  # (count,)

    @property
    def interval(self) -> tuple[float, float]:
        """Where log L is within 1.92 of its maximum, a 95 % interval; infinite where no end was found."""
        falls = self.log_likelihoods.max() - self.log_likelihoods
        best = int(np.argmin(falls))
        ends = []
        for side in (slice(None, best + 1), slice(best, None)):
            fall, value = falls[side], self.values[side]
            order = np.argsort(fall)
            if fall.max() < SIGNIFICANT:
                ends.append(np.inf if side.stop is None else -np.inf)
            else:
                ends.append(float(np.interp(np.sqrt(SIGNIFICANT), np.sqrt(fall[order]), value[order])))
        return ends[0], ends[1]


def profiles(
    identification: Identification,
    names: Sequence[str] | None = None,
    *,
    reach: Sequence[float] = REACH,
    progress: Callable[[str], None] = lambda name: None,
) -> list[Profile]:
    """Profile likelihoods of parameters; after Ctrl-C those that are done.

    Args:
        identification: from `identify`.
        names: names of the parameters; all if None.
        reach: distances in standard errors, to either side, at which a parameter is held, within its range.
        progress: called with the name of each parameter.

    Raises:
        ValueError: for an unknown name.

    Source: Raue et al. (2009), "Structural and practical identifiability analysis of partially observed dynamical
    models by exploiting the profile likelihood", Bioinformatics 25(15).
    """
    curves = []
    with stop_on_interrupt() as asked:
        for name in identification.names if names is None else names:
            index = identification.names.index(one_of("a parameter", name, identification.names))
            progress(name)
            points = [(identification.at[index], identification.log_likelihood)]
            for sign in (1.0, -1.0):
                points += _side(identification, index, [sign * part for part in reach], asked)
            if asked():
                break
            at, values = np.array(sorted(points)).T
            points_at = np.tile(identification.at, (len(at), 1))
            points_at[:, index] = at
            natural = np.array([identification.objective.coordinates.values(row)[index] for row in points_at])
            curves.append(Profile(name, natural, values))
    return curves


def _side(identification: Identification, index: int, reach: Sequence[float], asked) -> list[tuple[float, float]]:
    """Points outwards; the other parameters start in the direction of their correlation with this one."""
    coordinates, error = identification.objective.coordinates, np.sqrt(identification.cov[index, index])
    slope = identification.cov[:, index] / identification.cov[index, index]
    points: list[tuple[float, float]] = []
    fixed = np.arange(len(identification.at)) == index
    for part in reach:
        move = part * error
        at = coordinates.clip(identification.at + slope * move)
        if asked() or at[index] in [point for point, _ in points] or at[index] == identification.at[index]:
            break
        maximum = climb(identification.objective, at, fixed=fixed, iterations=LEGS, stop=asked)
        points.append((float(at[index]), maximum.found.value))
    return points


def profile_figure(identification: Identification, curves: Sequence[Profile]):
    """A panel for each profile: how far log L falls, the 95 % line, and the parabola of the standard error."""
    figure, axes = panels(len(curves), 3, (3.0, 2.2), 0.2)
    for axis, profile in zip(axes, curves, strict=True):
        falls = profile.log_likelihoods - identification.log_likelihood
        parameter = identification.objective.coordinates.free[identification.names.index(profile.name)]
        best, error = identification.values[profile.name], identification.standard_errors[profile.name]
        grid = np.linspace(profile.values[0], profile.values[-1], 100)
        axis.plot(grid, -0.5 * ((grid - best) / error) ** 2, color=RUST, linewidth=1, label="standard error")
        axis.plot(profile.values, falls, "o-", color=BLUE, linewidth=1.2, markersize=3, label="profile")
        axis.axhline(-SIGNIFICANT, color=DARK, linewidth=0.8, linestyle=":")
        if parameter.log and profile.values[-1] > WIDE * profile.values[0]:
            axis.set_xscale("log")
        axis.set_ylim(min(-4.0, falls.min() * 1.05), 0.3)
        axis.set_xlabel(verbatim(profile.name + (f" [{parameter.unit}]" if parameter.unit else "")))
        axis.set_ylabel("fall in log L")
    axes[0].legend(fontsize=7, frameon=False)
    return figure


class Validation(NamedTuple):
    """Metrics of a model on some runs, by the measurements' symbols, in their units."""

    log_likelihood: float  # of the innovations
    one_step: dict[str, float]  # RMSE of the one-step prediction
    simulation: dict[str, float]  # RMSE of the simulation, which uses no measurement
    fit: dict[str, float]  # 100 (1 - RMSE of the simulation / standard deviation of the measurement) [%]
    nis: float  # mean NIS over the number of channels; 1 for a consistent filter


def validation_of(
    model: StateSpaceModel, runs: Data, unseen: Sequence[bool] | None = None, starts: Starts | None = None
) -> Validation:
    """Metrics of a model on runs.

    The simulation is a filter without process noise and prior covariance, whose gain is zero. Of runs that do not
    begin as the prior says it begins where their first rows say, and these do not count.

    Args:
        model: the model of the filter.
        runs: inputs and measurements.
        unseen: (m,) which channels the filter only predicts: their errors are those of the estimate.
        starts: of the runs; None if all begin as the model's prior says.
    """
    symbols = [channel.symbol for channel in model.measurements]
    hidden = np.zeros(model.m, dtype=bool) if unseen is None else np.asarray(unseen)
    starts = as_the_prior_says(model, len(runs.measurements)) if starts is None else starts
    counted = np.arange(runs.measurements.shape[1]) >= starts.counted_from[:, None]
    scored = ~np.isnan(runs.measurements) & counted[..., None]
    visible = runs._replace(measurements=np.where(hidden, np.nan, runs.measurements))
    estimates, nothing = estimates_of(model, visible, starts), np.zeros((model.t, model.t))
    known = starts._replace(covs=np.zeros_like(starts.covs))
    simulated = estimates_of(model.replace(process_noise_cov=nothing, prior_cov=nothing), visible, known)

    def rmse(estimates: Estimates) -> np.ndarray:
        errors = np.where(hidden, _less_predicted(model, runs, estimates, hidden), estimates.innovations)
        return np.sqrt((np.where(scored, errors, 0.0) ** 2).sum(axis=(0, 1)) / scored.sum(axis=(0, 1)))

    one_step, simulation = rmse(estimates), rmse(simulated)
    rows = np.where(scored, runs.measurements, np.nan).reshape(-1, model.m)
    rows = on_one_branch(rows, model.any_shape.measurement_angles)
    spread = np.array([rows[~np.isnan(rows[:, i]), i].std() for i in range(model.m)])
    fit = 100 * (1 - simulation / np.where(spread > 0, spread, np.nan))
    weighted = np.linalg.solve(estimates.innovation_covs, estimates.innovations[..., None])[..., 0]
    nis = (weighted * estimates.innovations)[counted].sum() / scored[..., ~hidden].sum()

    def by_symbol(values: np.ndarray) -> dict[str, float]:
        return dict(zip(symbols, map(float, values), strict=True))

    likelihood = float(estimates.log_likelihoods[counted].sum())
    return Validation(likelihood, by_symbol(one_step), by_symbol(simulation), by_symbol(fit), float(nis))


def validate(
    identification: Identification, data: Data | Log | Sequence[Data | Log] | None = None
) -> dict[str, Validation]:
    """The model at the start and at the identified values, "start" and "identified".

    Args:
        identification: from `identify`.
        data: held-out runs; None for those of the identification. If a free parameter moves the data, held-out
            runs must be given as a function of it, too.
    """
    objective = identification.objective
    if data is not None:
        objective = of_changed(objective, data=data, starts=None)
    points = {
        "start": objective.coordinates.of([identification.start[name] for name in identification.names]),
        "identified": identification.at,
    }
    unseen, starts = objective.unseen, objective.starts
    if data is not None:
        prior_moves = objective.moves_prior(identification.at)
        starts = (
            None
            if prior_moves
            else starts_of(objective.model_at(identification.at), objective.data_at(identification.at), unseen)
        )
    return {
        name: validation_of(objective.model_at(at), objective.data_at(at), unseen, starts)
        for name, at in points.items()
    }


def _less_predicted(model: StateSpaceModel, runs: Data, estimates: Estimates, hidden: np.ndarray) -> np.ndarray:
    """Measurements minus their prediction from the estimates, if some channels are hidden; else zeros."""
    if not hidden.any():
        return np.zeros_like(runs.measurements)
    observe, c, fed = model.functions.observe, model.given_constants, model.any_shape.fed
    inputs = inputs_until(runs.inputs)
    predicted = [
        [observe(as_value(x), *fed(as_value(u)), c) for x, u in zip(*run, strict=True)]
        for run in zip(estimates.means.tolist(), inputs.tolist(), strict=True)
    ]
    return difference(runs.measurements, np.array(predicted), model.any_shape.measurement_angles)
