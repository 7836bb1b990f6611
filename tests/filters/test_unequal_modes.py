"""Modes of fewer states than the model: a naive filter of unequal sizes, a bias, angles, what is refused."""

from contextlib import nullcontext

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import StateSpaceModel, Unknown, affine_model, augmented_model, make_filter, run
from tests.filters.checks import refused
from tests.filters.test_multiple_models import merged
from tests.models import wide_model
from tests.oracles import each_close
from tests.thruster_env.core.test_angles import RATE, turning
from thruster_env.core.compiled import interpreted
from thruster_env.thruster.model import thruster_model

DT = 0.5
QUANTITIES = {"p": ("position", "p", "m"), "v": ("speed", "v", "m/s"), "a": ("acceleration", "a", "m/s^2")}
A = {"p": {"p": 1.0, "v": DT, "a": DT**2 / 2}, "v": {"v": 1.0, "a": DT}, "a": {"a": 1.0}}
NOISE = {"p": DT**2 / 2, "v": DT, "a": 1.0}


def moving(symbols, q, r=1.0, start=0.0):
    """A point with some of position, speed and acceleration, in any order; its position is measured."""
    g = np.array([[NOISE[one] for one in symbols]])
    n = len(symbols)
    return affine_model(
        a=[[A[to].get(of, 0.0) for of in symbols] for to in symbols],
        b=np.zeros((n, 1)),
        c=[[float(one == "p") for one in symbols]],
        process_noise_cov=q * g.T @ g + 1e-6 * np.eye(n),
        measurement_noise_cov=[[r]],
        prior_mean=np.full(n, start),
        prior_cov=np.eye(n) + 0.1,
        states=[QUANTITIES[one] for one in symbols],
    )


def kalman(model):
    """Functions predict(x, P, u) and update(x, P, z) of an affine model in NumPy."""
    a, _, _, c, _ = model.matrices()

    def update(x, p, z):
        s = c @ p @ c.T + model.measurement_noise_cov
        gain = np.linalg.solve(s, c @ p).T
        return x + gain @ (z - c @ x), p - gain @ s @ gain.T, multivariate_normal.logpdf(z, c @ x, s)

    return lambda x, p, u: (a @ x, a @ p @ a.T + model.process_noise_cov), update


def filtered(model):
    """The same of a model's extended filter."""
    one = make_filter("ekf", model)
    begun = one.init()

    def predict(x, p, u):
        return one.predict(begun._replace(mean=x, cov=p), u)[:2]

    def update(x, p, z):
        belief, innovation = one.update(begun._replace(mean=x, cov=p), z)
        return belief.mean, belief.cov, innovation.log_likelihood

    return predict, update


def completed(beliefs, places, weights, n, given):
    """Beliefs of n states: those that one lacks have the moments of their mixture in those that have them."""
    means, covs = np.zeros((len(beliefs), n)), np.zeros((len(beliefs), n, n))
    for k, (x, p) in enumerate(beliefs):
        means[k, places[k]], covs[k][np.ix_(places[k], places[k])] = x, p

    def donors(s):
        return [k for k in range(len(beliefs)) if s in places[k]]

    for k in range(len(beliefs)):
        for s in set(range(n)) - set(places[k]):
            for t in set(range(n)) - set(places[k]):
                if s in given or t in given:
                    means[k, s] = given.get(s, means[k, [s]])[0]
                    covs[k, s, t] = given[s][1] if s == t else 0.0
                elif donors(s) == donors(t):
                    shares = {i: weights[i] / sum(weights[j] for j in donors(s)) for i in donors(s)}
                    means[k, s] = sum(w * means[i, s] for i, w in shares.items())
                    other = sum(w * means[i, t] for i, w in shares.items())
                    covs[k, s, t] = sum(
                        w * (covs[i, s, t] + (means[i, s] - means[k, s]) * (means[i, t] - other))
                        for i, w in shares.items()
                    )
    return means, covs


