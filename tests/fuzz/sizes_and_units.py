"""Attacks by sizes and units: 1 to 12 states, 1 to 16 sensors, and units that differ by 18 orders of magnitude."""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

import filters
from filters import EstimateState, Inversion, make_filter, run, smooth
from filters.filter import Filter
from filters.logs.estimate import estimate_with
from filters.registry import FILTERS
from tests.filters.test_c import built, estimated
from tests.fuzz.python_interface import _line, _until
from tests.models import KEY, random_affine, rescaled, small
from tests.oracles import kalman_filter
from thruster_env.core.checks import covariance
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import filter_keys
from thruster_env.env.model_env import ModelEnv
from thruster_env.logs.log import Log
from thruster_env.model.affine import AffineModel
from thruster_env.model.state_space import StateSpaceModel

EXACT = {
    "kf": {"form": ("covariance", "square-root", "ud", "information")},
    "ekf": {"form": ("covariance", "square-root", "ud")},
    "ukf": {"form": ("covariance", "square-root")},
    "mhe": {"loss": ("quadratic",), "horizon": (1, 3, 10)},
    **{name: {} for name in ("iekf", "ckf", "schmidt", "fuzzy")},
}
IN_C = ("kf", "ekf", "iekf", "ukf", "ckf", "fading", "ekf-robust", "vb")
ON_TENSORS = (*IN_C, "enkf", "etkf")
OF_ONE_STEP = ("kf", "kf-steady", "imm", "mmae", "fuzzy")  # refuse another dt
SMOOTHED = ("kf", "ekf", "ukf", "ckf", "iekf", "enkf", "imm", "mmae")


class Clock(NamedTuple):
    """The constants of a model of any step length."""

    dt: float


def sizes(rng: np.random.Generator, seconds: float) -> str:
    """Every filter on every path has the same numbers, and Kalman's where it is exact."""
    counts: Counter = Counter()
    for name, _ in zip(_names(rng), _until(seconds), strict=False):
        n, m = int(rng.integers(1, 13)), int(rng.integers(1, 17))
        model, inputs, z = drawn(rng, n, m)
        filter_ = made(rng, name, model)
        where = f"{name} {getattr(filter_, 'form', '')} of {n} states and {m} sensors"
        with interpreted(), warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                _compare_paths(rng, name, filter_, inputs, z)
            except Exception as error:
                raise AssertionError(f"{where}: {error!r}") from error
        counts["compared"] += 1
        counts["exact"] += name in EXACT
    return _line("filters of any size", counts)


def units(rng: np.random.Generator, seconds: float) -> str:
    """A scaling of states and channels changes no estimate, and accepts and refuses the same covariances."""
    counts: Counter = Counter()
    for name, _ in zip(_names(rng), _until(seconds), strict=False):
        n, m = int(rng.integers(1, 6)), int(rng.integers(1, 5))
        with interpreted():
            _compare_units(rng, name, n, m)
        counts["estimates"] += 1
        counts[_compare_checks(rng, n)] += 1
    return _line("changes of units", counts)


def drawn(rng: np.random.Generator, n: int, m: int) -> tuple[StateSpaceModel, np.ndarray, np.ndarray]:
    """An affine model, and inputs (2, 4, 2) and measurements (2, 5, m) of which some are missing."""
    model, z = random_affine(n, m, 2, seed=int(rng.integers(2**31))), 3.0 * rng.normal(size=(2, 5, m))
    z[rng.random(z.shape) < 0.15] = np.nan
    z[0, 3] = np.nan
    return model, rng.normal(size=(2, 4, 2)), z


def timed(model: AffineModel) -> StateSpaceModel:
    """The same as x + dt (f(x, u) - x), with dt = 1 s among its constants."""
    (a, b, offset, c, shift), n = model.matrices(), model.n
    a = a - np.eye(n)

    def transition(x, u, constants):
        rates = _sums(a, x, _sums(b, u, offset))
        return tuple(x[i] + constants.dt * rates[i] for i in range(n))

    def observe(x, constants):
        return tuple(_sums(c, x, shift))

    return StateSpaceModel(
        transition=transition,
        observe=observe,
        process_noise_cov=model.process_noise_cov,
        measurement_noise_cov=model.measurement_noise_cov,
        prior_mean=model.prior_mean,
        prior_cov=model.prior_cov,
        inputs=model.inputs,
        constants=Clock(1.0),
        operating_state=np.zeros(n),
        operating_input=np.zeros(model.inputs),
        **model.quantities._asdict(),
    )


