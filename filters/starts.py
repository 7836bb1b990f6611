"""Initial beliefs of runs, and restarts of a diverged filter: their step, states and likely cause in words."""

from __future__ import annotations

import warnings
from itertools import product
from typing import Any, NamedTuple, cast

import numpy as np

from filters.engine.batch import trajectories
from filters.engine.session import Session
from filters.filter import Filter
from filters.gaussian.multiple_models import MultipleModelFilter
from thruster_env.core.angles import difference
from thruster_env.core.checks import as_floats
from thruster_env.core.sources import as_value
from thruster_env.model import rotations, turns
from thruster_env.model.shape import number_offsets, observation_slopes, transition_slopes
from thruster_env.model.state_space import StateSpaceModel

Flaw = tuple[np.ndarray, str]  # which states, (n,) bool, and the cause
Moments = tuple[np.ndarray, np.ndarray]  # mean (n,) and covariance (n, n)
UNKNOWN = "numbers of the filter itself overflow, or a variance became negative by rounding"
PRIOR, MEASUREMENT = "prior", "measurement"
STARTS = (PRIOR, MEASUREMENT)  # where recorded runs may begin
WIDE = 10.0  # standard deviations of the prior, of which a free start has one
FAINT = 1e-6  # part of the strongest direction, below which a direction is not seen
STEPS, DAMPINGS, MOST_STARTS = 30, 1e9, 4  # of Gauss and Newton, at most, the most damping, and starts


class RestartWarning(RuntimeWarning):
    """A filter restarted from the prior, so its estimate so far is lost."""


class Restarts(NamedTuple):
    """Restarts of a filter on B runs: an estimate was not finite, or a variance negative.

    Attributes:
        times: how often it restarted, in all runs.
        runs: with any.
        of_runs: B.
        run: the first run with any.
        step: of the first restart in that run.
        states: symbols of the states that were lost first.
        cause: the likely one, as an extended Kalman filter meets it at the estimate before.
    """

    times: int
    runs: int
    of_runs: int
    run: int
    step: int
    states: tuple[str, ...]
    cause: str

    @property
    def sentence(self) -> str:
        """All of it in one sentence."""
        times = "once" if self.times == 1 else f"{self.times} times"
        among = f" in {self.runs} of {self.of_runs} runs" if self.of_runs > 1 else ""
        run = f" of run {self.run}" if self.of_runs > 1 else ""
        states = f" ({', '.join(self.states)})" if self.states else ""
        return (
            f"The filter restarted from the prior {times}{among}, first at step {self.step}{run}{states}: "
            f"{self.cause}."
        )


def warn_of_restarts(filter_: Filter, divergences: np.ndarray, keys, inputs, measurements, **noise) -> None:
    """Warn the caller's caller with the sentence of `restarts_of`, if the filter restarted."""
    restarts = restarts_of(filter_, divergences, keys, inputs, measurements, **noise)
    if restarts is not None:
        warnings.warn(restarts.sentence, RestartWarning, stacklevel=3)


def restarts_of(
    filter_: Filter,
    divergences: np.ndarray,
    keys=None,
    inputs=None,
    measurements=None,
    *,
    process_noise_covs=None,
    measurement_noise_covs=None,
    step_filters=None,
) -> Restarts | None:
    """The restarts of a filter on runs, from its `divergences` (B,); None if it never restarted.

    The other arguments are those of `filters.run`. The first run that restarted is stepped once more.
    """
    divergences = np.atleast_1d(divergences)
    if not divergences.any():
        return None
    b, session, first = int(np.flatnonzero(divergences)[0]), Session(filter_), FirstRestart(filter_)
    keys, inputs, z = trajectories(filter_, keys, inputs, measurements)
    for k, measured in enumerate(z[b]):
        r = None if measurement_noise_covs is None else measurement_noise_covs[k]
        if k == 0:
            if r is not None:
                session.set_noise(measurement_noise_cov=r)
            session.start(keys[b], measured)
        else:
            if step_filters is not None:
                session.set_numbers(step_filters[k - 1].numbers)
            if process_noise_covs is not None:
                session.set_noise(process_noise_cov=process_noise_covs[k - 1])
            if r is not None:
                session.set_noise(measurement_noise_cov=r)
            session.step(inputs[b, k - 1], measured)
        first.note(session, inputs[b, k - 1] if k else None, measured)
        if session.divergences:
            break
    runs = int((divergences > 0).sum())
    return Restarts(int(divergences.sum()), runs, len(divergences), b, *first.event)