def naive(filter_, modes, kinds, places, inputs, measurements, given):
    """The filter of several models with beliefs of unequal sizes: means, covariances, log-likelihoods, mu."""
    pi, mu, n, found = filter_.transition_matrix, filter_.p, filter_.model.n, []
    beliefs = [(one.prior_mean, one.prior_cov) for one in modes]
    for k, z in enumerate(measurements):
        if k:
            c, begun = mu @ pi, []
            for j, (predict, _) in enumerate(kinds):
                w = pi[:, j] * mu / c[j]
                x, p = merged(w, *completed(beliefs, places, w, n, given))
                begun.append(predict(x[places[j]], p[np.ix_(places[j], places[j])], inputs[k - 1]))
            beliefs, mu = begun, c
        if np.isfinite(z).all():
            *beliefs, levels = zip(
                *(update(*b, z) for (_, update), b in zip(kinds, beliefs, strict=True)), strict=True
            )
            beliefs, levels = list(zip(*beliefs, strict=True)), np.exp(levels)
            level, mu = np.log(mu @ levels), mu * levels / (mu @ levels)
        else:
            level = 0.0
        found.append((*merged(mu, *completed(beliefs, places, mu, n, given)), level, mu))
    return [np.array(one) for one in zip(*found, strict=True)]


