"""Estimators with a network: equations by machine code, gradients, networks, contract, files."""

import copy
import json
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from filters import EstimateState, make_filter, run, thruster_model
from filters.estimators.foreign import is_foreign, label_of
from filters.learned.estimator import Equations, unit_scales
from filters.learned.filters import LEARNED, GainNetwork, KalmanNet, read, write_estimator
from filters.wrappers.envs import EstimateStates
from tests.filters.checks import refused
from tests.models import KEY, pendulum, plane_model, random_affine, simulated
from tests.oracles import each_close, each_equal
from thruster_env.model.affine import affine_model
from tuning.plants.thruster import find_scenario
from tuning.search.space import Choice

GAIN = np.array([[0.3, 0.1], [-0.05, 0.2]])
RUNS, STEPS = 3, 6
KEYS = np.array([KEY, (1, 2), (3, 4)])


@pytest.fixture(scope="module")
def data():
    """Inputs and measurements of the plane model, some of them missing."""
    inputs, z = simulated(plane_model(), STEPS, count=RUNS)
    z[0, 2, 0], z[1, 3] = np.nan, np.nan
    return inputs, z


def made(kind, model=None, **changes):
    """An estimator whose scales are not one, and whose layers have random weights, the last ones included."""
    model = plane_model() if model is None else model
    scales = unit_scales(model)._replace(gain=0.2 * np.ones((model.n, model.m)), corrected=np.full(model.n, 0.3))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        found = LEARNED[kind](model, scales._replace(error=np.full(model.n, 0.7)), **changes)
        with torch.no_grad():
            for one in found.parameters():
                one += 0.1 * torch.randn(one.shape, dtype=one.dtype)
    return found


def tensors(*arrays):
    return [torch.tensor(one, dtype=torch.float64) for one in arrays]


@pytest.mark.parametrize("model", [thruster_model(), pendulum()], ids=["substeps", "angle"])
def test_equations_are_the_models_with_slopes_that_differences_confirm(model, as_python):
    equations, generator = Equations(model.replace(substeps=3)), np.random.default_rng(0)
    x, u = tensors(2.0 + generator.random((4, model.n)), generator.random((4, model.inputs)))
    expected = x.numpy().copy()
    for row, given in zip(expected, u.numpy(), strict=True):
        for _ in range(3):
            row[:] = model.transition(tuple(row), tuple(given), model.constants)
    angles = np.array([one.angle for one in model.states])
    turned = np.where(angles, np.arctan2(np.sin(expected), np.cos(expected)), expected)
    np.testing.assert_allclose(equations.moved(x, u), turned, rtol=1e-12)
    seen = [model.observe(tuple(row), model.constants) for row in x.tolist()]
    np.testing.assert_allclose(equations.measured(x), seen, rtol=1e-12)
    for function in (lambda x: equations.moved(x, u), equations.measured):
        torch.autograd.gradcheck(function, x.requires_grad_(), eps=1e-6, atol=1e-6)


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def recurrent(weights, name, x, h):
    """A gated recurrent unit by Cho et al., as torch documents it."""
    given = weights[f"{name}.weight_ih"] @ x + weights[f"{name}.bias_ih"]
    last = weights[f"{name}.weight_hh"] @ h + weights[f"{name}.bias_hh"]
    size = len(h)
    r = sigmoid(given[:size] + last[:size])
    z = sigmoid(given[size : 2 * size] + last[size : 2 * size])
    return (1.0 - z) * np.tanh(given[2 * size :] + r * last[2 * size :]) + z * h


def layer(weights, name, x):
    return np.maximum(weights[f"{name}.0.weight"] @ x + weights[f"{name}.0.bias"], 0.0)