class FirstRestart:
    """The first restart of a filter that is stepped by hand; `note` records each step.

    Attributes:
        event: the step, symbols of the states that were lost, and the likely cause.
    """

    def __init__(self, filter_: Filter):
        self._filter, self._step = filter_, 0
        self._before: list[Moments] | None = None
        self.event: tuple[int, tuple[str, ...], str] = 0, (), "it did not occur when the run was repeated"
        self._is_open = True

    def hold(self, session: Any) -> None:
        """Keep the belief before a prediction that is not part of a step; `note` comes after the update."""
        if self._is_open:
            self._before = _moments(self._filter, session)

    def note(self, session: Any, u, z) -> None:
        """Look at a session after a step with input u (p,), None without a prediction, and measurement z (m,)."""
        if session.divergences and self._is_open:
            self._is_open = False
            numbers = getattr(session, "numbers", None)
            self.event = self._step, *_states_and_cause(self._filter, numbers, self._before, u, as_floats(z))
        if self._is_open:
            self.hold(session)
            self._step += 1

    def restarts(self, count: int) -> Restarts | None:
        """The restarts of one run, `count` in number; None if there were none."""
        return Restarts(count, 1, 1, 0, *self.event) if count else None


class FirstRestarts:
    """The first restarts of N copies of a filter."""

    def __init__(self, filter_: Filter, count: int):
        n, t = filter_.kernel_model.n, filter_.kernel_model.t
        self._filter, self._counts, self._steps = filter_, np.zeros(count), np.zeros(count, dtype=int)
        self._means, self._covs = np.zeros((count, n)), np.zeros((count, t, t))
        self._events: list[tuple[int, tuple[str, ...], str] | None] = [None] * count

    def start(self, which: np.ndarray) -> None:
        """Begin anew in some copies, by their indices."""
        self._counts[which], self._steps[which] = 0.0, 0
        for i in which:
            self._events[i] = None

    def note(self, which: np.ndarray, counts: np.ndarray, moments: Moments, u, z) -> np.ndarray | None:
        """Sentences on copies that restarted in this step, (N,) with None for the others; None if none restarted.

        Args:
            which: copies that made a step, or were started, (N,) bool.
            counts: of restarts since then, (N,).
            moments: means (N, n) and covariances (N, n, n) after it, which are kept.
            u: inputs (N, p).
            z: measurements (N, m).
        """
        lost = np.flatnonzero(which & (counts > self._counts)).tolist()
        sentences = np.full(len(counts), None, dtype=object)
        for i in lost:
            step = int(self._steps[i])
            before = [(self._means[i], self._covs[i])] if step else None
            first = self._events[i] or (step, *_states_and_cause(self._filter, None, before, u[i], z[i]))
            self._events[i] = first
            sentences[i] = Restarts(int(counts[i]), 1, 1, 0, *first).sentence
        self._steps[which] += 1
        self._counts = np.where(which, counts, self._counts)
        everywhere, (means, covs) = which.all(), moments
        self._means = means if everywhere else np.where(which[:, None], means, self._means)
        self._covs = covs if everywhere else np.where(which[:, None, None], covs, self._covs)
        return sentences if lost else None


def _moments(filter_: Filter, session: Any) -> list[Moments]:
    """Means and covariances of a session's belief, of all modes where it has some."""
    if isinstance(filter_, MultipleModelFilter) and hasattr(session, "belief"):
        means, covs, _ = filter_.mode_moments(session.belief())
        return list(zip(means, covs, strict=True))
    return [(session.mean.copy(), session.cov.copy())]