def compared(filter_, modes, kinds, places, inputs, measurements, given=()):
    means, covs, levels, mu = naive(filter_, modes, kinds, places, inputs, measurements, dict(given))
    belief = filter_.init()
    for k, z in enumerate(measurements):
        belief, innovation = filter_.update(filter_.predict(belief, inputs[k - 1]) if k else belief, z)
        each_close((belief.mean, belief.cov), (means[k], covs[k]), rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(innovation.log_likelihood, levels[k], rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(filter_.mode_probabilities(belief), mu[k], rtol=1e-9, atol=1e-12)
    assert mu.min() < 0.1 and mu.max() > 0.7, mu  # modes come and go
    return means


SETS = {  # symbols and q of each mode
    "two": ([("vp", 0.01), ("pva", 1.0)], {}),
    "two that have it": ([("pva", 0.2), ("vp", 0.01), ("apv", 4.0)], {}),
    "two that lack two": ([("pva", 0.2), ("p", 1.0), ("p", 0.1), ("pv", 0.01)], {}),
    "given": ([("pv", 0.01), ("pva", 1.0), ("p", 0.3)], {"a": (0.1, 0.02)}),
}


@pytest.mark.parametrize("name", SETS)
def test_equals_a_naive_filter_of_unequal_sizes(name):
    kinds, given = SETS[name]
    models = [moving(symbols, q, start=0.2) for symbols, q in kinds]
    whole = moving("pva", 1.0)
    filter_ = make_filter("imm", whole, modes=models, mode_filter="kf", stay=0.85, absent=given)
    rng, x, z = np.random.default_rng(1), np.zeros(3), []
    for k in range(60):
        x = whole.matrices()[0] @ [*x[:2], 2.0 * (20 <= k < 35)]
        z.append([x[0] + rng.normal()])
    z[9] = [np.nan]
    places = [["pva".index(one) for one in symbols] for symbols, _ in kinds]
    told = {"pva".index(one): value for one, value in given.items()}
    with nullcontext() if name == "two" else interpreted():
        compared(filter_, models, list(map(kalman, models)), places, np.zeros((59, 1)), np.array(z), told)


@pytest.mark.parametrize("how", [interpreted, pytest.param(nullcontext, marks=pytest.mark.slow)])
def test_a_thruster_with_and_without_an_unknown_constant(how):
    """Nonlinear functions with Jacobians and constants by name, in a mode and in a larger one."""
    small = thruster_model()
    name = "thrust_30"
    whole = augmented_model(small, {name: Unknown(std=0.3 * getattr(small.constants, name), walk_std=1e-8)})
    models = [small, whole]
    filter_ = make_filter("imm", whole, modes=models, stay=0.9)
    assert filter_.mode_filters[0].model.transition_jacobian is not None
    rng = np.random.default_rng(3)
    inputs = np.repeat(rng.uniform(-20.0, 20.0, (8, 1)), 10, axis=0)
    truth = augmented_model(small, {name: Unknown(std=1e-9, mean=0.6 * getattr(small.constants, name))})
    x = truth.prior_mean.copy()
    z = [truth.functions.observe(tuple(x), truth.given_constants)]
    for u in inputs:
        for _ in range(truth.substeps):
            x = truth.functions.transition(tuple(x), tuple(u), truth.given_constants)
        z.append(truth.functions.observe(x, truth.given_constants))
    z = np.array(z) + rng.normal(0.0, 0.5, (81, 1))
    with how():
        compared(filter_, models, list(map(filtered, models)), [[0, 1], [0, 1, 2]], inputs, z)


def test_the_mixture_does_not_pull_a_missing_state_to_a_value_of_its_own():
    """With zeros in place of it, acceleration is lost: in gaps by the factor mu_2|2, and on average."""
    whole = moving("pva", 0.05)
    errors, accelerations = {}, {}
    for name, given in (("others", None), ("zero", {"a": (0.0, 0.0)})):
        filter_ = make_filter("imm", whole, modes=[moving("pv", 0.01), whole], mode_filter="kf", absent=given)
        found = []
        for seed in range(30):
            rng, belief = np.random.default_rng(seed), filter_.init()
            for k in range(41):  # a = 2 m/s^2; a measurement in four steps
                belief = filter_.predict(belief, [0.0]) if k else belief
                belief, _ = filter_.update(belief, [(k * DT) ** 2 + rng.normal() if k % 4 == 0 else np.nan])
            found.append(belief.mean[2] - 2.0)
        errors[name] = np.mean(found), np.std(found) / np.sqrt(30)
        before, mu = filter_.mode_estimates(belief)[0][1, 2], filter_.mode_probabilities(belief)
        share = filter_.transition_matrix[1, 1] * mu[1] / (mu @ filter_.transition_matrix[:, 1])
        after = filter_.mode_estimates(filter_.predict(belief, [0.0]))[0][1, 2]
        accelerations[name] = after / before / (share if name == "zero" else 1.0)
    (kept, spread), (lost, _) = errors["others"], errors["zero"]
    assert abs(kept) < 2.0 * spread < 0.1 and lost < -0.3, errors
    assert accelerations == pytest.approx({"others": 1.0, "zero": 1.0}, rel=1e-9)


def turn(x, u, c):
    return (0.95 * x[0] + 0.1 * u[0],)


def stuck(x, c):
    return (c[0], x[0])


@pytest.mark.parametrize("name", ["imm", "mmae"])
def test_an_angle_that_a_mode_lacks_is_that_of_the_others_the_short_way_round(name):
    """The compass of the third mode is stuck, which so knows of no heading; near the cut as far from it."""
    rng = np.random.default_rng(4)
    inputs, noise, found = rng.normal(size=(1, 40, 1)), rng.normal(0.0, 0.3, (1, 41, 2)), []
    for heading in (0.0, np.pi):
        model = turning(heading)
        small = StateSpaceModel(
            transition=turn,
            observe=stuck,
            process_noise_cov=[0.02],
            measurement_noise_cov=model.measurement_noise_cov,
            prior_mean=[0.2],
            prior_cov=[0.05],
            constants=(heading,),
            states=(RATE,),
            measurements=model.measurements,
        )
        modes = [{}, {"process_noise_cov": 30.0 * model.process_noise_cov}, small]
        seen = noise + [heading, 0.0]
        seen[..., 0] = np.angle(np.exp(1j * seen[..., 0]))
        with interpreted():
            found.append(run(make_filter(name, model, modes=modes), np.array([[0, 0]]), inputs, seen))
    here, there = found
    assert np.abs(here.means[..., 1]).max() < 1.5  # [rad]
    np.testing.assert_allclose(np.exp(1j * (there.means[..., 1] - here.means[..., 1])), -1.0, atol=1e-9)
    np.testing.assert_allclose(there.means[..., 0], here.means[..., 0], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(there.covs, here.covs, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(there.log_likelihoods, here.log_likelihoods, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"modes": [{}, wide_model()]}, "measurements, inputs and angles of a mode must be those of the model"),
        (
            {"modes": [{}, moving("pv", 1.0).replace(states=["p", "w"])]},
            "states of a mode must be some of the model's, p, v, a, or as many of other names, but got p, w",
        ),
        (
            {"modes": [moving("pv", 1.0)] * 2},
            "each state must be one of a mode's, or of absent, but 'a' is of none",
        ),
        (
            {"modes": [{}, moving("pv", 1.0).replace(states=["p", ("v", "v", "rad", True)])]},
            "v of a mode must be no angle, as in the model, but got angle=True",
        ),
        ({"absent": {"p": (0.0, 1.0)}}, "absent must be one of a, but got 'p'"),
        (
            {"modes": [{}, {}], "absent": {"a": (0.0, 1.0)}},
            "absent needs a mode that lacks states, but all have all",
        ),
        ({"absent": {"a": (0.0, -1.0)}}, r"variance of absent\['a'\] must be"),
        ({"absent": {"a": 0.0}}, r"absent\['a'\] must be"),
        ({"absent": 3}, r"absent must map symbols to \(mean, variance\), but got 3"),
    ],
)
def test_what_is_refused(changes, rule):
    refused(rule, make_filter, "imm", moving("pva", 1.0), **{"modes": [{}, moving("pv", 0.1)], **changes})