def test_the_network_of_the_gain_is_that_of_the_paper_s_figure():
    network, generator = GainNetwork(3, 2, 6).double(), np.random.default_rng(1)
    with torch.no_grad():
        for one in network.parameters():
            one.copy_(torch.tensor(0.5 * generator.normal(size=one.shape)))
    weights = {name: one.numpy() for name, one in network.state_dict().items()}
    hidden = [generator.normal(size=size) for size in (9, 9, 4)]
    moved, corrected, measured = (generator.normal(size=size) for size in (3, 3, 4))
    output, after = network(
        tuple(tensors(*(one[None] for one in hidden))),
        *tensors(*(one[None] for one in (moved, corrected, measured))),
    )
    q = recurrent(weights, "q", layer(weights, "of_moved", moved), hidden[0])
    p = recurrent(weights, "p", np.concatenate([q, layer(weights, "of_corrected", corrected)]), hidden[1])
    fed = np.concatenate([layer(weights, "from_p", p), layer(weights, "of_measured", measured)])
    s = recurrent(weights, "s", fed, hidden[2])
    wide = layer(weights, "wide", np.concatenate([p, s]))
    expected = weights["last.weight"] @ wide + weights["last.bias"]
    np.testing.assert_allclose(output[0].detach(), expected, rtol=1e-12)
    back = layer(weights, "back_to_p", np.concatenate([p, layer(weights, "back", np.concatenate([s, expected]))]))
    for found, known in zip(after, (q, back, s), strict=True):
        np.testing.assert_allclose(found[0].detach(), known, rtol=1e-12)


@pytest.mark.parametrize("kind", ["kalmannet", "recursive-kalmannet"])
def test_untrained_a_gain_filter_is_one_of_constant_gain_in_joseph_s_form(kind, data, as_python):
    model, (inputs, z) = plane_model(), data
    a, b, offset, c, shift = model.matrices()
    error = np.array([0.4, 0.9])
    estimator = LEARNED[kind](model, unit_scales(model)._replace(gain=GAIN, error=error))
    found = estimator.run(KEYS, inputs, z)
    noise = np.diag(np.log(2.0) * error) ** 2  # softplus(0) = log 2 on the diagonal of B
    for run_, (u, measured) in enumerate(zip(inputs, z, strict=True)):
        x, p = model.prior_mean, model.prior_cov
        for k in range(STEPS + 1):
            if k:
                x, p = a @ x + b @ u[k - 1] + offset, a @ p @ a.T
            v = np.nan_to_num(measured[k] - c @ x - shift)
            x = x + GAIN @ v
            kept = np.eye(2) - GAIN @ (c * ~np.isnan(measured[k])[:, None])
            p = kept @ p @ kept.T + noise
            each_close((found.mean[run_, k], found.innovation[run_, k]), (x, v), rtol=1e-11)
            if found.cov is not None:
                np.testing.assert_allclose(found.cov[run_, k], p, rtol=1e-11)
    assert (found.cov is not None) == (kind == "recursive-kalmannet")


def test_the_gain_is_the_mean_one_and_the_scaled_output_of_what_changed(data, as_python):
    inputs, z = data
    estimator, model = made("kalmannet"), plane_model()
    a, b, offset, c, shift = model.matrices()
    found = estimator.run(KEYS, inputs, z)
    hidden, before, x, moved, corrected = estimator.gain.start(1), None, model.prior_mean, np.zeros(2), np.zeros(2)
    for k in range(STEPS + 1):
        last = x
        predicted = a @ x + b @ inputs[2, k - 1] + offset if k else x
        v = z[2, k] - c @ predicted - shift
        change = np.zeros(2) if before is None else z[2, k] - before
        features = moved, corrected / 0.3, np.concatenate([change, v])
        output, hidden = estimator.gain(hidden, *tensors(*(np.arcsinh(one)[None] for one in features)))
        gain = 0.2 + 0.7 * output[0].detach().numpy().reshape(2, 2)
        x = predicted + gain @ v
        moved, corrected, before = x - last, gain @ v, z[2, k]
        np.testing.assert_allclose(found.mean[2, k], x, rtol=1e-11)