def _states_and_cause(
    filter_: Filter, numbers: np.ndarray | None, before: list[Moments] | None, u, z
) -> tuple[tuple[str, ...], str]:
    """Symbols of the states that were lost in a step, and the cause, of the first mode that has one.

    Args:
        filter_: the filter.
        numbers: the packed parameters that it read, if they are known.
        before: moments before the step, of each mode or of all together; None for the first measurement.
        u: input (p,); None without a prediction.
        z: measurement (m,).
    """
    if (
        filter_.model.turns or filter_.model.measured_turns
    ):  # whose covariance is in another space than the Jacobians that are tried
        return (), UNKNOWN
    modes = filter_.mode_filters if isinstance(filter_, MultipleModelFilter) else ()
    models = [mode.kernel_model for mode in modes] or [_model_of_numbers(filter_.kernel_model, numbers)]
    begun = before if before is None or len(before) == len(models) else before * len(models)
    for j, model in enumerate(models):
        states, cause = likely_cause(model, None if begun is None else begun[j], u, z)
        if cause != UNKNOWN:
            break
    symbols = (state.symbol for state, lost in zip(filter_.model.states, states, strict=True) if lost)
    if cause == UNKNOWN and np.isnan(z).any():
        cause += "; a measurement is missing there, which a page of your own has to mask (mask_missing)"
    return tuple(symbols), f"{cause} in modes[{j}]" if modes and not cause.startswith(UNKNOWN) else cause


def _model_of_numbers(model: StateSpaceModel, numbers: np.ndarray | None) -> StateSpaceModel:
    """The model with the Q, R and constants that a session was set to."""
    if numbers is None or np.array_equal(numbers[: len(model.numbers)], model.numbers):
        return model
    at, n, m, form = number_offsets(model.n, model.m), model.n, model.m, type(model.constants)
    constants = numbers[at.constants : at.constants + model.shape.constants].tolist()
    changes: dict[str, Any] = {
        "process_noise_cov": numbers[at.q : at.q + n * n].reshape(n, n),
        "measurement_noise_cov": numbers[at.r : at.r + m * m].reshape(m, m),
        "constants": form._make(constants) if hasattr(form, "_make") else tuple(constants),
    }
    try:
        return model.replace(**changes)
    except (ValueError, TypeError):  # constants of another form
        return model


def likely_cause(model: StateSpaceModel, before: Moments | None, u, z) -> Flaw:
    """Which states were lost in a step, (n,) bool, and why, by the equations of an extended Kalman filter.

    Args:
        model: the filter's.
        before: mean (n,) and covariance (n, n) before the step; None for the first measurement of the prior.
        u: input (p,) of the step; None without a prediction.
        z: measurement (m,) at its end.
    """
    x, p = (model.prior_mean, model.prior_cov) if before is None else before
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        flaw = None
        if before is not None and u is not None:
            x, p, flaw = _predicted(model, x, p, u)
        return flaw or _updated(model, x, p, u, z)


def _predicted(model: StateSpaceModel, x, p, u) -> tuple[np.ndarray, np.ndarray, Flaw | None]:
    slopes = transition_slopes(model.functions, model.shape)
    for _ in range(model.substeps):
        propagated = _called(model.functions.transition, model.n, as_value(x), as_value(u), model.constants)
        if not np.isfinite(propagated).all():
            return x, p, (~np.isfinite(propagated), f"f(x, u) is {_kind(propagated)}")
        f = _called(slopes, (model.n, model.n), as_value(x), as_value(model.scales), as_value(u), model.constants)
        if not np.isfinite(f).all():
            return x, p, (~np.isfinite(f).all(axis=1), f"F = df/dx is {_kind(f)}")
        x, p = propagated, f @ p @ f.T
    p = p + model.process_noise_cov
    return x, p, _flaw_of(p, "prediction")


