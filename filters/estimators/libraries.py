"""Filters of FilterPy and Stone Soup as estimators."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from filters.estimators.foreign import Estimator, Output
from thruster_env.core.angles import difference, wrapped_where
from thruster_env.core.sources import as_value
from thruster_env.model.state_space import StateSpaceModel, refuse_feed

START = datetime(2000, 1, 1)  # of every trajectory: states carry a time, and only differences of it count


class FilterPyEstimator(Estimator):
    """A filter of FilterPy, or any object with `predict`, `update`, `x`, `P`, `y`, `S` and `R` like its.

    Each trajectory begins with a copy of the user's filter, whose x and P are the prior. It predicts with the
    input, then updates with the measurement. If some channels are missing it updates with the others, with
    reduced `R` and `H` or `hx` as arguments of FilterPy's `update`; if all are missing, it predicts only.

    For a model with angles it must subtract and average them as angles: an unscented filter by `residual_x` and
    `x_mean_fn`, `residual_z` and `z_mean_fn`, an extended one by `residual` among the arguments of its update.

    Args:
        filter: of FilterPy, x, P, Q and R set.
        predict: `predict(filter, u)`, where the filter's own `predict(u=u)` will not do.
        update_arguments: further ones of its `update`, such as `HJacobian` and `Hx` of an extended filter.
        name: for tables; that of its class if None.

    Source: Labbe (2014), "Kalman and Bayesian filters in Python", and its library FilterPy.
    """

    def __init__(
        self,
        filter: Any,
        predict: Callable | None = None,
        update_arguments: Mapping | None = None,
        name: str | None = None,
    ):
        self.name = name or f"filterpy {type(filter).__name__}"
        self._original, self._predict = filter, predict or _predict
        self._arguments = dict(update_arguments or {})
        self.filter = copy.deepcopy(filter)

    def check_model(self, model: StateSpaceModel) -> None:
        """Raise ValueError unless the filter subtracts and averages the angles of a model as angles."""
        filter_, lacks = self._original, []
        for kind, angles in (("x", model.shape.state_angles), ("z", model.shape.measurement_angles)):
            if not any(angles):
                continue
            if hasattr(filter_, "points_fn"):
                plain = getattr(filter_, f"residual_{kind}", np.subtract) is np.subtract
                lacks += [f"residual_{kind}"] * plain
                lacks += [f"{kind}_mean_fn"] * (getattr(filter_, f"{kind}_mean", None) is None)
            elif kind == "z" and "residual" not in self._arguments:
                lacks.append("residual")
        if lacks:
            rule = f"the estimator {self.name!r} must treat angles as such on a model with angles"
            raise ValueError(f"{rule}, but has no {', '.join(lacks)}")

    def reset(self, key, z) -> Output:
        """The prior, updated with the first measurement; FilterPy's filters take no key."""
        self.filter = copy.deepcopy(self._original)
        points = getattr(self.filter, "points_fn", None)
        if points is not None:  # a first update without a prediction needs sigma points
            self.filter.sigmas_f = points.sigma_points(self.filter.x, self.filter.P)
        return self._updated(z)

    def step(self, u, z) -> Output:
        """The filter's estimate after its prediction and its update."""
        u = np.asarray(u, dtype=np.float64)
        self._predict(self.filter, u[:, None] if np.ndim(self.filter.x) == 2 else u)
        return self._updated(z)

    def _updated(self, z) -> Output:
        filter_, z = self.filter, np.asarray(z, dtype=np.float64)
        present = ~np.isnan(z)
        # Channels that are missing have no innovation, and no correlation to the others.
        innovation, s = np.zeros(len(z)), np.array(filter_.R, dtype=np.float64)
        if present.any():
            measured = z[present, None] if np.ndim(filter_.x) == 2 else z[present]
            if present.all():
                filter_.update(measured, **self._arguments)
            else:
                self._update_present(measured, present)
            innovation[present] = np.ravel(filter_.y)
            s[np.ix_(present, present)] = filter_.S
        return Output(np.ravel(filter_.x).copy(), np.array(filter_.P), innovation, s)

    def _update_present(self, measured: np.ndarray, present: np.ndarray) -> None:
        """Update with the present channels alone; functions of angles see vectors of all channels."""
        filter_, arguments = self.filter, dict(self._arguments)
        if "residual" in arguments:
            arguments["residual"] = _restricted(arguments["residual"], present)
        originals = {name: getattr(filter_, name, None) for name in ("residual_z", "z_mean")}
        replaced = {
            name: _restricted(function, present)
            for name, function in originals.items()
            if function not in (None, np.subtract)
        }
        vars(filter_).update(replaced)
        filter_.update(measured, **{**arguments, **self._reduced_arguments(present)})
        vars(filter_).update({name: originals[name] for name in replaced})

    def _reduced_arguments(self, present: np.ndarray) -> dict:
        """Arguments of an update with the present channels alone."""
        filter_, arguments = self.filter, self._arguments
        reduced = {"R": np.asarray(filter_.R)[np.ix_(present, present)]}
        if "HJacobian" in arguments:
            return reduced | {
                "HJacobian": lambda x, *rest: np.asarray(arguments["HJacobian"](x, *rest))[present],
                "Hx": lambda x, *rest: np.asarray(arguments["Hx"](x, *rest))[present],
            }
        if hasattr(filter_, "H"):
            return reduced | {"H": np.asarray(filter_.H)[present]}
        return reduced | {"hx": lambda x, **rest: np.asarray(filter_.hx(x, **rest))[present]}


