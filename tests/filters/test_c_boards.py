"""Filters in C within C++, how many bytes they take, and on a Cortex-M4 that QEMU emulates."""

import shutil
import subprocess
from importlib.util import find_spec

import numpy as np
import pytest

from benchmarks.c_code import measures
from filters import run, thruster_model
from filters.c.project import BOARD, BUILD, EMULATE, MEMORY
from tests.filters.test_c import ENSEMBLES, OWN, WARNINGS, built, made, printed
from tests.models import simulated

CROSS, EMULATOR = BUILD.split()[0], EMULATE.split()[0]


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
