"""Localised ensembles: DAPPER's analyses, naive ones, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import sqrtm

from filters import make_filter, run, smooth
from filters.c.project import c_filter
from filters.ensembles.stochastic import gaspari_cohn
from filters.tensors import torch
from tests.filters.checks import refused
from tests.filters.test_c import assert_same, built, estimated
from tests.models import KEY, simulated, state_space, wide_model
from tests.oracles import each_close
from thruster_env.core.compiled import interpreted
from thruster_env.model.quantities import Positions

DAPPER = json.loads((Path(__file__).parents[1] / "data" / "dapper_localised.json").read_text())
LOCAL = "enkf", "denkf", "ensrf", "letkf"
SIZE = 5


def decay(x, u, c):
    return (0.9 * x[0], 0.9 * x[1], 0.9 * x[2], 0.9 * x[3], 0.9 * x[4], 0.9 * x[5], 0.9 * x[6], 0.9 * x[7])


def curved(x, c):
    """What `data/dapper_localised.py` measures."""
    return (x[0] + 0.1 * x[0] * x[0], x[2] + 0.1 * x[2] * x[2], x[4] + 0.1 * x[4] * x[4], x[6] + 0.1 * x[6] * x[6])


def ring(**changes):
    """Eight states on a ring, of which every other one is measured."""
    return state_space(
        decay,
        curved,
        q=np.full(8, 0.1),
        r=DAPPER["r"],
        mean=np.zeros(8),
        cov=np.ones(8),
        **{"inputs": 0, "positions": Positions(range(8), (0, 2, 4, 6), 8), **changes},
    )


def updated(name, members, z, model=None, **numbers):
    """The members after an update, and the innovation."""
    filter_ = make_filter(name, model or ring(), ensemble_size=SIZE, **numbers)
    with interpreted():
        belief, innovation = filter_.update(filter_.init(KEY)._replace(members=np.array(members)), z)
    each_close((belief.mean, belief.cov), (belief.members.mean(axis=1), np.cov(belief.members)), atol=1e-12)
    return belief.members, innovation


def centred(a):
    return a - a.mean(axis=1, keepdims=True)


def expected(members):
    return members[::2] + 0.1 * members[::2] ** 2


@pytest.mark.parametrize("name", DAPPER["posterior"])
def test_the_same_ensemble_gives_the_same_ensemble_as_in_dapper(name):
    found, _ = updated(name, DAPPER["prior"], DAPPER["z"], radius=DAPPER["radius"])
    np.testing.assert_allclose(found, DAPPER["posterior"][name], rtol=1e-10, atol=1e-10)


def test_the_taper_is_a_correlation_of_gaussian_shape():
    distances = np.linspace(0.0, 10.0, 401)
    found = gaspari_cohn(distances, 2.0)
    assert found[0] == 1.0 and found[distances >= 7.31].max() == 0.0 and (np.diff(found) <= 0.0).all()
    np.testing.assert_allclose(found, np.exp(-0.5 * (distances / 2.0) ** 2), atol=0.035)
    assert abs(np.diff(found, 2)).max() < 2e-4  # smooth where its two pieces meet
    line = np.arange(30.0)
    assert np.linalg.eigvalsh(gaspari_cohn(abs(line[:, None] - line), 3.0)).min() > 0.0


def test_distances_are_the_short_way_round():
    place = Positions([[0.0, 0.0], [3.0, 9.0]], [[0.5, 9.5]], (np.inf, 10.0)).checked(2, 1)
    np.testing.assert_allclose(
        place.distances(place.states, place.measurements)[:, 0], [np.sqrt(0.5), np.sqrt(2.5**2 + 0.25)]
    )


@pytest.mark.parametrize("missing", [[], [1], [0, 2, 3], [0, 1, 2, 3]])
def test_each_state_has_the_transform_filter_of_what_lies_near(missing):
    x, z, r = np.array(DAPPER["prior"]), np.array(DAPPER["z"]), np.array(DAPPER["r"])
    z[missing] = np.nan
    found, _ = updated("letkf", x, z, radius=0.8)
    here = [k for k in range(4) if k not in missing]
    y = expected(x)
    for i in range(8):
        apart = abs(i - 2.0 * np.array(here))
        taper = gaspari_cohn(np.minimum(apart, 8.0 - apart), 0.8)
        inverse, of_y = np.diag(np.where(taper > 1e-3, taper, 0.0) / r[here]), centred(y)[here]
        squared = np.linalg.inv(np.eye(SIZE) + of_y.T @ inverse @ of_y / (SIZE - 1))
        weights = squared @ of_y.T @ inverse @ (z - y.mean(axis=1))[here] / (SIZE - 1)
        row = x[i].mean() + centred(x)[i] @ (weights[:, None] + sqrtm(squared).real)
        np.testing.assert_allclose(found[i], row, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("missing", [[], [1]])
def test_half_the_gain_is_that_of_tapered_covariances(missing):
    x, z = np.array(DAPPER["prior"]), np.array(DAPPER["z"])
    z[missing] = np.nan
    here = [k for k in range(4) if k not in missing]
    found, innovation = updated("denkf", x, z, radius=1.5)
    y, places = expected(x)[here], 2.0 * np.array(here)

    def tapers(first):
        apart = abs(np.asarray(first)[:, None] - places)
        return gaspari_cohn(np.minimum(apart, 8.0 - apart), 1.5)

    both = np.cov(np.vstack([x, y]))
    s = both[8:, 8:] * tapers(places) + np.diag(np.array(DAPPER["r"])[here])
    k = both[:8, 8:] * tapers(range(8)) @ np.linalg.inv(s)
    v = z[here] - y.mean(axis=1)
    np.testing.assert_allclose(found, x + (k @ v)[:, None] - 0.5 * k @ centred(y), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(innovation.cov[np.ix_(here, here)], s, rtol=1e-10)


@pytest.mark.parametrize("name", LOCAL)
def test_a_radius_beyond_everything_is_none(name):
    """Of a linear h: the serial filter with a radius predicts its channels anew."""
    model = ring(observe=lambda x, c: (x[0], x[2], x[4], x[6]))
    for relaxation in (0.0, 0.4):
        far, of_far = updated(name, DAPPER["prior"], DAPPER["z"], model, radius=1e6, relaxation=relaxation)
        plain, of_plain = updated(name, DAPPER["prior"], DAPPER["z"], model, relaxation=relaxation)
        np.testing.assert_allclose(far, plain, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(np.ravel(of_far.cov), np.ravel(of_plain.cov), rtol=1e-8)
        assert of_far.log_likelihood == pytest.approx(of_plain.log_likelihood, rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", LOCAL)
def test_few_members_follow_a_long_ring_only_with_a_radius(name):
    """Of 8 states and 5 members: one with a page and one by parts have the same numbers compiled."""
    model, numbers = ring(), {"ensemble_size": SIZE}
    inputs, z = simulated(model, 30, count=2, missing=0.2)
    local = make_filter(name, model, radius=1.0, **numbers)
    with interpreted():
        found = run(local, None, inputs, z)
        plain = run(make_filter(name, model, **numbers), None, inputs, z)
    if name in ("enkf", "letkf"):
        each_close(run(local, None, inputs, z), found, rtol=1e-9, atol=1e-9)
    assert found.divergences.tolist() == [0, 0]
    assert found.log_likelihoods[:, 5:].mean() > plain.log_likelihoods[:, 5:].mean()


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ["enkf", "denkf"])
def test_tapered_covariances_are_those_of_c_and_of_tensors(name, tmp_path):
    model = ring()
    filter_ = make_filter(name, model, ensemble_size=SIZE, radius=1.5)
    inputs, z = simulated(model, 20, missing=0.2)
    expected = [part[0] for part in run(filter_, None, inputs, z)[:5]]
    found, *_ = estimated(built(filter_, tmp_path), model, inputs[0], z[0])
    assert_same(found, expected, 1e-12)
    assert_same([np.asarray(one)[0] for one in torch(filter_).run(inputs, z)][:5], expected, 1e-10)


@pytest.mark.parametrize("name", LOCAL)
def test_a_radius_needs_positions(name):
    with pytest.raises(ValueError, match="radius must be 0 for a model without positions, but got 2"):
        make_filter(name, wide_model(), radius=2.0)
    refused("radius must be zero or positive, but got -1", make_filter, name, ring(), radius=-1.0)
    filter_ = make_filter(name, ring(), ensemble_size=SIZE, radius=2.0)
    inputs, z = simulated(ring(), 3)
    refused("must have one gain for all states, but got .* a radius of 2", smooth, filter_, None, inputs, z)


@pytest.mark.parametrize("name", ["ensrf", "letkf"])
def test_an_update_by_parts_is_refused_where_there_is_only_a_page(name):
    filter_ = make_filter(name, ring(), radius=2.0)
    for use, where in ((torch, "on tensors"), (c_filter, "in C")):
        refused(f"an ensemble {where} must have a page for its whole update.* radius of 2", use, filter_)


@pytest.mark.parametrize(
    ("positions", "rule"),
    [
        (Positions(range(7), range(4)), r"positions of states must be \(8, 1\) finite numbers"),
        (Positions(range(8), np.zeros((4, 2))), r"positions of measurements must be \(4, 1\) finite numbers"),
        (Positions(range(8), range(4), -1), "period must be 1 positive numbers, but got -1"),
    ],
)
def test_positions_that_do_not_fit_are_refused(positions, rule):
    refused(rule, ring, positions=positions)