def _updated(model: StateSpaceModel, x, p, u, z) -> Flaw:
    everything = np.ones(model.n, dtype=bool)
    fed = model.shape.fed(as_value(np.zeros(model.inputs) if u is None else u))
    expected = _called(model.functions.observe, model.m, as_value(x), *fed, model.constants)
    measured = ~np.isnan(z)
    if not np.isfinite(expected[measured]).all():
        return everything, f"h(x) is {_kind(expected[measured])}"
    slopes = observation_slopes(model.functions, model.shape)
    h = _called(slopes, (model.m, model.n), as_value(x), as_value(model.scales), *fed, model.constants)[measured]
    if not np.isfinite(h).all():
        return ~np.isfinite(h).all(axis=0), f"H = dh/dx is {_kind(h)}"
    s = h @ p @ h.T + model.measurement_noise_cov[np.ix_(measured, measured)]
    try:
        root = np.linalg.cholesky(s)
    except np.linalg.LinAlgError:
        return everything, "the innovation's covariance S is not positive definite, by rounding or overflow"
    half = np.linalg.solve(root, h @ p)
    flaw = _flaw_of(p - half.T @ half, "update")
    return flaw or (~everything, UNKNOWN)


def _flaw_of(p: np.ndarray, when: str) -> Flaw | None:
    if not np.isfinite(p).all():
        return ~np.isfinite(p).all(axis=1), f"the covariance overflows in the {when}"
    if (np.diag(p) < 0.0).any():
        return np.diag(p) < 0.0, f"a variance is negative after the {when}, by rounding"
    return None


def _called(function, shape, *arguments) -> np.ndarray:
    """What a function of the model returns; NaN where it raises."""
    try:
        return np.asarray(function(*arguments), dtype=np.float64).reshape(shape)
    except Exception:  # whatever a user's function raises
        return np.full(shape, np.nan)


def _kind(values: np.ndarray) -> str:
    return "NaN" if np.isnan(values).any() else "infinite, it overflows"


class Starts(NamedTuple):
    """Separate priors for some of B trajectories of a model with n states."""

    free: np.ndarray  # (B,) bool, which trajectories have one; the others begin with the model's prior
    means: np.ndarray  # (B, n)
    covs: np.ndarray  # (B, n, n)
    leads: np.ndarray  # (B,) int, the first row whose innovation counts; 0 for trajectories without
    held: bool = True  # whether these priors stay where parameters move the model's

    def numbers(self, model: StateSpaceModel) -> np.ndarray:
        """The row of numbers of each trajectory's model, (B, count): the model's with other priors."""
        rows, layout, n = np.tile(model.numbers, (len(self.free), 1)), number_offsets(model.n, model.m), model.n
        rows[self.free, layout.prior_mean : layout.prior_mean + n] = self.means[self.free]
        rows[self.free, layout.prior_cov : layout.prior_cov + n * n] = self.covs[self.free].reshape(-1, n * n)
        return rows

    def model(self, model: StateSpaceModel, b: int) -> StateSpaceModel:
        """The model with the prior of one trajectory."""
        if not self.free[b]:
            return model
        return model.replace(prior_mean=self.means[b], prior_cov=self.covs[b])

    @property
    def counted_from(self) -> np.ndarray:
        """The first row of each trajectory that counts, (B,)."""
        return np.where(self.free, self.leads, 0)


def as_the_prior_says(model: StateSpaceModel, count: int) -> Starts:
    """All of `count` trajectories begin with the model's prior."""
    means, covs = np.tile(model.prior_mean, (count, 1)), np.tile(model.prior_cov, (count, 1, 1))
    return Starts(np.zeros(count, dtype=bool), means, covs, np.zeros(count, dtype=np.int64))


