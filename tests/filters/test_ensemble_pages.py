"""The pages of the ensemble filters on NumPy's arrays, a column a member: they are the filters."""

from contextlib import nullcontext
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from filters import FILTERS, make_filter, run, thruster_model
from filters.algebra.members import mean
from filters.algebra.operations import divide
from filters.ensembles.ensemble import EnsembleFilter, add_process_noise, compare, propagate
from filters.pages.kernels import with_extras
from filters.pages.page import Page
from filters.sensitivity import differentiable
from tests.filters.checks import refused
from tests.filters.of_arrays import OfArrays, parameters_of
from tests.filters.test_pages import turn_if, wide_pendulum
from tests.filters.test_sensitivity import pendulum as turning_pendulum
from tests.models import random_affine, simulated, wide_model
from tests.oracles import each_close
from tests.slow import slow_but
from thruster_env.core.checks import covariance_root
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, episode_keys, fill_normals
from thruster_env.model.shape import LANES, padded

SIZE = 11
CHOICES = {
    "enkf": {"centred_perturbations": 1},
    "etkf": {"inflation": 1.05},
    "letkf": {},
    "ensrf": {"relaxation": 0.4},
    "denkf": {"inflation": 0.9, "relaxation": 1.0},
    "ienkf": {"iterations": 2},
    "enkf-n": {"certainty": 1.5, "inflation": 1.02},
}


class OfMembers(OfArrays):
    """A model as a page sees it: states (n, N) of the members, and columns that are the same for all."""

    def __init__(self, model, own):
        super().__init__(model, own)
        self.R_root, self.prior_mean = covariance_root(self.R), model.prior_mean[:, None]

    def f(self, x, u):
        return np.stack([OfArrays.f(self, one, u[:, 0]) for one in x.T], axis=1)


def on_one_branch(x, angles):
    """Members (n, N), their angles within half a turn of the circular mean."""
    middle = np.angle(np.exp(1j * x).sum(axis=1, keepdims=True))
    turned = x - 2 * np.pi * np.ceil((x - middle - np.pi) / (2 * np.pi))
    return np.where(np.reshape(angles, (-1, 1)), turned, x) if any(angles) else x


def run_page(filter_, key, inputs, measurements):
    """Means, covariances, innovations, their covariances and log-likelihoods of one run, by the page itself."""
    page, model = filter_.written_page, filter_.kernel_model
    own = parameters_of(page, np.array(filter_.own_parameters))
    columns = {name: one[:, None] for name, one in own._asdict().items() if np.ndim(one) == 1}
    equations = OfMembers(model, own._replace(**columns))
    equations.extras = page.started(equations)
    width, found = padded(filter_.size, LANES), []

    def normals(rows, step, stream):
        out = np.empty(padded(rows * width, 32))
        fill_normals(out, rows * width, step, stream, *key)
        return out[: rows * width].reshape(rows, width)[:, : filter_.size]

    x = equations.prior_mean + equations.prior_root @ normals(model.n, 0, FILTER_PRIOR)
    x = on_one_branch(x, equations.state_angles)
    for k, z in enumerate(measurements):
        if k > 0:
            for _ in range(model.substeps):
                x = page.propagate(equations, x, inputs[k - 1][:, None])
            x = page.add_process_noise(equations, x, normals(model.n, k, FILTER_PROCESS))
        told = page.update(equations, x, z[:, None], normals(model.m, k, FILTER_MEASUREMENT))
        x, v, s, level, equations.extras = with_extras(told)
        mean = x.mean(axis=1)
        wrapped = np.where(equations.state_angles, np.angle(np.exp(1j * mean)), mean)
        found.append((wrapped, np.cov(x).reshape(model.n, model.n), v[:, 0], s, level))
    return [np.array(part) for part in zip(*found, strict=True)]


def assert_page_is_the_filter(filter_):
    inputs, z = simulated(filter_.kernel_model, 12, missing=0.3)
    keys = episode_keys([3])
    estimates = run(filter_, keys, inputs, z)
    for one, other in zip(run_page(filter_, keys[0], inputs[0], z[0]), estimates, strict=False):
        np.testing.assert_allclose(one, other[0], rtol=1e-9, atol=1e-10)
    assert estimates.divergences[0] == 0


