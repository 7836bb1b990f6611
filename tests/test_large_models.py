"""Models of any size: what is written out for small ones is looped over arrays for large ones."""

import sys
from contextlib import contextmanager

import numpy as np
import pytest

from filters import bounds, likelihood, make_filter, run
from filters.augmented import augmented_model
from filters.registry import FILTERS, tunable_numbers
from filters.smoothers.smooth import smooth
from numerics import sources
from numerics.compiled import interpreted
from numerics.streams import episode_keys
from plants import shape
from plants.simulate import simulate
from tests.models import lonely_model, pendulum, simulated, thruster_model, varying_noise, wide_model

MODELS = {"wide affine": wide_model, "pendulum": pendulum, "thruster": thruster_model, "no input": lonely_model}
FORMS = {
    "kf, information": ("kf", {"form": "information"}),
    "kf, square-root": ("kf", {"form": "square-root"}),
    "kf, scheduled": ("kf", {"schedule": 5}),
    "fuzzy, by moments": ("fuzzy", {"blending": "moments"}),
    "enkf, inflated": ("enkf", {"inflation": 1.1, "relaxation": 0.3}),
}
CASES = {**{name: (name, {}) for name in FILTERS}, **FORMS}


def forget_functions():
    """Empty the caches of all makers, which do not know of limits that a test has changed."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("numerics", "plants", "filters"):
            for value in list(vars(module).values()):
                getattr(value, "cache_clear", lambda: None)()


@contextmanager
def arrays_only():
    """Within this context every vector and matrix is an array, and every sum a loop."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("LARGEST_TUPLE", "LARGEST_SIDE", "LONGEST_TEXT"):
            patch.setattr(sources, name, 0)
        patch.setattr(shape, "MOST_CONSTANTS", 0)
        forget_functions()
        yield
    forget_functions()


def everything(model_name):
    """What all filters and what stands beside them make of a model, by name."""
    model = MODELS[model_name]()
    inputs, z = simulated(model, 6, count=2, level=1.0, missing=0.2)
    keys, found = episode_keys([3, 4]), {}
    found["simulate"] = simulate(model, keys, inputs)
    for name, (kind, numbers) in CASES.items():
        if "ensemble_size" in tunable_numbers(kind):
            numbers = {**numbers, "ensemble_size": 10}
        try:
            made = make_filter(kind, model, **numbers)
        except ValueError:  # the model has no operating points, or no range of states
            continue
        noise = varying_noise(model, 6) if made.varying_noise else {}
        found[name] = run(made, keys, inputs, z, **noise)
        belief, _ = made.update(made.predict(made.init((1, 2)), inputs[0, 0]), z[0, 1])
        found[f"{name}, a step"] = belief.mean, belief.cov, belief.members, belief.extras
        try:
            found[f"{name}, smoothed"] = smooth(made, keys, inputs, z, lag=3)
        except ValueError:  # it has no smoother
            continue
    slopes = [np.stack([np.eye(size), np.ones((size, size))]) for size in (model.n, model.m)]
    found["likelihood"] = likelihood.likelihood(model, inputs, z, *slopes)
    found["bound"] = (bounds.posterior_bound(model, inputs, truths=2),)
    if len(model.constants):
        known = {getattr(model.constants, "_fields", range(9))[1]: (0.1, 0.01)}
        joint = augmented_model(model, known)
        found["augmented"] = run(make_filter("ekf", joint), keys, inputs, z)
    return found


@pytest.fixture(scope="module")
def both():
    """The same twice: by tuples, and by arrays."""
    with interpreted():
        tuples = {name: everything(name) for name in MODELS}
        with arrays_only():
            return tuples, {name: everything(name) for name in MODELS}


@pytest.mark.parametrize("model", MODELS)
def test_loops_over_arrays_are_what_is_written_out_for_tuples(both, model):
    tuples, arrays = (form[model] for form in both)
    assert list(tuples) == list(arrays) and len(arrays) > 25
    for name, expected in tuples.items():
        for one, other in zip(expected, arrays[name], strict=True):
            close = 1e-6 if name == "likelihood" else 1e-9  # it has differences of differences
            atol = close * np.nanmax(np.abs(one), initial=1e-3)  # some entries are small differences of large ones
            np.testing.assert_allclose(other, one, rtol=close, atol=atol, err_msg=f"{model}, {name}")