def wide_cov(model: StateSpaceModel, reach: np.ndarray) -> np.ndarray:
    """The covariance W = diag(100 P_0,ii + reach_i^2), (n, n), of a start that is free.

    States are taken as independent: those that go together where a run begins at rest need not do so in its midst.

    Args:
        model: with the prior covariance P_0.
        reach: (n,), how far each state may be from the prior mean.
    """
    return np.diag(WIDE**2 * np.diag(model.prior_cov) + reach**2)


def cov_of_measured_starts(model: StateSpaceModel, first: np.ndarray) -> np.ndarray:
    """A prior covariance (n, n) with which a filter begins where its first measurement says.

        A = D^-1 H S,  V = A^+ A,  reach = S max_b |A^+ D^-1 (z_b - h(m_0))|
        P = S (V S^-1 W S^-1 V + (I - V) S^-1 P_0 S^-1 (I - V)) S

    with the prior N(m_0, P_0), H = dh/dx at m_0, the diagonal matrices S of `model.scales` and D of the standard
    deviations in R, and W of `wide_cov`. V is the projection on the observed subspace: there P is wide, so that
    the update with the first measurement replaces the prior; elsewhere it is the prior's.

    Args:
        model: with the prior.
        first: (B, m), the first value of each channel of some runs, NaN where there is none.

    Raises:
        ValueError: if no measurement sees a state at the prior mean.

    Source: Durbin, Koopman (2012), Time Series Analysis by State Space Methods, section 5.2, on diffuse starts.
    """
    x, c, shape = as_value(model.prior_mean), model.given_constants, model.shape
    fed = shape.fed(as_value(np.zeros(model.inputs)))  # none acts before the first measurement
    scales, deviations = model.scales, np.sqrt(np.diag(model.measurement_noise_cov))
    deviations = np.where(deviations > 0, deviations, 1.0)
    h = np.array(observation_slopes(model.functions, shape)(x, as_value(scales), *fed, c)).reshape(
        model.m, model.n
    )
    a = h * scales / deviations[:, None]
    if not (np.isfinite(a).all() and a.any()):
        rule = "a start from the first measurement needs a measurement that depends on a state at the prior mean"
        raise ValueError(f"{rule}, but dh/dx there is {h.tolist()}")
    inverse = np.linalg.pinv(a, rcond=FAINT)
    off = difference(first, np.array(model.functions.observe(x, *fed, c)), shape.measurement_angles) / deviations
    reach = scales * np.abs(np.where(np.isfinite(off), off, 0.0) @ inverse.T).max(axis=0, initial=0.0)
    observed, scaling = inverse @ a, np.outer(scales, scales)
    unseen = np.eye(model.n) - observed
    cov = observed @ (wide_cov(model, reach) / scaling) @ observed + unseen @ (model.prior_cov / scaling) @ unseen
    return (cov + cov.T) / 2 * scaling


def first_measured(measurements: np.ndarray) -> np.ndarray:
    """The first value (B, m) of each channel of measurements (B, K + 1, m); NaN where there is none."""
    first = (~np.isnan(measurements)).argmax(axis=1)
    return np.take_along_axis(measurements, first[:, None], axis=1)[:, 0]


# The first state of a model with rotations: a prior that is wide holds for each attitude alike, but a filter that
# linearises needs one that is near.


def begun_at(model: StateSpaceModel, first: np.ndarray) -> np.ndarray:
    """The most likely states (B, n) at first measurements (B, m), NaN where missing, of the prior N(m_0, P_0).

        min_x |R^-1/2 (z - h(x))|^2 + |P_0^-1/2 difference(x, m_0)|^2

    by damped steps of Gauss and Newton in the tangent, from the best of 24 attitudes of each rotation, and of six
    directions. What the measurement does not determine, such as a heading without a magnetometer, is the prior's.

    Source: Levenberg (1944), "A method for the solution of certain non-linear problems in least squares",
    Quarterly of Applied Mathematics 2(2); tangents: `thruster_env.model.turns`.
    """
    return np.array([_begun_at(model, z) for z in np.atleast_2d(first)])


