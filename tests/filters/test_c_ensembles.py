"""Ensembles in C: their random numbers, many members and channels, beliefs between measurements."""

import subprocess

import numpy as np
import pytest

from filters import run
from filters.c.project import c_filter
from tests.filters.test_c import SANITIZERS, WARNINGS, assert_same, built, estimated, made
from tests.filters.test_ensemble_pages import PartlyFilter
from tests.filters.test_pages import wide_pendulum
from tests.models import random_affine, simulated, wide_model

USE = """\
#include "one.h"

#include <stdio.h>

int main(void)
{
    one filter;
    const double u[1] = {0.5};

    one_init(&filter, @KEY@);
    for (int k = 0; k < 2; k++) {
        printf("%.17g %.17g\\n", filter.x[0], filter.P[3]);
        one_predict(&filter, u);
    }
    return 0;
}
"""


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ["enkf", "etkf"])
def test_an_ensemble_of_many_states_and_channels(name, tmp_path):
    """Sums of more loops than one, and a geometric mean in rounds."""
    model = random_affine(7, 3, 1)
    inputs, z = simulated(model, 50, level=1.0, missing=0.2)
    filter_ = made(name, model)
    program = built(filter_, tmp_path, flags=SANITIZERS)
    found, *_ = estimated(program, model, inputs[0], z[0])
    assert_same(found, [part[0] for part in run(filter_, None, inputs, z)[:5]], 1e-12)


@pytest.mark.usefixtures("as_python")
def test_random_numbers_are_those_of_the_key(tmp_path):
    """Of a key whose words have all bits, which `init` takes as well."""
    filter_, key = made("enkf", wide_model()), (0xFFFFFFFF, 0x9E3779B9)
    program = built(filter_, tmp_path, key=key)
    inputs, z = simulated(filter_.model, 20, missing=0.2)
    found, *_ = estimated(program, filter_.model, inputs[0], z[0])
    expected = [one[0] for one in run(filter_, np.array([key], dtype=float), inputs, z)]
    assert_same(found, expected[:5], 1e-12)
    assert abs(run(filter_, None, inputs, z).means[0] - expected[0]).max() > 0.1


@pytest.mark.usefixtures("as_python")
def test_a_users_ensemble_is_that_of_run(tmp_path):
    filter_ = PartlyFilter(model=wide_pendulum(), ensemble_size=9, part=0.7)
    inputs, z = simulated(filter_.model, 30, level=1.0, missing=0.2)
    found, *_ = estimated(built(filter_, tmp_path), filter_.model, inputs[0], z[0])
    assert_same(found, [one[0] for one in run(filter_, None, inputs, z)[:5]], 1e-12)


@pytest.mark.usefixtures("as_python")
def test_mean_and_covariance_are_there_before_a_measurement(tmp_path):
    filter_, key = made("enkf", wide_pendulum()), (3, 4294967295)
    made_, use = c_filter(filter_, "one"), USE.replace("@KEY@", "3, 4294967295u")
    for name, text in {"one.h": made_.header, "one.c": made_.source, "use.c": use}.items():
        (tmp_path / name).write_text(text)
    subprocess.run(["gcc", *WARNINGS, "one.c", "use.c", "-lm", "-o", "use"], cwd=tmp_path, check=True)
    words = subprocess.run([tmp_path / "use"], capture_output=True, text=True, check=True).stdout.split()
    prior = filter_.init(key)
    expected = [
        number for one in (prior, filter_.predict(prior, [0.5])) for number in (one.mean[0], one.cov[1, 1])
    ]
    np.testing.assert_allclose([float(word) for word in words], expected, rtol=1e-12)
