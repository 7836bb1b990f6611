"""Filters in C: names, C++, bytes, ensembles' random numbers, and a Cortex-M4 that QEMU emulates."""

import shutil
import subprocess
from importlib.util import find_spec

import numpy as np
import pytest

from benchmarks.c_code import measures
from filters import make_filter, run, thruster_model
from filters.c.project import BOARD, BUILD, EMULATE, MEMORY, c_filter, sizes_of, write_project
from filters.monitoring import monitor_of
from tests.filters.checks import refused
from tests.filters.test_c import (
    ENSEMBLES,
    OWN,
    SANITIZERS,
    WARNINGS,
    assert_same,
    built,
    compiled,
    estimated,
    made,
    printed,
)
from tests.filters.test_ensemble_pages import PartlyFilter
from tests.filters.test_pages import wide_pendulum
from tests.models import lonely_model, random_affine, scalar_model, simulated, state_space, wide_model

USE = """\
#include "one.hpp"
#include <cstdio>

int main()
{
    OneFilter filter;
    const OneFilter::Real z[OneFilter::measurements] = {@Z@};
    for (int k = 0; k < 3; k++) {
        @PREDICT@
        filter.update(z);
    }
    const OneFilter copy = filter;
    filter.reset();
    std::printf("%.17g %.17g %.17g %.17g\\n", double(copy.estimate(0)), double(copy.covariance(0, 0)),
                double(copy.values().nis), double(filter.estimate(0)));
}
"""
CROSS, EMULATOR = BUILD.split()[0], EMULATE.split()[0]


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("make", [thruster_model, lonely_model])
@pytest.mark.parametrize("name", ["ekf", "enkf"])
def test_a_class_of_cpp_is_the_filter(name, make, single, tmp_path):
    model = make()
    filter_ = made(name, model)
    write_project(filter_, tmp_path, "one", single=single)
    u = "const OneFilter::Real u[OneFilter::inputs] = {12}; filter.predict(u);"
    main = USE.replace("@PREDICT@", u if model.inputs else "filter.predict();")
    (tmp_path / "use.cpp").write_text(main.replace("@Z@", ", ".join(["1"] * model.m)))
    compiled(tmp_path, "-c", "one.c")
    compiled(tmp_path, command="g++ -std=c++11 -Wall -Wextra -Werror use.cpp one.o -lm -o use".split())
    belief, z = filter_.init(), [1.0] * model.m
    for _ in range(3):
        belief, told = filter_.update(filter_.predict(belief, [12.0] * model.inputs), z)
    nis = told.value @ np.linalg.solve(told.cov, told.value)
    words = subprocess.run([tmp_path / "use"], capture_output=True, text=True, check=True).stdout.split()
    expected = belief.mean[0], belief.cov[0, 0], nis, filter_.init().mean[0]
    np.testing.assert_allclose(list(map(float, words)), expected, rtol=1e-3 if single else 1e-10)


def test_sizes_are_those_of_what_is_compiled(tmp_path):
    double, single = (sizes_of(c_filter(make_filter("vb", thruster_model()), single=one)) for one in (False, True))
    numbers = 2 + 4 + 1 + 1 + 2 + 2  # x, P, innovation, S, NIS and log-likelihood, V and nu
    assert double is not None and single is not None
    assert (double.struct, single.struct) == (8 * numbers + 16, 4 * numbers + 16)
    assert 0 < single.stack < double.stack < 4096 and 1024 < double.code < 16384
    write_project(make_filter("vb", thruster_model()), tmp_path)
    assert f"| struct | {double.struct} |" in (tmp_path / "README.md").read_text()


