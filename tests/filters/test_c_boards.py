"""Filters in C within C++, how many bytes they take, and on a Cortex-M4 that QEMU emulates."""

import shutil
import subprocess
from importlib.util import find_spec

import numpy as np
import pytest

from benchmarks.c_code import measures
from filters import make_filter, run, thruster_model
from filters.c.project import BOARD, BUILD, EMULATE, MEMORY, c_filter, sizes_of, write_project
from tests.filters.test_c import ENSEMBLES, OWN, WARNINGS, built, made, printed
from tests.models import lonely_model, simulated

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
    for command in (
        ["gcc", *WARNINGS, "-c", "one.c"],
        "g++ -std=c++11 -Wall -Wextra -Werror use.cpp one.o -lm -o use".split(),
    ):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
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
    command = BUILD.format(name="one", flags=" ".join(WARNINGS)).split()
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    board = EMULATE.format(name=tmp_path / "one").split()
    found = printed(board, inputs[0], z[0])
    accuracy = 2e-4 if single else 1e-12
    for one, other in zip(found.T, expected.T, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=accuracy * abs(other).max())
    means = run(filter_, None, inputs, z).means[0]
    np.testing.assert_allclose(found[:, :2], means, rtol=0, atol=1e-3 * abs(means).max())
