"""Lines to paste of a record whose steps are unequal, or in which numbers are missing."""

import ctypes
import math
import re
import shutil
import subprocess

import numpy as np
import pytest

import filters
import tuning

RNG = np.random.default_rng(3)
TIMES = np.cumsum(RNG.exponential(0.1, 120))
LEVEL = 50.0 + np.cumsum(RNG.normal(0.0, 0.3, 120))
Z = LEVEL + RNG.normal(0.0, 1.0, 120)
TIMES[60:] += 40.0  # a gap
MODELS = "constant-velocity", "ornstein-uhlenbeck", "oscillator", "constant + harmonic:period=3"


@pytest.fixture(scope="module", params=[*MODELS, "two axes"])
def fit(request):
    if request.param == "two axes":
        return tuning.fit(np.stack([Z, -Z[::-1]], axis=1), times=TIMES, model="constant-velocity")
    return tuning.fit(Z, times=TIMES, model=request.param)


def outputs(fit, states):
    c = fit.model.matrices()[3]
    return np.asarray(states) @ c.T


def close(fit, states):
    np.testing.assert_allclose(outputs(fit, states), outputs(fit, fit.estimates.means[0]), rtol=0.0, atol=1e-5)


def test_lines_for_python_filter_unequal_steps(fit):
    names, code = {"z": fit.column.values, "t": TIMES, "filters": filters}, fit.code("python")
    exec(code, names)
    close(fit, eval(re.search(r"filters\.run\(.*\)$", code)[0], names).means)


def test_lines_for_filterpy_take_the_length_of_each_step(fit):
    pytest.importorskip("filterpy.kalman")
    setup, step = fit.code("filterpy").split("# the first measurement updates the state at once: ")
    first, step = step.split(", then for each further one, dt [s] later\n")
    names = {"z": fit.column.values}
    exec(setup, names)
    exec(first, names)
    states = [names["kf"].x[:, 0]]
    for z, dt in zip(fit.column.values[1:], np.diff(TIMES), strict=True):
        exec(step, names | {"z": z, "dt": dt})
        states.append(names["kf"].x[:, 0])
    close(fit, states)


def test_lines_for_pykalman_have_matrices_of_each_step(fit):
    pytest.importorskip("pykalman")
    names = {"z": fit.column.values, "t": TIMES}
    exec(fit.code("pykalman"), names)
    close(fit, names["means"])


def test_lines_for_matlab_compute_f_and_q_of_each_step_and_keep_the_densities(fit):
    code = fit.code("matlab")
    assert code.startswith("% a step may have any length [s]; those of the record have ")
    assert code.index("dt = t(k) - t(k - 1);") < code.index("Q = Q + F*Q*F';") < code.index("P = F*P*F' + Q;")
    assert len(re.findall(r"^ *D = ", code, flags=re.MULTILINE)) == 1 and "E = expm([-A, D; 0*A, A']*dt" in code


def test_a_constant_gain_says_for_which_steps_it_is():
    code = tuning.fit(Z, times=TIMES, model="constant").code("arduino")
    assert re.match(r"// a step is 0\.\d+ s; those of the record have 0\.\d+ to 40\.\d+ s\n", code)


def test_a_missing_number_counts_as_a_step():
    z = np.where(np.arange(120) % 10 == 3, np.nan, Z)
    fit = tuning.fit(z, dt=0.1, model="constant")
    for language in ("python", "filterpy", "pykalman", "matlab", "arduino"):
        assert "a step is 0.1 s; one without a measurement counts, with z = NaN\n" in fit.code(language)
    assert "NaN" not in tuning.fit(Z, dt=0.1, model="constant").code("python").split("\n")[0]


@pytest.mark.skipif(shutil.which("cc") is None, reason="the lines of C need a compiler")
def test_a_controller_predicts_where_a_number_is_missing(tmp_path):
    fit = tuning.fit(Z, dt=0.1, model="constant")
    source = tmp_path / "filter.c"
    source.write_text(fit.code("arduino") + "\ndouble state(void) { return x1; }\n")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", str(tmp_path / "filter.so"), str(source)], check=True)
    library = ctypes.CDLL(str(tmp_path / "filter.so"))
    library.filter.argtypes, library.state.restype = [ctypes.c_double], ctypes.c_double
    for z in [math.nan, *Z, math.nan]:
        library.filter(z)
    assert library.state() == pytest.approx(fit.estimates.means[0, -1, 0], rel=1e-5)
