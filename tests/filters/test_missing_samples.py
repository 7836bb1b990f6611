"""Missing samples in every form, masked, None or pandas.NA: NaN on all paths."""

import math

import numpy as np
import pytest

import filters
from filters import make_filter, run, smooth
from filters.sensitivity import likelihood
from tests.kalman_by_hand import LinearModel
from tests.models import line_model, simulated, small, wide_model
from thruster_env.core.checks import as_floats
from thruster_env.core.streams import filter_keys
from thruster_env.logs.log import Log

INPUTS, MEASUREMENTS = simulated(line_model(), 10, seed=3)
LOST = np.random.default_rng(2).random(MEASUREMENTS.shape) < 0.4
PLAIN = np.where(LOST, np.nan, MEASUREMENTS)


class NAType:
    """What pandas.NA is where pandas is not installed."""


def objects(missing):
    found = MEASUREMENTS.astype(object)
    found[LOST] = missing
    return found


FORMS = {
    "masked": np.ma.masked_array(np.where(LOST, -24000.0, MEASUREMENTS), LOST),
    "masked objects": np.ma.masked_array(np.where(LOST, 1e9, MEASUREMENTS).astype(object), LOST),
    "list of masked rows": list(np.ma.masked_array(np.where(LOST, 1e9, MEASUREMENTS), LOST)),
    "nested masked rows": [[*np.ma.masked_array(np.where(LOST[0], 1e9, MEASUREMENTS[0]), LOST[0])]],
    "None": objects(None),
    "lists with None": objects(None).tolist(),
    "NA": objects(NAType()),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("path", ["run", "session", "update", "smooth", "likelihood", "log"])
def test_what_is_missing_is_nan(path, form, as_python):
    filter_, key = small("ekf", line_model()), filter_keys([0])

    def means(z):
        if path == "run":
            return run(filter_, key, INPUTS, z).means
        if path == "session":
            session = filter_.session()
            session.start((0, 0), z[0][0])
            for u, one in zip(INPUTS[0], z[0][1:], strict=True):
                session.step(u, one)
            return session.mean
        if path == "update":
            return [filter_.update(filter_.init((0, 0)), one)[0].mean for one in z[0]]
        if path == "smooth":
            return smooth(filter_, key, INPUTS, z).means
        if path == "likelihood":
            slopes = np.zeros((1, 2, 2)), np.zeros((1, 1, 1))
            return likelihood(filter_.model, INPUTS, z, *slopes, filter=filter_).values
        model = filter_.model
        return Log("run", 0.1, INPUTS[0], z[0], model.input_quantities, model.measurements).measurements

    np.testing.assert_array_equal(means(FORMS[form]), means(PLAIN))


@pytest.mark.parametrize("form", FORMS)
def test_tensors_know_what_is_missing(form, as_python):
    torch = pytest.importorskip("torch")
    filter_ = filters.torch(small("ekf", line_model()))
    found, expected = (filter_.run(INPUTS, z) for z in (FORMS[form], PLAIN))
    assert torch.equal(found.means, expected.means) and not torch.isnan(found.means).any()


def test_none_alone_and_text_are_no_numbers():
    for value in (None, "1.0", ["1.0", None], [[1.0], None, "x"], 1j, np.ma.masked_array(["1"], [True])):
        with pytest.raises(ValueError, match="an array must be one of numbers"):
            as_floats(value)
    np.testing.assert_array_equal(as_floats([1, None, np.ma.masked, 2.5]), [1.0, np.nan, np.nan, 2.5])


@pytest.mark.parametrize("missing", [None, np.ma.masked, math.nan, NAType()])
def test_live_takes_a_single_sample_that_is_missing(missing, as_python):
    live = make_filter("ekf", LinearModel(np.random.default_rng(0)).model()).live()
    live.start(0.0)
    before = live.mean.copy()
    live.update(0.0, "z0", missing)
    np.testing.assert_array_equal(live.mean, before)


@pytest.mark.parametrize("z", [[1.0], [[1.0, 2.0]], [1.0, 2.0, 3.0], 1.0])
def test_a_session_takes_one_number_a_channel(z, as_python):
    session = small("ekf", wide_model()).session()
    with pytest.raises(ValueError, match="z must be 2 numbers"):
        session.start((0, 0), z)
    session.start((0, 0), [1.0, 2.0])
    with pytest.raises(ValueError, match="z must be 2 numbers"):
        session.step([0.1, 0.2], z)
