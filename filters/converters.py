"""Filters of FilterPy, pykalman, statsmodels, python-control and SciPy as ours, and ours as FilterPy's.

None of these packages is imported unless it is needed: what counts are the attributes of what is handed over. All
conventions are about the first measurement. Ours updates the prior with it, as pykalman and statsmodels do.
FilterPy predicts before it, so its prior is moved by one prediction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from filters.filter import Filter
from filters.gaussian.kalman import KalmanFilter
from thruster_env.core.checks import as_floats, covariance, positive, short_repr, vector
from thruster_env.core.modules import to_install
from thruster_env.model.affine import AffineModel, affine_model
from thruster_env.model.continuous import noise_of_densities
from thruster_env.model.state_space import StateSpaceModel

if TYPE_CHECKING:
    import filterpy.kalman

CHANGES = ": what changes is an input of a model, transition(x, u, c) or observe(x, u, c) (docs/other_packages.md)"


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictedKalmanFilter(KalmanFilter):
    """A Kalman filter of FilterPy, whose prior is that after the first prediction; a first input can be added."""

    has_first_input: ClassVar[bool] = False

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
    f, h, q, r, x, p = _attributes(kf, "a filterpy.kalman.KalmanFilter", "F", "H", "Q", "R", "x", "P")
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
            raise ValueError(f"{name} must be the same in all steps, but has shape {value.shape}{CHANGES}")
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
            raise ValueError(f"{name} must be the same in all steps, but changes{CHANGES}")
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
            f"D must be zero, but got {d.tolist()}: affine_model(d=) takes the D of the input until then"
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


def _attributes(value: Any, kind: str, *names: str) -> list[np.ndarray]:
    """Attributes as matrices; ValueError where one is missing."""
    missing = [name for name in names if getattr(value, name, None) is None]
    if missing:
        way = "a filter of functions is make_filter(name, StateSpaceModel(transition=..., observe=...))"
        raise ValueError(f"it must be {kind}, but a {type(value).__name__} has no {', '.join(missing)}: {way}")
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