def _sums(matrix: np.ndarray, x, more) -> list:
    """M x + a, number by number, as a model may have it."""
    rows = zip(matrix.tolist(), list(more), strict=True)
    return [sum((m * x[j] for j, m in enumerate(row)), one) for row, one in rows]


def made(rng: np.random.Generator, name: str, model: StateSpaceModel) -> Filter:
    """A filter by name, of any of its exact forms."""
    chosen = {key: one[rng.integers(len(one))] for key, one in EXACT.get(name, {}).items()}
    if name == "fuzzy":
        chosen = {"low": np.full(model.n, -5.0), "high": np.full(model.n, 5.0), "premises": [0]}
    return make_filter(name, model, **chosen) if chosen else small(name, model)


def _names(rng: np.random.Generator) -> Iterator[str]:
    while True:
        yield from rng.permutation(list(FILTERS))


def _compare_paths(
    rng: np.random.Generator, name: str, filter_: Filter, inputs: np.ndarray, z: np.ndarray
) -> None:
    model, keys = filter_.model, np.array([KEY, (3, 4)])
    found = run(filter_, keys, inputs, z)
    assert np.isfinite(found.means).all() and not found.divergences.any()
    if name in EXACT:
        for b in range(2):
            means, covs, levels = kalman_filter(model, inputs[b], z[b])
            _same(found.means[b], means)
            _same(found.covs[b], covs)
            _same(found.log_likelihoods[b], levels)
    belief, session = filter_.init(KEY), filter_.session()
    session.start(KEY, z[0, 0])
    for k, one in enumerate(z[0]):
        if k:
            belief = filter_.predict(belief, inputs[0, k - 1])
            session.step(inputs[0, k - 1], one)
        belief, innovation = filter_.update(belief, one)
        _same(session.mean, found.means[0, k])
        _same(belief.mean, found.means[0, k])
        _same(belief.cov, found.covs[0, k])
        _same(innovation.value, found.innovations[0, k])
    if name in SMOOTHED:
        smoothed = smooth(filter_, keys, inputs, z)
        _same(smoothed.means[:, -1], found.means[:, -1])
    if name in ON_TENSORS and getattr(filter_, "form", "") != "ud" and rng.random() < 0.3:
        _same(np.asarray(filters.torch(filter_).run(inputs, z, keys).means), found.means)
    if name in IN_C and shutil.which("gcc") and rng.random() < 0.1:
        with tempfile.TemporaryDirectory() as folder:
            program = built(filter_, Path(folder), flags=("-O0",))
            (means, *_), *_ = estimated(program, model, inputs[0], z[0])
        _same(means, found.means[0])
    if rng.random() < 0.2:
        _compare_wrapper(filter_, rng)
    if rng.random() < 0.3:
        _compare_log(name, filter_, inputs[0], z[0])
    if rng.random() < 0.3:
        _compare_clock(dataclasses.replace(filter_, model=timed(model)), inputs[0], z[0])


def _compare_log(name: str, filter_: Filter, inputs: np.ndarray, z: np.ndarray) -> None:
    """`estimate` of a log on a grid, and its smoother."""
    keys, log = filter_keys([0]), _log(filter_.model, inputs, z)
    found, expected = estimate_with(filter_, log), run(filter_, keys, inputs[None], z[None])
    _same(found.means, expected.means[0])
    _same(found.covs, expected.covs[0])
    _same(found.innovations, np.where(np.isnan(z), np.nan, expected.innovations[0]))
    if filter_.has_covariance:
        _same(found.log_likelihoods, expected.log_likelihoods[0])
    if name in SMOOTHED:
        smoothed = smooth(filter_, keys, inputs[None], z[None])
        _same(estimate_with(filter_, log, smoother=True).means, smoothed.means[0])


