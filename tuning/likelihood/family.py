"""A filter's model as a function of tuned parameters, and scores of runs with their derivatives along these."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from filters.differentiated.recursion import LIKELIHOOD, Wanted
from filters.differentiated.runs import ModelSlopes, Truth, derivatives, same_functions
from filters.registry import make_filter
from plants.state_space import StateSpaceModel
from tuning.problems.coordinates import Coordinates
from tuning.problems.data import Data
from tuning.problems.parameter import Parameter, Place
from tuning.problems.problem import Problem
from tuning.search.parameters import MeasurementVariance, ProcessVariance, model_parameters
from tuning.search.space import Choice

DIFFERENTIABLE = ("kf", "ekf")  # filters
LEAST_NUMBERS = 8  # number of parameters from which the information is faster than differences
STEP = 1e-4  # in coordinates, of the differences of a model's numbers


class Family:
    """The models that a problem's filter assumes, by the coordinates (p,) of parameters.

    Args:
        choice: of a Kalman filter; its other parameters are held.
        problem: makes the models.
        parameters: the p parameters.

    Raises:
        ValueError: if a parameter is a whole number, or changes functions of the model and not its numbers alone.
    """

    def __init__(self, choice: Choice, problem: Problem, parameters: Sequence[Parameter]):
        """Find out whether all parameters are variances, of which derivatives are known."""
        self.coordinates, self._choice, self._problem = Coordinates(parameters), choice, problem
        self._base = base = self._model(choice)
        covs = base.process_noise_cov, base.measurement_noise_cov
        places = [_place(one.place, base.n) for one in parameters]
        self._places = [place for place in places if place is not None]
        exact = len(self._places) == len(places) and all(map(_is_diagonal, covs))
        self._diagonal = np.concatenate(list(map(np.diag, covs))) if exact else None

    @property
    def states(self) -> int:
        """Number of states of the models."""
        return self._base.n

    def at(self, point: np.ndarray) -> tuple[StateSpaceModel, ModelSlopes]:
        """The model at coordinates, and its derivatives by them: exact for variances, else central differences."""
        if self._diagonal is not None:
            return self._with_variances(self._diagonal, self.coordinates.values(point))
        pairs = []
        for place, name in enumerate(self.coordinates.names):
            above, below = map(self._model_at, self.coordinates.beside(point, place, STEP))
            pairs.append((above, below))
            if not same_functions(above, below):
                raise ValueError(
                    f"parameters of a gradient must change numbers of the model alone, but {name} changes its "
                    "functions"
                )
        return self._model_at(point), ModelSlopes.between(pairs, 2 * STEP)

    def derivatives(
        self,
        point: np.ndarray,
        data: Data,
        *,
        score: str = LIKELIHOOD,
        information: bool = False,
        truth: Truth | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Scores of B runs with their gradients, (B, 1 + p), and Fisher's information, (B, p, p), if wanted.

        The lead-in of runs, in which the filter settles, is left out; so is what a run was padded with.
        """
        model, slopes = self.at(point)
        wanted = Wanted(information, constants=bool(slopes.constants.any()), tails=False, score=score)

        def of(some: Data) -> tuple[np.ndarray, np.ndarray]:
            out, told = derivatives(model, some.seen.inputs, some.seen.measurements, slopes, wanted, truth=truth)
            return out[:, 0], told

        found = of(data)
        if truth is not None or not (self._problem.leads_in and data.first_scored):
            return found
        before = of(data.beginning)
        return found[0] - before[0], found[1] - before[1]

    def choice_at(self, point: np.ndarray) -> Choice:
        """The choice at coordinates."""
        changed = self._choice
        for one, value in zip(self.coordinates.free, self.coordinates.values(point).tolist(), strict=True):
            changed = one.set(changed, value)
        return changed

    def _model_at(self, point: np.ndarray) -> StateSpaceModel:
        return self._model(self.choice_at(point))

    def _model(self, choice: Choice) -> StateSpaceModel:
        return make_filter(choice.name, self._problem.model(**choice.model)).kernel_model

    def _with_variances(self, diagonal: np.ndarray, values: np.ndarray) -> tuple[StateSpaceModel, ModelSlopes]:
        """The model with variances, whose derivatives by their logarithms are the variances themselves."""
        n, count, places, variances = self._base.n, len(values), self._places, diagonal.copy()
        variances[places] = values
        slopes = np.zeros((count, len(diagonal), len(diagonal)))
        slopes[range(count), places, places] = values
        q, r = np.diag(variances[:n]), np.diag(variances[n:])
        model = self._base.replace(process_noise_cov=q, measurement_noise_cov=r)
        noise = {"process_noise_cov": slopes[:, :n, :n], "measurement_noise_cov": slopes[:, n:, n:]}
        return model, ModelSlopes.of(model, count, **noise)


def known_information(
    choice: Choice, scenarios: Sequence[Problem], data: Sequence[Data], names: Sequence[str], values: np.ndarray
) -> np.ndarray | None:
    """Fisher information on the logarithms of a Kalman filter's parameters in each of B runs, (B, p, p).

    None for other filters, and where a parameter changes the model's functions or is on another scale. It takes
    the time of about fifteen runs of the filter; differences take two runs for each pair of parameters.

    Args:
        choice: choice of one filter type; its other parameters are held.
        scenarios: the problems.
        data: for each scenario, its runs.
        names: names of the p parameters.
        values: at which the information is taken, (p,).
    """
    if choice.name not in DIFFERENTIABLE or len(names) < LEAST_NUMBERS:
        return None
    found = []
    for scenario, one in zip(scenarios, data, strict=True):
        known = {parameter.name: parameter for parameter in model_parameters(scenario) if parameter.log}
        if not set(names) <= set(known):
            return None
        try:
            family = Family(choice, scenario, [known[name] for name in names])
            found.append(family.derivatives(np.log(values), one, information=True)[1])
        except ValueError:  # more than numbers changes
            return None
    return np.concatenate(found)


def _place(place: Place, n: int) -> int | None:
    """The index of a variance in the diagonals of Q, (n,), then of R; None of another parameter."""
    if isinstance(place, ProcessVariance):
        return place.index
    return n + place.index if isinstance(place, MeasurementVariance) else None


def _is_diagonal(cov: np.ndarray) -> bool:
    return np.array_equal(cov, np.diag(np.diag(cov)))
