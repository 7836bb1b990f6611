"""Profile likelihoods: how far the log-likelihood falls where one parameter is held elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import one_of
from thruster_env.core.plots import BLUE, DARK, RUST, panels
from thruster_env.core.text_tables import verbatim
from tuning.identification.ascent import climb
from tuning.identification.result import Identification
from tuning.likelihood.identifiability import SIGNIFICANT
from tuning.search.interruption import stop_on_interrupt

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
        at = np.clip(identification.at + slope * move, coordinates.low, coordinates.high)
        if asked() or at[index] in [point for point, _ in points] or at[index] == identification.at[index]:
            break
        maximum = climb(
            identification.objective,
            at,
            coordinates.low,
            coordinates.high,
            fixed=fixed,
            iterations=LEGS,
            stop=asked,
        )
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
