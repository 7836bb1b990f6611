"""Names of filters in C: none that C, C++, their libraries or the files themselves use."""

import shutil
import subprocess

import pytest

from filters import make_filter
from filters.c.project import c_filter, write_project
from filters.monitoring import monitor_of
from tests.models import scalar_model, state_space

TAKEN = """exp R propagate NAN new class double_t correct add_process_noise filter x u z t0 i P prior_mean line
math board is_lost update reset Real values states INFINITY isnan expf y0 gamma M_PI INT8_MAX NULL printf
remove index string time COLUMNS uint32_t become_prior true template namespace operator x_t hypotl stdin""".split()
FREE = "ekf EKF tank torque stroke member R_ a test draw philox EKF_2 expo L MOTOR".split()


@pytest.mark.parametrize("name", TAKEN)
def test_a_name_that_is_taken_is_refused_in_one_line(name):
    with pytest.raises(ValueError, match=rf"a name in C must be [^\n]* but got '{name}'"):
        c_filter(make_filter("ekf", scalar_model()), name)


def test_names_of_the_tests_are_taken_only_where_there_are_some():
    assert c_filter(make_filter("ekf", scalar_model()), "sound").name == "sound"
    for name in ("sound", "test"):  # static functions sound, and test_update
        with pytest.raises(ValueError, match=f"but got '{name}'"):
            c_filter(make_filter("ekf", scalar_model()), name, monitor=monitor_of(1e5))


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
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.skipif(not shutil.which("gcc"), reason="needs gcc")
def test_a_compiler_that_takes_nan_for_a_number_is_refused(tmp_path):
    write_project(make_filter("ekf", scalar_model()), tmp_path, "tank")
    for flag, code in (("-O2", 0), ("-ffast-math", 1), ("-Ofast", 1), ("-ffinite-math-only", 1)):
        command = ["gcc", "-std=c99", flag, "-c", "tank.c"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == code and ("compile without -ffast-math" in done.stderr) == bool(code)
