"""Filters of other packages as ours, and ours as FilterPy's; filters of FilterPy and Stone Soup as estimators.

None of these packages is imported unless it is needed: what counts are the attributes of what is handed over. All
conventions are about the first measurement. Ours updates the prior with it, as pykalman and statsmodels do.
FilterPy predicts before it, so its prior is moved by one prediction.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from filters.estimators.foreign import Estimator, Output
from filters.filter import Filter
from filters.gaussian.kalman import KalmanFilter
from thruster_env.core.angles import difference, wrapped_where
from thruster_env.core.checks import as_floats, covariance, positive, short_repr, vector
from thruster_env.core.modules import to_install
from thruster_env.core.sources import as_value
from thruster_env.model.affine import AffineModel, affine_model
from thruster_env.model.continuous import noise_of_densities
from thruster_env.model.state_space import StateSpaceModel, refuse_feed

if TYPE_CHECKING:
    import filterpy.kalman


AS_INPUT = (
    ": what changes is an input of a model, transition(x, u, c) or observe(x, u, c) (docs/other_packages.md)"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictedKalmanFilter(KalmanFilter):
    """A Kalman filter of FilterPy, whose prior is that after the first prediction; a first input can be added."""

    has_first_input: ClassVar[bool] = False

    @classmethod
    def of_recursion(cls) -> type[Filter]:
        """That of the Kalman filter, of which only the start differs."""
        return KalmanFilter

    def from_first_input(self, inputs: Any, rows: int, update_first: bool) -> tuple[Filter, Any]:
        """Of as many inputs as rows the first one belongs to the first prediction: mean += B u_0."""
        if not update_first:
            way = "from_filterpy(kf, update_first=True) for run(..., update_first=False)"
            raise ValueError(f"a filter must predict once before the first measurement, but has done so: {way}")
        if inputs is None or len(inputs) != rows:
            return self, inputs
        if self.has_first_input:
            rule = "inputs must be one fewer than measurements where the first is first_input="
            raise ValueError(f"{rule}, but got {rows} of each: leave first_input out, or inputs[0]")
        mean = self.model.prior_mean + self.kernel_model.matrices()[1] @ inputs[0]
        return KalmanFilter(model=self.model.replace(prior_mean=mean), form=self.form), inputs[1:]


class StartedKalmanFilter(PredictedKalmanFilter):
    """One whose first prediction has its input."""

    has_first_input: ClassVar[bool] = True


def from_filterpy(kf: Any, *, update_first: bool = False, first_input: ArrayLike | None = None) -> KalmanFilter:
    """The Kalman filter of a `filterpy.kalman.KalmanFilter`, from where its state is now.

        x' = F x + B u,  P' = F P F' + Q,  unless update_first

    `filters.run(filter_, z)` gives what `kf.batch_filter(z)` does, and `filters.run(filter_, measurements=z,
    inputs=u)` what `kf.batch_filter(z, us=u)` does: of as many inputs as measurements the first belongs to the
    prediction before the first measurement.

    Args:
        kf: with F, H, Q, R, B, x and P.
        update_first: whether the next call is `kf.update`, not `kf.predict`; as in `batch_filter`.
        first_input: u of the prediction before the first measurement, (p,), where `run` gets the later ones alone;
            none if None.

    Raises:
        ValueError: for another class, a fading memory, or correlated noise.
    """
    way = ": a filter of functions is make_filter(name, StateSpaceModel(transition=..., observe=...))"
    f, h, q, r, x, p = _attributes(kf, "a filterpy.kalman.KalmanFilter", "F", "H", "Q", "R", "x", "P", way=way)
    for name, neutral in (("alpha", 1.0), ("M", 0.0)):
        if np.any(np.asarray(getattr(kf, name, neutral)) != neutral):
            rule = f"a filter of FilterPy must have {name} = {neutral:g}"
            raise ValueError(f"{rule}, but got {short_repr(getattr(kf, name))}")
    b = getattr(kf, "B", None)
    b = np.zeros((len(f), 0)) if b is None or not np.ndim(b) and not b else as_floats(b)
    b = b[:, None] if b.ndim == 1 else np.atleast_2d(b)  # FilterPy takes one column as it is
    mean, cov, kind = np.ravel(x), p, KalmanFilter
    if not update_first:
        kind = PredictedKalmanFilter if first_input is None else StartedKalmanFilter
        u = np.zeros(b.shape[1]) if first_input is None else vector("first_input", first_input, b.shape[1])
        mean, cov = f @ mean + b @ u, f @ cov @ f.T + q
    return kind(model=_filter(f, b, h, q, r, mean, cov).model)


def to_filterpy(filter_: KalmanFilter) -> filterpy.kalman.KalmanFilter:
    """A `filterpy.kalman.KalmanFilter` with the same model, noise and prior.

    The prior is updated with the first measurement: `kf.batch_filter(z, update_first=True)` predicts after each,
    or call `kf.update(z[0])`, then `kf.predict()` and `kf.update(z[k])`.

    Args:
        filter_: of an affine model without offsets.

    Raises:
        ValueError: for another filter or offsets.
        ImportError: if FilterPy is not installed.
    """
    model = filter_.kernel_model if isinstance(filter_, KalmanFilter) else None
    if not isinstance(model, AffineModel):
        raise ValueError(f"a filter for FilterPy must be 'kf' of an affine model, but got {short_repr(filter_)}")
    f, b, a, h, d = model.matrices()
    if a.any() or d.any():
        offsets = short_repr([a.tolist(), d.tolist()])
        raise ValueError(f"a model for FilterPy must have no offsets, but got {offsets}: subtract them from z")
    try:
        from filterpy.kalman import KalmanFilter as Theirs
    except ImportError:
        raise ImportError(f"FilterPy must be installed ({to_install('peers')})") from None
    kf = Theirs(dim_x=model.n, dim_z=model.m, dim_u=model.inputs)
    kf.F, kf.H, kf.Q, kf.R = f, h, model.process_noise_cov.copy(), model.measurement_noise_cov.copy()
    kf.B = b if model.inputs else None
    kf.x, kf.P = model.prior_mean[:, None].copy(), model.prior_cov.copy()
    return kf


def from_pykalman(kf: Any) -> KalmanFilter:
    """The Kalman filter of a `pykalman.KalmanFilter`: `filters.run(filter_, z)` gives what `kf.filter(z)` does.

    Offsets are kept; what was not set has pykalman's default.

    Args:
        kf: with matrices that do not change in time.

    Raises:
        ValueError: for another class or matrices of each step.
    """
    if not hasattr(kf, "_initialize_parameters") or not hasattr(kf, "transition_matrices"):
        raise ValueError(f"kf must be a pykalman.KalmanFilter, but got {short_repr(kf)}")
    names = (
        *("transition_matrices", "transition_offsets", "transition_covariance"),
        *("observation_matrices", "observation_offsets", "observation_covariance"),
        *("initial_state_mean", "initial_state_covariance"),
    )
    values = dict(zip(names, map(as_floats, kf._initialize_parameters()), strict=True))
    for name, value in values.items():
        most = 1 if name.endswith(("offsets", "mean")) else 2
        if value.ndim > most:
            raise ValueError(f"{name} must be the same in all steps, but has shape {value.shape}{AS_INPUT}")
    a, offset, q, h, shift, r, mean, cov = values.values()
    return _filter(a, np.zeros((len(a), 0)), h, q, r, mean, cov, state_offset=offset, measurement_offset=shift)


def from_statsmodels(results: Any) -> KalmanFilter:
    """The Kalman filter of a fitted state-space model of statsmodels, with its Q, R, and initial state.

        x' = T x + c + R w,  z = Z x + d + v

    `filters.run(filter_, z)` gives `results.filtered_state` and `llf_obs`.

    Args:
        results: what `model.fit()`, `filter` or `smooth` returns.

    Raises:
        ValueError: for matrices of each step, an exact diffuse start, or a model without measurement noise.
    """
    part = getattr(results, "filter_results", None)
    if part is None:
        raise ValueError(f"results must be what model.fit() of statsmodels returns, but got {short_repr(results)}")
    names = "transition", "state_intercept", "selection", "state_cov", "design", "obs_intercept", "obs_cov"
    matrices = []
    for name in names:
        value = as_floats(getattr(part, name))
        if value.shape[-1] > 1 and (value != value[..., :1]).any():
            raise ValueError(f"{name} must be the same in all steps, but changes{AS_INPUT}")
        matrices.append(value[..., 0])
    f, c, selection, noise, h, d, r = matrices
    diffuse = getattr(part, "initial_diffuse_state_cov", None)
    if diffuse is not None and np.any(diffuse):
        way = "results.model.ssm.initialize_approximate_diffuse(), then fit again"
        raise ValueError(f"the start must have a finite covariance, but is exactly diffuse: call {way}")
    mean, cov = as_floats(part.initial_state), as_floats(part.initial_state_cov)
    if not np.linalg.eigvalsh(r).min() > 0.0:
        rule = "the measurement noise must have a positive definite covariance"
        raise ValueError(f"{rule}, but got {short_repr(r.tolist())}: fit with measurement_error=True")
    q = selection @ noise @ selection.T
    return _filter(f, np.zeros((len(f), 0)), h, q, r, mean, cov, state_offset=c, measurement_offset=d)


def from_control(
    system: Any,
    process_noise_cov: ArrayLike,
    measurement_noise_cov: ArrayLike,
    *,
    dt: float | None = None,
    noise_input: ArrayLike | None = None,
    prior_mean: ArrayLike | None = None,
    prior_cov: ArrayLike | None = None,
) -> KalmanFilter:
    """The Kalman filter of a linear system of python-control or scipy.signal, with noise, as MATLAB's `kalman`.

        continuous:  dx/dt = A x + B u + G w,  E[w(t) w(s)'] = Q delta(t - s);   discrete:  x' = A x + B u + G w

    Inputs are held over a step, as `c2d` and `cont2discrete` do with "zoh".

    Args:
        system: with A, B, C, D and dt, or with `to_ss()`: a state space or a transfer function.
        process_noise_cov: of w, per step for a discrete system, a spectral density for a continuous one.
        measurement_noise_cov: R of each measurement.
        dt: sample time [s] of a continuous system.
        noise_input: G, (n, w); the identity if None.
        prior_mean: (n,), zero if None.
        prior_cov: (n, n) or n variances; of the steady state if None.

    Raises:
        ValueError: if something does not fit, a continuous system has no dt, or D is not zero.
    """
    system = system.to_ss() if hasattr(system, "to_ss") and not hasattr(system, "A") else system
    a, b, c, d = _attributes(system, "a state space, as of python-control or scipy.signal", "A", "B", "C", "D")
    if d.any():
        raise ValueError(
            f"D must be zero, but got {d.tolist()}: filter z - D u of the same instant with D = 0, "
            "or give affine_model(d=) the D of the input until then"
        )
    n, own_dt = len(a), getattr(system, "dt", None)
    g = np.eye(n) if noise_input is None else as_floats(noise_input)
    g = g[:, None] if g.ndim == 1 else g
    if g.ndim != 2 or len(g) != n:
        raise ValueError(f"noise_input must have shape (n, w) with n = {n}, but got {g.shape}")
    q = g @ covariance("process_noise_cov", process_noise_cov, g.shape[1]) @ g.T
    is_number = own_dt is not None and own_dt is not True
    if own_dt is None or own_dt is False or own_dt == 0:
        if dt is None:
            raise ValueError("a continuous system must have a sample time (dt=), but got none")
        from scipy.signal import cont2discrete

        q = noise_of_densities(q, a, positive("dt", dt))
        a, b, *_ = cont2discrete((a, b, c, d), dt)
    elif dt is not None and own_dt is not True and abs(dt - own_dt) > 1e-9 * own_dt:
        raise ValueError(f"dt must be that of a discrete system, {own_dt}, but got {dt}")
    r = covariance("measurement_noise_cov", measurement_noise_cov, len(c), positive_definite=True)
    if prior_cov is None:
        from filters.bounds import steady_state

        try:
            prior_cov = steady_state(a, c, q, r)[0]
        except np.linalg.LinAlgError:
            rule = "a system without a steady state must have a first covariance (prior_cov=)"
            raise ValueError(f"{rule}, but got none") from None
    dt = own_dt if dt is None and is_number else dt
    return _filter(a, b, c, q, r, np.zeros(n) if prior_mean is None else prior_mean, prior_cov, dt=dt)


def _attributes(value: Any, kind: str, *names: str, way: str = "") -> list[np.ndarray]:
    """Attributes as matrices; ValueError, with the way out, if one is missing."""
    missing = [name for name in names if getattr(value, name, None) is None]
    if missing:
        raise ValueError(f"it must be {kind}, but a {type(value).__name__} has no {', '.join(missing)}{way}")
    return [np.atleast_2d(as_floats(getattr(value, name))) for name in names]


def _filter(f, b, h, q, r, mean, cov, **options: Any) -> KalmanFilter:
    model: StateSpaceModel = affine_model(
        a=f,
        b=b,
        c=h,
        process_noise_cov=q,
        measurement_noise_cov=r,
        prior_mean=mean,
        prior_cov=cov,
        **options,
    )
    return KalmanFilter(model=model)


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