def _compare_clock(filter_: Filter, inputs: np.ndarray, z: np.ndarray) -> None:
    """`live()`, and `estimate` of a log on its own stamps, of the model's dt; or a refusal in one line."""
    log = _log(filter_.model, inputs, z, stamps=np.arange(len(z), dtype=float))
    keys = filter_keys([0])
    try:
        live = filter_.live()
    except ValueError as error:
        assert filter_.name in OF_ONE_STEP and "\n" not in str(error), error
        return
    expected, found = run(filter_, keys, inputs[None], z[None]), estimate_with(filter_, log)
    live.start(100.0, z[0], keys[0])
    for k, u in enumerate(inputs, 1):
        live.predict_to(100.0 + k, u)
        live.update(100.0 + k, None, z[k])
        _same(live.mean, expected.means[0, k])
        _same(live.cov, expected.covs[0, k])
        _same(live.innovation_cov, expected.innovation_covs[0, k])
    _same(found.means, expected.means[0])
    _same(found.covs, expected.covs[0])


def _log(model: StateSpaceModel, inputs: np.ndarray, z: np.ndarray, **stamps: np.ndarray) -> Log:
    return Log("log", 1.0, inputs, z, model.input_quantities, model.measurements, **stamps)


def _compare_wrapper(filter_: Filter, rng: np.random.Generator) -> None:
    env = EstimateState(ModelEnv(filter_.model, filter_.model, low=-1.0, high=1.0, dt=1.0), filter_)
    estimate, info = env.reset(seed=1)
    seen, actions = [info["measurement"]], rng.uniform(-1.0, 1.0, size=(3, filter_.model.inputs))
    for action in actions:
        estimate, _, _, _, info = env.step(action)
        seen.append(info["measurement"])
    found = run(filter_, np.array([info["key"]]) if "key" in info else None, actions[None], np.array(seen)[None])
    if not filter_.size:  # others follow from the wrapper's own key
        np.testing.assert_allclose(estimate, found.means[0, -1], rtol=1e-5, atol=1e-5 * abs(found.means).max())


def _compare_units(rng: np.random.Generator, name: str, n: int, m: int) -> None:
    model, inputs, z = drawn(rng, n, m)
    filter_ = made(rng, name, model)
    states, channels = 10.0 ** rng.uniform(-9.0, 9.0, n), 10.0 ** rng.uniform(-9.0, 9.0, m)
    other = rescaled(model, states, channels)
    changed: dict = {"low": filter_.low * states, "high": filter_.high * states} if name == "fuzzy" else {}
    if isinstance(filter_, Inversion):
        changed = {"reach": None}
    keys = np.array([KEY, (3, 4)])
    before = run(filter_, keys, inputs, z)
    after = run(dataclasses.replace(filter_, model=other, **changed), keys, inputs, z * channels)
    where = f"{name} {getattr(filter_, 'form', '')}, states times {states}, channels times {channels}"
    spread = np.sqrt(np.einsum("bkii->bki", before.covs)) + abs(before.means)
    assert (before.divergences == after.divergences).all(), where
    off = abs(after.means / states - before.means) / spread
    assert off.max() < 1e-9 * max(1.0, _condition(model)), f"{where}: off by {off.max():.2g} standard deviations"


def _condition(model: StateSpaceModel) -> float:
    """What rounding is multiplied by, about."""
    covs = model.prior_cov, model.measurement_noise_cov
    return float(
        np.prod([np.linalg.cond(one / np.sqrt(np.outer(np.diag(one), np.diag(one)))) for one in covs]) / 1e3
    )


def _compare_checks(rng: np.random.Generator, n: int) -> str:
    half = rng.normal(size=(n, n))
    cov = half @ half.T
    if rng.random() < 0.5:  # hardly one any more, or no more
        cov -= rng.uniform(0.0, 2.0) * np.linalg.eigvalsh(cov)[0] * np.eye(n)
    if rng.random() < 0.1:
        cov[0, 0] = 0.0
    scales = 10.0 ** rng.uniform(-9.0, 9.0, n)
    found = [_accepted(one, n) for one in (cov, cov * np.outer(scales, scales))]
    assert found[0] == found[1], f"{cov.tolist()} is accepted: {found[0]}, times {scales}: {found[1]}"
    return "accepted" if found[0] else "refused"


def _accepted(cov: np.ndarray, n: int) -> bool:
    try:
        covariance("it", cov, n)
    except ValueError:
        return False
    return True


def _same(found: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7 * max(1.0, abs(np.asarray(expected)).max()))