def test_all_ensemble_filters_are_tried():
    ensembles = {name for name, kind in FILTERS.items() if issubclass(kind, EnsembleFilter)}
    assert set(CHOICES) == ensembles - {"rhf"}  # whose page moves no member in an update


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("make", [wide_model, wide_pendulum, thruster_model])
@pytest.mark.parametrize("chosen", [False, True])
@pytest.mark.parametrize("name", CHOICES)
def test_a_page_of_arrays_is_the_filter(name, chosen, make):
    assert_page_is_the_filter(make_filter(name, make(), ensemble_size=SIZE, **CHOICES[name] if chosen else {}))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("least_deviation", [0.0, 0.05])
@pytest.mark.parametrize("by_state", [0, 1])
@pytest.mark.parametrize("name", ["enkf", "etkf"])
def test_a_page_of_arrays_with_adaptive_inflation_is_the_filter(name, by_state, least_deviation):
    own = {"adaptive_inflation": 0.3, "inflation_by_state": by_state, "least_deviation": least_deviation}
    for model in (wide_model(), turning_pendulum().replace(transition=turn_if)):
        assert_page_is_the_filter(make_filter(name, model, ensemble_size=SIZE, **own))


@pytest.mark.parametrize("name", slow_but(["etkf", "letkf"], ["etkf"]))
def test_a_page_of_arrays_is_the_compiled_filter(name):
    model = random_affine(7, 3, 2, seed=4)  # sums of more loops than one, and a geometric mean that is called
    assert_page_is_the_filter(make_filter(name, model, ensemble_size=21, **CHOICES[name]))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", CHOICES)
def test_a_page_of_arrays_is_the_filter_by_calls(name):
    """Of a model that decides, and of one that is large."""
    decides = turning_pendulum().replace(transition=turn_if)
    assert_page_is_the_filter(make_filter(name, decides, ensemble_size=SIZE, **CHOICES[name]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["enkf", "letkf"])
def test_a_page_of_arrays_is_the_filter_of_a_large_model(name):
    """The one compiled, whose analysis is the longer program, the other one as Python."""
    with nullcontext() if name == "letkf" else interpreted():
        assert_page_is_the_filter(make_filter(name, random_affine(38, 8, 1), ensemble_size=45, **CHOICES[name]))


def update_in_part(model, x, z, e):
    """A deterministic update whose members follow the gain in part."""
    d, C, v, S, _, level = compare(model, x, z)
    return x + divide(C, S) @ (v - d * model.own.part), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class PartlyFilter(EnsembleFilter):
    name: ClassVar[str] = "partly"
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_in_part)
    part: float = 0.5


@pytest.mark.usefixtures("as_python")
def test_a_filter_of_ones_own_is_its_page_and_by_name_too():
    model = wide_model()
    filter_ = make_filter(f"{__name__}:PartlyFilter", model, ensemble_size=SIZE, part=0.7, inflation=1.1)
    assert_page_is_the_filter(filter_)
    inputs, z = simulated(model, 12)
    half, denkf = (make_filter(name, model, ensemble_size=SIZE) for name in (f"{__name__}:PartlyFilter", "denkf"))
    each_close(run(half, None, inputs, z), run(denkf, None, inputs, z), rtol=1e-12, atol=1e-12)
    assert abs(run(filter_, None, inputs, z).means - run(denkf, None, inputs, z).means).max() > 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class WrongFilter(PartlyFilter):
    """A filter whose innovation is one of each member."""

    page: ClassVar[Page] = Page(
        propagate, add_process_noise, lambda model, x, z, e: (x, z - model.h(x), model.R, mean(z @ z))
    )


def test_what_is_of_all_members_must_not_be_of_each():
    with pytest.raises(TypeError, match="of all members, such as a mean, not of each"):
        WrongFilter(model=wide_model()).init()


def test_an_ensemble_has_no_derivatives():
    model = wide_model()
    refused("a filter with derivatives must be one of", differentiable, model, PartlyFilter(model=model))