def test_the_gru_begins_with_the_mean_of_the_states_and_follows_its_equations(data):
    inputs, z = data
    estimator = made("gru", width=5)
    weights = {name: one.numpy() for name, one in estimator.state_dict().items()}
    found, h = estimator.run(KEYS, inputs, z).mean[0], np.zeros(5)
    for k in range(STEPS + 1):
        u = inputs[0, k - 1] if k else np.zeros(1)
        given = np.concatenate([u, np.nan_to_num(z[0, k]), ~np.isnan(z[0, k])])
        h = recurrent(weights, "cell", given, h)
        expected = weights["last.weight"] @ np.concatenate([h, given]) + weights["last.bias"]
        np.testing.assert_allclose(found[k], expected, rtol=1e-11)
    untrained = LEARNED["gru"](plane_model(), unit_scales(plane_model())._replace(state_mean=np.array([4.0, 5.0])))
    np.testing.assert_allclose(untrained.run(KEYS, inputs, z).mean, np.broadcast_to([4.0, 5.0], (3, STEPS + 1, 2)))


@pytest.mark.slow
def test_untrained_the_ensemble_is_the_enkf(data):
    inputs, z = data
    model = plane_model()
    known = run(make_filter("enkf", model, ensemble_size=8), KEYS, inputs, z)
    found = LEARNED["differentiable-enkf"](model, ensemble_size=8).run(KEYS, inputs, z)
    for name, one in zip(("means", "covs", "innovations", "innovation_covs"), found, strict=True):
        np.testing.assert_allclose(one, getattr(known, name), rtol=1e-9, atol=1e-12, err_msg=name)


def test_learned_noise_multiplies_q_by_the_state_and_r_by_the_innovation(data, as_python):
    inputs, z = data
    estimator = made("differentiable-enkf", ensemble_size=6, width=4)
    for layers, bias in ((estimator.of_state, [0.3, -0.2]), (estimator.of_measurement, [0.1, 0.4])):
        with torch.no_grad():
            layers[2].weight.zero_()
            layers[2].bias.copy_(torch.tensor(bias, dtype=torch.float64))
    model = plane_model()
    q, r = (np.diag(np.exp(one)) for one in ([0.3, -0.2], [0.1, 0.4]))
    changed = model.replace(
        process_noise_cov=q @ model.process_noise_cov @ q,
        measurement_noise_cov=r @ model.measurement_noise_cov @ r,
    )
    known = run(make_filter("enkf", changed, ensemble_size=6), KEYS, inputs, z)
    np.testing.assert_allclose(estimator.run(KEYS, inputs, z).mean, known.means, rtol=1e-9)


