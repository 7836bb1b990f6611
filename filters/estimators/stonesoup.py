"""Stone Soup's predictors and updaters as an estimator."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from filters.estimators.estimator import Estimator, Output
from thruster_env.model.state_space import StateSpaceModel

START = datetime(2000, 1, 1)  # of every trajectory: states carry a time, and only differences of it count


class StoneSoupEstimator(Estimator):
    """A predictor and an updater of Stone Soup, such as those of its extended and unscented Kalman filters.

    A step predicts from the last state over dt, then updates with a detection. Where a channel of a measurement is
    missing it predicts only, for Stone Soup's measurement models have none that may be left out.

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
        """Keep the arguments; see the class."""
        self.name = name or f"stonesoup {type(updater).__name__}"
        self._predictor, self._updater, self._prior = predictor, updater, prior
        self._dt, self._set_input = dt, set_input
        self._state, self._now = prior, START

    def check_model(self, model: StateSpaceModel) -> None:
        """Raise ValueError unless measurements that are angles are Stone Soup's, which go the short way round."""
        if not any(model.shape.measurement_angles):
            return
        from stonesoup.types.angle import Angle

        foreseen = np.ravel(self._updater.measurement_model.function(self._prior, noise=False))
        pairs = zip(model.measurements, foreseen, strict=True)
        plain = [one.symbol for one, value in pairs if one.angle and not isinstance(value, Angle)]
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
