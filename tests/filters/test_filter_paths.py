"""One result on every path: compiled or not, batch, blocks or loop, in steps, in a session, wrapped."""

import numpy as np
import pytest

from filters import (
    FILTERS,
    ExtendedKalmanFilter,
    SageHusaFilter,
    UnscentedKalmanFilter,
    make_filter,
    run,
    thruster_model,
)
from filters.engine.compile import GROUPS
from filters.engine.session import Session
from filters.registry import filter_type
from tests.filters.checks import refused
from tests.filters.test_wrapper import ADDED, infos_of, played, voltages, wrapped
from tests.models import KEY, MODELS, OF_EACH_KIND, scalar_model, simulated, small, varying_noise
from tests.oracles import each_close, equal
from tests.slow import SLOW
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.model import simulate
from thruster_env.model.shape import LANES
from thruster_env.thruster.equations import simulate as simulate_plant
from thruster_env.thruster.plant import make_plant


def stepped(filter_, key, inputs, measurements):
    """The beliefs and innovations of one trajectory, by init, predict and update."""
    belief, innovation = filter_.update(filter_.init(key), measurements[0])
    found = [(belief, innovation)]
    for u, z in zip(inputs, measurements[1:], strict=True):
        belief, innovation = filter_.update(filter_.predict(belief, u), z)
        found.append((belief, innovation))
    return found


def in_session(filter_, key, inputs, measurements):
    """Rows (mean, cov, innovation, its cov) of one trajectory, by a session."""
    session = Session(filter_)
    parts = session.mean, session.cov, session.innovation, session.innovation_cov
    session.start(key, measurements[0])
    rows = [[part.copy() for part in parts]]
    for u, z in zip(inputs, measurements[1:], strict=True):
        session.step(u, z)
        rows.append([part.copy() for part in parts])
    return [np.array(part) for part in zip(*rows, strict=True)]


compiled_names = pytest.mark.parametrize("name", OF_EACH_KIND)  # as Python, every filter takes every path


@pytest.fixture(params=list(FILTERS))
def name(request):
    return request.param


@pytest.fixture(params=list(MODELS))
def model(request):
    return MODELS[request.param]()


def assert_paths_agree(filter_, key, inputs, measurements):
    """Batch, loop and session give one trajectory alike."""
    close = {"rtol": 1e-12, "atol": 1e-12}
    estimates = run(filter_, np.array([key]), inputs, measurements)
    found = stepped(filter_, key, inputs[0], measurements[0])
    np.testing.assert_allclose(estimates.means[0], [belief.mean for belief, _ in found], **close)
    np.testing.assert_allclose(estimates.covs[0], [belief.cov for belief, _ in found], **close)
    np.testing.assert_allclose(estimates.innovations[0], [i.value for _, i in found], **close)
    np.testing.assert_allclose(estimates.innovation_covs[0], [i.cov for _, i in found], **close)
    np.testing.assert_allclose(estimates.log_likelihoods[0], [i.log_likelihood for _, i in found], **close)
    for part, of_session in zip(estimates[:4], in_session(filter_, key, inputs[0], measurements[0]), strict=True):
        np.testing.assert_allclose(part[0], of_session, **close)


@pytest.mark.usefixtures("as_python")
def test_batch_loop_and_session_agree(name, model):
    filter_ = small(name, model)
    inputs, measurements = simulated(model, 20)
    measurements[0, 3] = measurements[0, 7, 0] = np.nan
    assert_paths_agree(filter_, KEY, inputs, measurements)


def diverging(name):
    """A filter whose model overflows every second step, or every step if it needs a steady gain, with data."""
    a, b = (0.5, 1e200) if name == "kf-steady" else (1e180, 1.0)
    model = scalar_model(a=[[a]], b=[[b]], c=[[1.0]], prior_mean=[1.0])
    return small(name, model), np.full((1, 6, 1), b), np.ones((1, 7, 1))


@pytest.mark.usefixtures("as_python")
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # Python says so when a number overflows
def test_a_diverging_filter_restarts_and_counts_and_is_never_nan(name):
    filter_, inputs, measurements = diverging(name)
    estimates = run(filter_, np.array([KEY]), inputs, measurements)
    found = stepped(filter_, KEY, inputs[0], measurements[0])
    assert estimates.divergences.tolist() == [found[-1][0].divergences]
    assert 1 <= estimates.divergences[0] <= 6
    for part in estimates:
        assert not np.isnan(part).any()
    assert np.isfinite(estimates.means).all() and np.isfinite(estimates.covs).all()
    np.testing.assert_array_equal(estimates.means[0], [belief.mean for belief, _ in found])
    np.testing.assert_array_equal(estimates.covs[0], [belief.cov for belief, _ in found])
    assert all(np.isfinite(innovation.value).all() for _, innovation in found)


