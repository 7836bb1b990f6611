"""Loops of ours get vectors of 512 bits where the processor has them; those of others are as they were."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from thruster_env.core.compiled import compiled, inlined

ROOT = Path(__file__).parents[3]
WIDE = '"prefer-vector-width"="512"'
LOOP = """\
def add_squares(out, values):
    for i in range(values.shape[0]):
        out[i] += values[i] * values[i]
"""
ON_INTEL = """\
import sys
sys.path.insert(0, sys.argv[1])
import numba
from thruster_env.core.compiled import compiled
from loop import add_squares

def plain_squares(out, values):
    for i in range(values.shape[0]):
        out[i] += values[i] * values[i]

for code in (compiled(add_squares), numba.njit(plain_squares)):
    code.compile("void(f8[::1], f8[::1])")
    print("%zmm" in code.inspect_asm(code.signatures[0]))
"""


@inlined
def add_squares(out, values):
    for i in range(values.shape[0]):
        out[i] += values[i] * values[i]


@pytest.mark.parametrize(("wrap", "wide"), [(compiled, True), (numba.njit, False)])
def test_functions_of_ours_are_wide(tmp_path, wrap, wide):
    path = tmp_path / "outermost.py"  # no cache has seen it
    path.write_text("def outermost(out, values):\n    add_squares(out, values)\n    return out.sum()\n")
    names = {"__name__": __name__, "add_squares": add_squares}
    exec(compile(path.read_text(), str(path), "exec"), names)
    function = wrap(names["outermost"])
    assert function(np.zeros(3), np.array([1.0, 2.0, 3.0])) == 14.0
    (text,) = function.inspect_llvm().values()
    assert (WIDE in text) is wide


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="there are no such vectors")
def test_an_intel_processor_would_use_them(tmp_path):
    (tmp_path / "loop.py").write_text(LOOP)
    (tmp_path / "on_intel.py").write_text(ON_INTEL)
    target = {"NUMBA_CPU_NAME": "skylake-avx512", "NUMBA_CPU_FEATURES": "+avx512f,+avx512vl,+avx512dq,+avx2,+fma"}
    environment = {**os.environ, **target, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, str(tmp_path / "on_intel.py"), str(ROOT)]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["True", "False"]