@pytest.mark.parametrize("kind", LEARNED)
def test_step_by_step_is_at_once_and_a_copy_and_a_pickle_do_the_same(kind, data, as_python):
    inputs, z = data
    estimator = made(kind)
    whole = estimator.run(KEYS, inputs, z)
    for one in (estimator, copy.deepcopy(estimator), pickle.loads(pickle.dumps(estimator))):
        outputs = [one.reset(KEYS[0], z[0, 0])] + [one.step(inputs[0, k], z[0, k + 1]) for k in range(STEPS)]
        for name in ("mean", "cov", "innovation", "innovation_cov"):
            known = getattr(whole, name)
            if known is not None:
                found = [getattr(output, name) for output in outputs]
                np.testing.assert_allclose(found, known[0], rtol=1e-10, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("kind", ["kalmannet", "gru", "differentiable-enkf"])
def test_gradients_along_weights_are_those_of_differences(kind, data, as_python):
    inputs, z = tensors(*data)
    estimator = made(kind)

    def loss():
        track, total = estimator.begin(KEYS, z[:, 0]), 0.0
        for k in range(STEPS):
            track = estimator.advance(track, inputs[:, k], z[:, k + 1])
            total = total + (track.mean**2).sum()
        return total

    loss().backward()
    generator, slope, weights = torch.Generator().manual_seed(2), 0.0, list(estimator.parameters())
    direction = [torch.randn(one.shape, generator=generator, dtype=one.dtype) for one in weights]
    for one, change in zip(weights, direction, strict=True):
        slope += (one.grad * change).sum().item()
    sides = []
    for step in (1e-7, -2e-7):  # shorter than the way to the next kink of a layer
        with torch.no_grad():
            for one, change in zip(weights, direction, strict=True):
                one += step * change
            sides.append(loss().item())
    assert slope == pytest.approx((sides[0] - sides[1]) / 2e-7, rel=1e-6)


def test_covariances_stay_positive_and_lost_estimates_begin_again(data, as_python):
    inputs, z = data
    estimator = made("recursive-kalmannet")
    assert (np.linalg.eigvalsh(estimator.run(KEYS, inputs, z).cov) > 0.0).all()
    with torch.no_grad():
        estimator.gain.last.bias.fill_(1e200)
    z = z.copy()
    z[2, 1] = 1e200
    found = estimator.run(KEYS, inputs, z)
    each_equal((found.mean[2, 1], found.cov[2, 1]), (plane_model().prior_mean, plane_model().prior_cov))


def test_a_file_has_numbers_alone_and_stands_for_the_estimator(tmp_path, data, as_python):
    inputs, z = data
    path, model = tmp_path / "mine.safetensors", plane_model()
    estimator = made("gru", width=7)
    write_estimator(path, estimator, {"problem": "plane"})
    assert is_foreign(path) and label_of(path) == "mine"
    filter_ = make_filter(str(path), model)
    assert filter_.name == "gru" and not filter_.has_covariance
    np.testing.assert_array_equal(run(filter_, KEYS, inputs, z).means, estimator.run(KEYS, inputs, z).mean)
    assert read(path).about["training"] == {"problem": "plane"} and read(path) is read(path)


def test_beside_an_env_and_copies_of_it_a_file_is_an_estimator(tmp_path, as_python):
    path, model = str(tmp_path / "gain.safetensors"), thruster_model()
    write_estimator(path, made("recursive-kalmannet", model), {})
    env = EstimateState(gym.make("BowThruster-v0"), filter=path)
    envs = EstimateStates(gym.make_vec("BowThruster-v0", num_envs=2), filter=path)
    told, several = [env.reset(seed=4)[1]], [envs.reset(seed=3)[1]]
    for _ in range(3):
        told.append(env.step(np.array([2.0], dtype=np.float32))[4])
        several.append(envs.step(np.full((2, 1), 2.0, dtype=np.float32))[4])
    z = np.array([info["measurement"] for info in told])[None]
    found = read(path)(env.unwrapped.state_space_model()).run(KEYS[:1], np.full((1, 3, 1), 2.0), z)
    for k, (one, both) in enumerate(zip(told, several, strict=True)):
        for name, part in (
            ("estimate", found.mean),
            ("estimate_cov", found.cov),
            ("innovation", found.innovation),
        ):
            each_close((one[name], both[name][1]), (part[0, k], one[name]), rtol=1e-9)


def test_a_file_of_another_model_or_none_at_all_is_refused(tmp_path, as_python):
    path = tmp_path / "gain.safetensors"
    write_estimator(path, made("kalmannet"), {})
    with pytest.raises(ValueError, match="must be used with the model that it was trained with"):
        read(path)(plane_model(state_offset=[0.0, 0.0]))
    assert isinstance(read(path)(plane_model(process_noise_cov=[1.0, 1.0])), KalmanNet)
    refused("must be a file, but there is none", read, tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("nothing")
    refused("must be one of `thruster train-estimator`", read, tmp_path / "text.safetensors")
    numbers = load_file(path)
    known = read(path).about
    wrong = {"kind": "os.system"}, {"options": 3}, {"options": {"width": 10**9}}, {"sizes": None}, {"model": "0"}
    for about in ({}, {"estimator": "[]"}, *({"estimator": json.dumps(known | one)} for one in wrong)):
        save_file(numbers, tmp_path / "other.safetensors", about)
        with pytest.raises(ValueError, match="must be"):
            read(tmp_path / "other.safetensors")(plane_model(state_offset=[0.0, 0.0]))
    save_file(
        {**numbers, "gain.last.bias": np.zeros(3)}, tmp_path / "odd.safetensors", {"estimator": json.dumps(known)}
    )
    with pytest.raises(ValueError, match="must have the numbers of a kalmannet"):
        read(tmp_path / "odd.safetensors")(plane_model())


def test_a_file_of_another_preset_names_both_and_the_constants_that_differ(tmp_path, as_python):
    path = tmp_path / "gain.safetensors"
    own, other = (find_scenario("nominal").replace(preset=preset) for preset in ("tunnel", "t200"))
    write_estimator(path, made("kalmannet", own.model()), {"problem": "nominal", "plant": own.plant_data})
    with pytest.raises(ValueError, match=r"that of nominal, but that had motor_damping .* \(here .*\)"):
        read(path)(other.model())
    with pytest.raises(ValueError, match=r"gain.safetensors was tuned for preset tunnel \(here t200\)"):
        Choice(str(path), {}, {}).filter(other)


def test_a_gru_is_refused_for_other_quantities_and_for_other_equations_of_unnamed_ones(tmp_path, as_python):
    def plant(a=0.9, named=True, **changes):
        names = {
            "states": [("temperature", "T", "K")],
            "input_quantities": [("power", "P", "W")],
            "measurements": [("reading", "r", "K")],
        }
        names = names if named else {}
        noise = {"process_noise_cov": [0.01], "measurement_noise_cov": [1.0]}
        known = {"b": [[0.5]], "c": [[1.0]], "prior_mean": [0.0], "prior_cov": [1.0], **noise}
        return affine_model(a=[[a]], **{**known, **names, **changes})

    path = tmp_path / "gru.safetensors"
    write_estimator(path, made("gru", plant(), width=3), {})
    for model in (plant(), plant(a=0.8), plant(measurement_noise_cov=[4.0])):
        assert read(path)(model).name == "gru"
    for change, told in (
        ({"states": [("speed", "v", "m/s")]}, r"T \[K\], but got v \[m/s\]"),
        ({"measurements": [("reading", "r", "degC")]}, r"r \[K\], but got r \[degC\]"),
        ({"input_quantities": [("power", "P", "kW")]}, r"P \[W\], but got P \[kW\]"),
        ({"named": False}, r"T \[K\], but got x_1"),
    ):
        with pytest.raises(ValueError, match=f"the model that it was trained with, {told}$"):
            read(path)(plant(**change))
    write_estimator(tmp_path / "plain.safetensors", made("gru", plant(named=False), width=3), {})
    assert read(tmp_path / "plain.safetensors")(plant(named=False)).name == "gru"
    with pytest.raises(ValueError, match="the model that it was trained with, but that had other equations$"):
        read(tmp_path / "plain.safetensors")(plant(a=0.8, named=False))
    about = {key: value for key, value in read(path).about.items() if key != "quantities"}  # as older files
    save_file(load_file(path), tmp_path / "old.safetensors", {"estimator": json.dumps(about)})
    assert read(tmp_path / "old.safetensors")(plant()).name == "gru"
    with pytest.raises(ValueError, match="the model that it was trained with"):
        read(tmp_path / "old.safetensors")(plant(a=0.8))


def test_unknown_and_wrong_options_are_refused():
    with pytest.raises(ValueError, match="width must be a whole number of at least 2, but got 1"):
        LEARNED["gru"](plane_model(), width=1)
    refused("an option of kalmannet", KalmanNet, plane_model(), size=3)
    refused("at most 16 states and measurements, but got 17 and 2", KalmanNet, random_affine(n=17))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(tmp_path, as_python, value):
    path, estimator = tmp_path / "gain.safetensors", made("gru", width=7)
    name, numbers = next(iter(estimator.state_dict().items()))
    numbers.view(-1)[0] = value
    write_estimator(path, estimator, {})
    refused(f"{name} must be finite, but have NaN or infinity", read, path)


def test_numbers_of_other_shapes_are_refused_in_one_line(tmp_path, as_python):
    path = tmp_path / "gain.safetensors"
    write_estimator(path, made("gru", width=7), {})
    found = read(path)
    found._options["width"] = 5
    refused("must have the numbers of a gru, but: size mismatch", found, plane_model())