def assert_compiled_as_python(filter_, *data, **noise):
    """Compiled and as Python, a batch is the same."""
    compiled = run(filter_, *data, **noise)
    with interpreted():
        as_python = run(filter_, *data, **noise)
    each_close(compiled, as_python, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *(pytest.param(name, "thruster", marks=() if name in OF_EACH_KIND else SLOW) for name in FILTERS),
        *(pytest.param(name, "wide affine", marks=SLOW) for name in ("kf-steady", "ukf", "vb", "enkf", "pf")),
    ],
)
def test_compiled_and_interpreted_agree(name, kind):
    model = MODELS[kind]()
    filter_ = small(name, model)
    inputs, measurements = simulated(model, 25)
    measurements[0, 3] = measurements[0, 7, 0] = np.nan
    data = np.array([KEY]), inputs, measurements
    assert_compiled_as_python(filter_, *data)
    if filter_.varying_noise:
        assert_compiled_as_python(filter_, *data, **varying_noise(model, 25))


ADAPTIVE = {"adaptive_inflation": 0.3, "inflation": 1.02}
WITH_PARAMETERS = [  # each compiles what the defaults do not
    ("kf", "thruster", {"schedule": 5}),
    ("fuzzy", "thruster", {"blending": "moments"}),
    ("fuzzy", "thruster", {"blending": "output"}),
    ("enkf", "thruster", {"inflation": 1.05, "relaxation": 0.4}),
    ("ienkf", "thruster", {"inflation": 1.05, "relaxation": 0.4}),
]
SELDOM = [
    ("ienkf", "wide affine", {"inflation": 1.05, "relaxation": 0.2, "window": 2}),
    ("rhf", "wide affine", {"inflation": 1.02, "relaxation": 0.3}),
    ("etkf", "wide affine", {**ADAPTIVE, "rotations": 1}),
    ("etkf", "wide affine", {**ADAPTIVE, "inflation_by_state": 1}),
    ("etkf", "wide affine", {**ADAPTIVE, "inflation_by_state": 1, "least_deviation": 0.05}),
    ("pf", "wide affine", {"proposal": "optimal", "resampling": "gaussian", "resampling_threshold": 0.9}),
]


def with_parameters(name, kind, numbers):
    size = {"ensemble_size": 10} if filter_type(name).has_ensemble else {}
    return make_filter(name, MODELS[kind](), **size, **numbers)


@pytest.mark.parametrize("case", [*WITH_PARAMETERS, *(pytest.param(case, marks=SLOW) for case in SELDOM)])
def test_compiled_and_interpreted_agree_with_parameters(case):
    filter_ = with_parameters(*case)
    inputs, measurements = simulated(filter_.model, 12, count=3, missing=0.2)
    noise = varying_noise(filter_.model, 12) if "window" in case[2] else {}
    assert_compiled_as_python(filter_, filter_keys(range(3)), inputs, measurements, **noise)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("case", [*WITH_PARAMETERS, *SELDOM])
def test_batch_loop_and_session_agree_with_parameters(case):
    filter_ = with_parameters(*case)
    inputs, measurements = simulated(filter_.model, 20, missing=0.2)
    assert_paths_agree(filter_, KEY, inputs, measurements)


@compiled_names
def test_compiled_batch_loop_and_session_agree_over_500_steps(name):
    model = thruster_model()
    inputs, measurements = simulated(model, 500, level=8.0)
    measurements[0, 100:120] = np.nan
    assert_paths_agree(small(name, model), KEY, inputs, measurements)


@compiled_names
def test_a_wrapped_run_is_the_batch_run(name):
    seed, actions = 11, voltages(500)
    env = wrapped(name)
    _, _, infos = played(env, actions, seed)
    drawn = simulate_plant(make_plant(), episode_keys([seed]), actions.T.astype(np.float64))
    np.testing.assert_allclose(infos_of("measurement", infos), drawn.measurements[0], rtol=1e-12, atol=1e-12)
    numbers = {"ensemble_size": 20} if name == "enkf" else {}
    inputs = actions[None].astype(np.float64)
    estimates = run(
        make_filter(name, thruster_model(), **numbers), filter_keys([seed]), inputs, drawn.measurements
    )
    for part, estimate in zip(ADDED, estimates, strict=False):
        np.testing.assert_allclose(infos_of(part, infos), estimate[0], rtol=1e-12, atol=1e-12, err_msg=part)


@compiled_names
def test_a_trajectory_does_not_depend_on_its_company(name):
    model = thruster_model()
    inputs, measurements = simulated(model, 30, count=19)
    keys, filter_ = filter_keys(range(19)), small(name, model)
    together = run(filter_, keys, inputs, measurements)
    backwards = run(filter_, keys[::-1], inputs[::-1], measurements[::-1])
    assert equal(together, [part[::-1] for part in backwards])
    for b in range(19):
        alone = run(filter_, keys[b : b + 1], inputs[b : b + 1], measurements[b : b + 1])
        assert equal(alone, [part[b : b + 1] for part in together])


@pytest.mark.usefixtures("as_python")
def test_the_same_key_gives_the_same_numbers_and_only_ensembles_use_it(name):
    model = thruster_model()
    inputs, measurements = simulated(model, 30)
    filter_ = small(name, model)
    first, again, other = (run(filter_, filter_keys([s]), inputs, measurements) for s in (1, 1, 2))
    assert equal(first, again)
    assert (filter_.size > 0) == (not np.array_equal(first.means, other.means))