def test_without_a_compiler_sizes_are_not_told(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert sizes_of(c_filter(make_filter("ekf", thruster_model()))) is None
    write_project(make_filter("ekf", thruster_model()), tmp_path)
    assert "| struct | not measured |" in (tmp_path / "README.md").read_text()


@pytest.mark.skipif(find_spec("casadi") is None, reason="CasADi is compared with where `make bench` brought it")
def test_a_step_of_casadi_is_that_of_ours(tmp_path):
    assert all(0.0 < one() < 1e-3 for one in measures(tmp_path, 0))  # which compares 20 000 estimates


@pytest.mark.slow
@pytest.mark.skipif(
    not (shutil.which(CROSS) and shutil.which(EMULATOR)),
    reason="a Cortex-M4 is emulated where gcc-arm-none-eabi and qemu-system-arm of Debian are there",
)
@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("name", [*OWN, *ENSEMBLES])
def test_a_cortex_m4_computes_what_this_computer_does(name, single, tmp_path):
    filter_ = made(name, thruster_model())
    inputs, z = simulated(filter_.model, 100, level=10.0, missing=0.2)
    expected = printed(built(filter_, tmp_path, single=single), inputs[0], z[0])
    (tmp_path / "board.c").write_text(BOARD)
    (tmp_path / "board.ld").write_text(MEMORY)
    compiled(tmp_path, command=BUILD.format(name="one", flags=" ".join(WARNINGS)).split())
    board = EMULATE.format(name=tmp_path / "one").split()
    found = printed(board, inputs[0], z[0])
    accuracy = 2e-4 if single else 1e-12
    for one, other in zip(found.T, expected.T, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=accuracy * abs(other).max())
    means = run(filter_, None, inputs, z).means[0]
    np.testing.assert_allclose(found[:, :2], means, rtol=0, atol=1e-3 * abs(means).max())


TAKEN = """exp R propagate NAN new class double_t correct add_process_noise filter x u z t0 i P prior_mean line
math board is_lost update reset Real values states INFINITY isnan expf y0 gamma M_PI INT8_MAX NULL printf
remove index string time COLUMNS uint32_t become_prior true template namespace operator x_t hypotl stdin""".split()
FREE = "ekf EKF tank torque stroke member R_ a test draw philox EKF_2 expo L MOTOR".split()


@pytest.mark.parametrize("name", TAKEN)
def test_a_name_that_is_taken_is_refused_in_one_line(name):
    refused(rf"a name in C must be [^\n]* but got '{name}'", c_filter, make_filter("ekf", scalar_model()), name)


def test_names_of_the_tests_are_taken_only_where_there_are_some():
    assert c_filter(make_filter("ekf", scalar_model()), "sound").name == "sound"
    for name in ("sound", "test"):  # static functions sound, and test_update
        refused(f"but got '{name}'", c_filter, make_filter("ekf", scalar_model()), name, monitor=monitor_of(1e5))


ODD = ["exp", "a*/b", "a/*b", "what??/", 'q"uote', "R", "%d", "back\\slash", "naïve"]


def of_odd_names():
    """A model whose states and channels have odd names."""
    names = [(name, f"s{k}", "") for k, name in enumerate(ODD)]
    noise = {"q": [1.0] * len(ODD), "r": [1.0] * len(ODD)}
    prior = {"mean": [0.0] * len(ODD), "cov": [1.0] * len(ODD)}
    return state_space(
        lambda x, u, c: x, lambda x, c: x, **noise, **prior, inputs=0, states=names, measurements=names
    )


@pytest.mark.skipif(not shutil.which("g++"), reason="needs gcc")
@pytest.mark.slow
@pytest.mark.parametrize(("name", "make"), [*((name, scalar_model) for name in FREE), ("odd", of_odd_names)])
def test_a_free_name_and_any_names_of_quantities_compile_in_c_and_cpp(name, make, tmp_path):
    write_project(make_filter("ekf", make()), tmp_path, name)
    strict = ["-Wall", "-Wextra", "-Werror"]
    (tmp_path / "use.cpp").write_text(
        f'#include <cmath>\n#include <cstdlib>\n#include "{name}.hpp"\nint main() {{ return 0; }}\n'
    )
    for command in (
        ["gcc", "-std=c99", *strict, f"{name}.c", "main.c", "-lm", "-o", "log"],
        ["gcc", "-std=gnu17", f"{name}.c", "main.c", "-lm", "-o", "log"],
        ["g++", "-std=c++17", *strict, "-c", "use.cpp"],
    ):
        compiled(tmp_path, command=command)


@pytest.mark.skipif(not shutil.which("gcc"), reason="needs gcc")
def test_a_compiler_that_takes_nan_for_a_number_is_refused(tmp_path):
    write_project(make_filter("ekf", scalar_model()), tmp_path, "tank")
    for flag, code in (("-O2", 0), ("-ffast-math", 1), ("-Ofast", 1), ("-ffinite-math-only", 1)):
        command = ["gcc", "-std=c99", flag, "-c", "tank.c"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == code and ("compile without -ffast-math" in done.stderr) == bool(code)


USE_BETWEEN = """\
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
    made_, use = c_filter(filter_, "one"), USE_BETWEEN.replace("@KEY@", "3, 4294967295u")
    for name, text in {"one.h": made_.header, "one.c": made_.source, "use.c": use}.items():
        (tmp_path / name).write_text(text)
    compiled(tmp_path, "one.c", "use.c", "-lm", "-o", "use")
    words = subprocess.run([tmp_path / "use"], capture_output=True, text=True, check=True).stdout.split()
    prior = filter_.init(key)
    expected = [
        number for one in (prior, filter_.predict(prior, [0.5])) for number in (one.mean[0], one.cov[1, 1])
    ]
    np.testing.assert_allclose([float(word) for word in words], expected, rtol=1e-12)
