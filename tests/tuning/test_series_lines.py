"""Lines to paste of a fit: the same filter in every language, on unequal steps or with missing numbers, too."""

import ctypes
import math
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import filters
import tuning
from filters.named import model_named
from tests.filters.checks import refused
from tests.tuning.test_series import NILE, simulated
from tuning.series.paste import LANGUAGES, lines_of


@pytest.fixture(scope="module")
def position():
    return tuning.fit(simulated("constant-velocity", 600) + 40.0, 0.1, model="constant-velocity")


def in_c(fit, folder):
    """The lines for a controller as a library of C: filter(z), and state(i) of the first two states."""
    state = "i ? x2 : x1" if fit.model.n > 1 else "x1"
    (folder / "filter.c").write_text(fit.code("arduino") + f"\ndouble state(int i) {{ return {state}; }}\n")
    command = ["cc", "-shared", "-fPIC", "-o", "filter.so", "filter.c"]
    subprocess.run(command, check=True, cwd=folder)
    library = ctypes.CDLL(str(folder / "filter.so"))
    library.filter.argtypes, library.state.restype = [ctypes.c_double], ctypes.c_double
    return library


with_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="the lines of C need a compiler")


def test_lines_for_python_make_the_same_filter(position):
    names = {}
    exec(position.code("python"), names)
    np.testing.assert_allclose(names["filter_"].model.numbers, position.filter.model.numbers, rtol=1e-11)
    refused("a language must be one of", position.code, "cobol")
    assert set(LANGUAGES) == {"python", "filterpy", "pykalman", "matlab", "arduino"}


def test_lines_for_filterpy_give_the_same_estimates(position):
    pytest.importorskip("filterpy.kalman")
    setup, step = position.code("filterpy").split("# the first")
    names = {}
    exec(setup, names)
    kf, z = names["kf"], position.column.values
    kf.update(z[0])
    for k in range(1, 50):
        exec(step.split("\n", 1)[1], {**names, "z": z[k]})
        np.testing.assert_allclose(kf.x[:, 0], position.estimates.means[0, k], rtol=1e-6, atol=1e-9)
    before = kf.x
    exec(step.split("\n", 1)[1], {**names, "z": math.nan})
    np.testing.assert_allclose(kf.x, kf.F @ before)


@with_cc
def test_lines_for_a_controller_are_the_filter_once_it_has_settled(position, tmp_path):
    """Far from zero, too, where float would round z to half a unit; the first call sets the level."""
    code, library, far = position.code("arduino"), in_c(position, tmp_path), 5200300.0
    assert code.startswith("// a step is 0.1 s\n// measured: z [1]\n// state: position [1], velocity [1/s]\n")
    for k, z in enumerate(position.column.values):
        library.filter(z + far)
        if not k:
            assert [library.state(0), library.state(1)] == [z + far, 0.0]
    state = [library.state(0) - far, library.state(1)]
    np.testing.assert_allclose(state, position.estimates.means[0, -1], rtol=2e-6)


def test_a_controller_gets_no_constant_gain_that_needs_longer_than_the_record():
    nile = tuning.fit(np.array(NILE.split(), dtype=float), model="constant")
    values = {"constant_drift": 1.0, "harmonic_drift": 1e-6, "R": 15098.5}
    slow = replace(nile, chosen=nile.chosen._replace(name="constant + harmonic:period=11", values=values))
    refused("forget its start within the record, 99 s, but .* forgets in .*python", slow.code, "arduino")
    assert "# a step is 1 s" in slow.code("python") and "% a step is 1 s" in slow.code("matlab")


def test_a_controller_begins_at_the_level_of_a_sum():
    model = model_named("oscillator + constant:frequency=0.1,damping=0.2,std=0.5,drift=1,R=1")(dt=1.0)
    assert "    x1 = 0.0;\n    x2 = 0.0;\n    x3 = z;\n" in lines_of("arduino", model, np.full((3, 1), 0.1), 1.0)


@pytest.mark.parametrize("name", ["harmonic:period=12,harmonics=2", "ar:2", "constant + seasonal:period=4"])
def test_the_text_of_an_answer_makes_its_model_elsewhere(name):
    rng = np.random.default_rng(6)
    z = 300.0 + np.cumsum(rng.normal(size=(60, 2)), axis=0) + np.cos(2.0 * np.pi * np.arange(60) / 12)[:, None]
    for numbers in (z, z[:, 0]):
        fit = tuning.fit(numbers, model=name)
        model = model_named(fit.text)(dt=1.0)
        np.testing.assert_allclose(model.process_noise_cov, fit.q, rtol=5e-3, atol=1e-9)
        np.testing.assert_allclose(model.matrices()[4], fit.model.matrices()[4], rtol=1e-9)


def test_an_angle_that_wraps_goes_on():
    course = 40.0 * simulated("constant", 600)
    tables = ({"t": 0.1 * np.arange(600), "heading[deg]": angle} for angle in (course, np.mod(course, 360.0)))
    straight, wrapped = (tuning.fit(table, model="constant") for table in tables)
    assert wrapped.r == pytest.approx(straight.r, rel=1e-6) and wrapped.q == pytest.approx(straight.q, rel=1e-6)
    assert any("wraps" in sentence for sentence in wrapped.sentences())
    for language in LANGUAGES:
        assert "z + 360 round((z_before - z)/360)" in wrapped.code(language)
        assert "z_before" not in straight.code(language)


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


@with_cc
def test_a_controller_predicts_where_a_number_is_missing(tmp_path):
    fit = tuning.fit(Z, dt=0.1, model="constant")
    library = in_c(fit, tmp_path)
    for z in [math.nan, *Z, math.nan]:
        library.filter(z)
    assert library.state(0) == pytest.approx(fit.estimates.means[0, -1, 0], rel=1e-5)