@pytest.mark.parametrize(
    ("keys", "inputs", "measurements", "rule"),
    [
        ((3, 2), (2, 5, 1), (2, 6, 1), "shapes"),
        ((2, 1), (2, 5, 1), (2, 6, 1), "shapes"),
        ((2, 2), (2, 6, 1), (2, 6, 1), "shapes"),
        ((2, 2), (2, 5, 2), (2, 6, 1), "shapes"),
        ((2, 2), (2, 5, 1), (2, 6, 2), "shapes"),
        ((2, 2), (2, 5), (2, 6), r"of one trajectory must have shape \(K \+ 1, 1\)"),
        ((2, 2), (2, 0, 1), (2, 0, 1), "at least one row"),
    ],
)
def test_a_batch_whose_shapes_do_not_fit_is_refused(keys, inputs, measurements, rule):
    data = np.zeros(keys), np.zeros(inputs), np.zeros(measurements)
    refused(rule, run, make_filter("ekf", thruster_model()), *data)


@pytest.mark.parametrize(("u", "z"), [(np.nan, 0.0), (np.inf, 0.0), (0.0, np.inf)])
def test_a_batch_with_numbers_that_are_not_finite_is_refused(u, z):
    with pytest.raises(ValueError, match="inputs must be finite, and measurements finite or NaN"):
        run(make_filter("ekf", thruster_model()), np.zeros((1, 2)), np.full((1, 1, 1), u), np.full((1, 2, 1), z))


@pytest.mark.usefixtures("as_python")
def test_a_batch_of_no_trajectories_gives_no_estimates(name):
    estimates = run(small(name, thruster_model()), np.zeros((0, 2)), np.zeros((0, 5, 1)), np.zeros((0, 6, 1)))
    assert estimates.means.shape == (0, 6, 2)
    assert estimates.divergences.shape == (0,)


BLOCK = GROUPS * LANES
COUNTS = [1, LANES - 1, LANES, LANES + 1, BLOCK, BLOCK + 1, 3 * BLOCK + 5]


def simulated_thruster(count, steps=12):
    model = thruster_model()
    inputs = np.random.default_rng(4).uniform(-12, 12, size=(count, steps, 1))
    with interpreted():
        drawn = simulate.simulate(model, episode_keys(range(count)), inputs)
    return model, (np.zeros((count, 2)), inputs, drawn.measurements)


@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, UnscentedKalmanFilter, SageHusaFilter])
def test_blocks_that_are_full_or_not_hold_the_same_estimates(kind):
    model, data = simulated_thruster(max(COUNTS))
    data[2][3, 5] = np.nan
    together = run(kind(model=model), *data)
    for count in COUNTS:
        for part, of_all in zip(run(kind(model=model), *(array[:count] for array in data)), together, strict=True):
            np.testing.assert_array_equal(part, of_all[:count])
    with interpreted():
        one_by_one = run(kind(model=model), *(array[:5] for array in data))
    for part, of_all in zip(one_by_one, together, strict=True):
        np.testing.assert_allclose(part, of_all[:5], rtol=1e-12, atol=1e-12)


def test_what_one_trajectory_loses_no_other_misses():
    model, (keys, inputs, z) = simulated_thruster(BLOCK)
    before = run(ExtendedKalmanFilter(model=model), keys, inputs, z)
    z[7, 4] = 1e200  # its innovation is as large, and the estimate overflows in the next step
    after = run(ExtendedKalmanFilter(model=model), keys, inputs, z)
    others = np.arange(BLOCK) != 7
    assert after.divergences[7] >= 1 and np.isfinite(after.means).all()
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one[others], other[others])


def test_noise_of_single_steps_is_that_of_every_trajectory():
    model, (keys, inputs, z) = simulated_thruster(BLOCK + 3)
    factors = np.random.default_rng(2).uniform(0.1, 10.0, size=(z.shape[1], 1, 1))
    noise = {
        "process_noise_covs": factors[1:] * model.process_noise_cov,
        "measurement_noise_covs": factors * model.measurement_noise_cov,
    }
    filter_ = ExtendedKalmanFilter(model=model)
    estimates = run(filter_, keys, inputs, z, **noise)
    r = noise["measurement_noise_covs"]
    for b in (0, BLOCK - 1, BLOCK + 2):
        belief, _ = filter_.update(filter_.init(), z[b, 0], measurement_noise_cov=r[0])
        for k, u in enumerate(inputs[b]):
            belief = filter_.predict(belief, u, process_noise_cov=noise["process_noise_covs"][k])
            belief, _ = filter_.update(belief, z[b, k + 1], measurement_noise_cov=r[k + 1])
        np.testing.assert_allclose(belief.mean, estimates.means[b, -1], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(belief.cov, estimates.covs[b, -1], rtol=1e-12, atol=1e-12)