def _begun_at(model: StateSpaceModel, z: np.ndarray) -> np.ndarray:
    shape, c, of, mean = model.any_shape, model.given_constants, model.turns, model.prior_mean
    fed, scales, measured = shape.fed(as_value(np.zeros(model.inputs))), as_value(model.scales), ~np.isnan(z)
    slopes, steps = observation_slopes(model.functions, shape), cast(Any, turns)  # on arrays
    known, parts, angles = np.diag(model.prior_cov) > 0.0, model.measured_turns, list(shape.measurement_angles)

    def expected(x: np.ndarray) -> np.ndarray:
        return np.array(model.functions.observe(as_value(x), *fed, c))

    if parts:  # in the tangent at the measurement
        centre = np.array(steps.completed(z, expected(mean), parts))
        z = np.array(steps.innovation(z, centre, parts))
        measured, angles = ~np.isnan(z), steps.tangent_flags(angles, parts)
    of_r = np.linalg.cholesky(model.measurement_noise_cov[np.ix_(measured, measured)])
    of_p = np.linalg.cholesky(model.prior_cov[np.ix_(known, known)])

    def residuals(x: np.ndarray) -> np.ndarray:
        y = np.array(steps.difference(expected(x), centre, parts)) if parts else expected(x)
        v = difference(z, y, tuple(angles))
        off = np.array(steps.difference(x, mean, of))
        return np.concatenate([np.linalg.solve(of_r, v[measured]), np.linalg.solve(of_p, off[known])])

    def jacobian(x: np.ndarray) -> np.ndarray:
        h = np.array(slopes(as_value(x), scales, *fed, c)).reshape(model.channels, model.n)
        if parts:
            y = expected(x)
            back = steps.inverse_reset_slopes(centre, steps.difference(y, centre, parts), parts)
            h = np.array(back) @ np.array(steps.slopes_of_tangent(y, parts)) @ h
        h = h @ np.array(steps.slopes_of_stored(x, of))
        off = np.array(steps.inverse_reset_slopes(mean, steps.difference(x, mean, of), of))
        rows = np.linalg.solve(of_r, -h[measured][:, known]), np.linalg.solve(of_p, off[np.ix_(known, known)])
        return np.concatenate(rows)

    def climbed(x: np.ndarray) -> tuple[float, np.ndarray]:
        damping, r = 1e-3, residuals(x)
        for _ in range(STEPS):
            j, step = jacobian(x), np.zeros(model.t)
            normal = j.T @ j
            step[known] = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -j.T @ r)
            further = np.array(steps.move(x, step, of))
            after = residuals(further)
            is_better = bool(np.sum(after**2) < np.sum(r**2))
            if is_better:
                x, r = further, after
            damping = max(damping / 10.0, 1e-12) if is_better else damping * 10.0
            if damping > DAMPINGS or (is_better and np.abs(step).max() < 1e-8):
                break
        return float(np.sum(r**2)), x

    nearest = [mean]
    for turn in of:
        tried = np.concatenate([np.eye(3), -np.eye(3)]) if turn.kind == "direction" else ATTITUDES
        starts = np.repeat(nearest, len(tried), axis=0)
        starts[:, turn.quaternion] = np.tile(tried, (len(nearest), 1))
        nearest = sorted(starts, key=lambda start: float(np.sum(residuals(start) ** 2)))[:MOST_STARTS]
    return min(map(climbed, nearest), key=lambda ended: ended[0])[1]


def _attitudes() -> np.ndarray:
    """The rotations (24, 4) that turn a cube into itself: each face up, then quarter turns about that axis."""
    quarters = [(k * 0.5 * np.pi, 0.0, 0.0) for k in range(4)]
    up = [(0.0, k * 0.5 * np.pi, 0.0) for k in range(4)] + [(0.0, 0.0, 0.5 * np.pi), (0.0, 0.0, -0.5 * np.pi)]
    pairs = product(map(rotations.exponential, up), map(rotations.exponential, quarters))
    return np.array([rotations.product(*pair) for pair in pairs])


ATTITUDES = _attitudes()