def _restricted(function: Callable, present: np.ndarray) -> Callable:
    """Make a function of all channels one of the present channels; the others are zero."""

    def padded(part):
        out = np.zeros((*np.shape(part)[:-1], len(present)))
        out[..., present] = part
        return out

    def of_present(first, second):
        weights = np.ndim(first) == 2  # a mean, of sigma points and their weights
        return np.asarray(function(padded(first), second if weights else padded(second)))[..., present]

    return of_present


def _predict(filter: Any, u: np.ndarray) -> None:
    filter.predict(u=u)


def unscented(model: StateSpaceModel, alpha=1.0, beta=2.0, kappa=0.0) -> FilterPyEstimator:
    """FilterPy's unscented filter of any model, `filters.estimators.libraries:unscented` by name.

    Args:
        model: f, h, Q, R and the prior.
        alpha: how far out the scaled sigma points lie; these three are those of the filter `ukf` by default.
        beta: prior knowledge of the distribution beyond its moments.
        kappa: moves the points further out.
    """
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    refuse_feed(model, "the model of FilterPy's filter")
    move, measure, c = model.functions.transition, model.functions.observe, model.given_constants

    def advance(x, dt, u):
        x = as_value(x)
        for _ in range(model.substeps):
            x = move(x, as_value(u), c)
        return np.array(x)

    def look(x):
        return np.array(measure(as_value(x), c))

    def functions(kind: str, angles: tuple[bool, ...]) -> dict:
        if not any(angles):
            return {}

        def mean(points, weights):  # of numbers on the branch of the first point
            return wrapped_where(points[0] + weights @ difference(points, points[0], angles), angles)

        return {f"{kind}_mean_fn": mean, f"residual_{kind}": lambda a, b: difference(a, b, angles)}

    points, shape = MerweScaledSigmaPoints(model.n, alpha, beta, kappa), model.shape
    of_angles = functions("x", shape.state_angles) | functions("z", shape.measurement_angles)
    if any(shape.state_angles):
        of_angles["state_add"] = lambda x, change: wrapped_where(x + change, shape.state_angles)
    filter_ = UnscentedKalmanFilter(model.n, model.m, 1.0, hx=look, fx=advance, points=points, **of_angles)
    filter_.x, filter_.P = model.prior_mean.copy(), model.prior_cov.copy()
    filter_.Q, filter_.R = model.process_noise_cov.copy(), model.measurement_noise_cov.copy()
    return FilterPyEstimator(filter_, name="filterpy ukf")


class StoneSoupEstimator(Estimator):
    """A predictor and an updater of Stone Soup, such as those of its extended and unscented Kalman filters.

    A step predicts from the last state over dt, then updates with a detection. If a channel is missing it predicts
    only, because Stone Soup's measurement models have no optional channels.

    Args:
        predictor: with a transition model.
        updater: with a measurement model.
        prior: the state at the first measurement, with mean and covariance.
        dt: sample time [s].
        set_input: `set_input(transition_model, u)` passes the next input (p,) to the predictor's model; None
            without.
        name: for tables; that of the updater's class if None.

    Source: Thomas et al. (2017), "An open source framework for tracking and state estimation (Stone Soup)".
    """

    def __init__(
        self,
        predictor: Any,
        updater: Any,
        prior: Any,
        dt: float,
        set_input: Callable | None = None,
        name: str | None = None,
    ):
        self.name = name or f"stonesoup {type(updater).__name__}"
        self._predictor, self._updater, self._prior = predictor, updater, prior
        self._dt, self._set_input = dt, set_input
        self._state, self._now = prior, START

    def check_model(self, model: StateSpaceModel) -> None:
        """Raise ValueError unless measured angles are Stone Soup's `Angle`, whose differences are wrapped."""
        if not any(model.shape.measurement_angles):
            return
        from stonesoup.types.angle import Angle

        foreseen = np.ravel(self._updater.measurement_model.function(self._prior, noise=False))
        pairs = zip(model.measurements, foreseen, strict=True)
        plain = [quantity.symbol for quantity, value in pairs if quantity.angle and not isinstance(value, Angle)]
        if plain:
            raise ValueError(
                f"the estimator {self.name!r} must have a measurement model that gives angles as such "
                f"(stonesoup.types.angle), but gives numbers of {', '.join(plain)}"
            )

    def reset(self, key, z) -> Output:
        """The prior, updated with the first measurement; Stone Soup's Gaussian filters take no key."""
        from stonesoup.types.prediction import GaussianStatePrediction

        self._now = START
        prior = GaussianStatePrediction(self._prior.mean, self._prior.covar, timestamp=START)
        return self._updated(prior, z)

    def step(self, u, z) -> Output:
        """The state after a prediction over dt and an update."""
        self._now += timedelta(seconds=self._dt)
        if self._set_input is not None:
            self._set_input(self._predictor.transition_model, np.asarray(u, dtype=np.float64))
        return self._updated(self._predictor.predict(self._state, timestamp=self._now), z)

    def _updated(self, predicted: Any, z) -> Output:
        from stonesoup.types.array import StateVector
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis

        model = self._updater.measurement_model
        innovation, s = np.zeros(len(z)), np.array(model.covar(), dtype=np.float64)
        self._state = predicted
        if not np.isnan(z).any():
            detection = Detection(StateVector(z), timestamp=self._now, measurement_model=model)
            foreseen = self._updater.predict_measurement(predicted)
            self._state = self._updater.update(SingleHypothesis(predicted, detection, foreseen))
            innovation = np.ravel(np.asarray(detection.state_vector - foreseen.state_vector, dtype=np.float64))
            s = np.array(foreseen.covar, dtype=np.float64)
        mean = np.ravel(np.asarray(self._state.mean, dtype=np.float64))
        return Output(mean, np.array(self._state.covar, dtype=np.float64), innovation, s)
