"""Tests of innovations in C: the alarms of `filters.monitoring`, step by step."""

import subprocess

import numpy as np
import pytest

from filters import run, thruster_model
from filters.c.project import c_filter, sizes_of, write_project
from filters.logs.estimate import estimate_with
from filters.logs.findings import alarms_of, columns_of
from filters.monitoring import TESTS, Monitor
from tests.filters.test_c import SANITIZERS, compiled, filtered, log_of, log_program, made
from tests.filters.test_filter_paths import diverging
from tests.models import lonely_model, simulated, wide_model
from thruster_env.core.streams import filter_keys
from thruster_env.env.model_env import ReplayEnv

pytestmark = pytest.mark.usefixtures("as_python")

MAIN = """\
#include "one.h"

#include <stdio.h>

int main(void)
{
    one filter;
    double given[@GIVEN@ + 1];
    @REAL@ u[@INPUTS@ + 1], z[@M@];

    one_init(&filter@KEY@);
    for (int k = 0;; k++) {
        for (int i = 0; i < @GIVEN@; i++) {
            if (scanf("%lf", &given[i]) != 1) {
                return 0;
            }
        }
        for (int i = 0; i < @INPUTS@; i++) {
            u[i] = (@REAL@)given[i];
        }
        for (int i = 0; i < @M@; i++) {
            z[i] = (@REAL@)given[@INPUTS@ + i];
        }
        if (k > 0) {
            one_predict(&filter@U@);
        }
        one_update(&filter, z);
        (void)u;
        for (int i = 0; i < @M@; i++) {
            for (int test = 0; test < 6; test++) {
                const one_channel *channel = &filter.channel[i];
                const int now = (int)(channel->alarms >> test & 1u);
                printf("%d %lu %.17g ", now, channel->since[test], (double)channel->size[test]);
            }
        }
        printf("%d\\n", filter.healthy);
    }
}
"""
MONITOR = Monitor(steps_between=2000.0, window=12, block=20, stuck=5, missing=4, memory=7)


def told_by_c(filter_, inputs, z, folder, monitor=MONITOR, single=False):
    """Alarms (step, test, channel, since, size) and `healthy` of each step."""
    model = filter_.kernel_model
    code = c_filter(filter_, "one", single=single, monitor=monitor)
    words = {
        "GIVEN": model.inputs + model.m,
        "INPUTS": model.inputs,
        "M": model.m,
        "REAL": "float" if single else "double",
        "U": ", u" * (model.inputs > 0),
        "KEY": "".join(f", {one:.0f}u" for one in filter_keys([0])[0]) * (filter_.size > 0),
    }
    main = MAIN
    for word, text in words.items():
        main = main.replace(f"@{word}@", str(text))
    for name, text in {"one.h": code.header, "one.c": code.source, "main.c": main}.items():
        (folder / name).write_text(text)
    promoted = ["-Wdouble-promotion"] * single
    compiled(folder, *promoted, *SANITIZERS, "one.c", "main.c", "-lm", "-o", "one")
    rows = np.concatenate([np.concatenate([np.zeros((1, model.inputs)), inputs]), z], axis=1)
    text = "\n".join(" ".join(f"{number:.17g}" for number in row) for row in rows)
    lines = subprocess.run([folder / "one"], input=text, capture_output=True, text=True, check=True).stdout
    found, healthy = [], []
    for k, line in enumerate(lines.splitlines()):
        *numbers, ok = map(float, line.split())
        healthy.append(bool(ok))
        told = np.reshape(numbers, (model.m, 6, 3))
        found += [
            (k, test, i, *told[i, test, 1:]) for test in range(6) for i in range(model.m) if told[i, test, 0]
        ]
    assert len(healthy) == len(z)
    return found, healthy


def told_by_python(filter_, inputs, z, monitor=MONITOR):
    """The same of a `Watch`."""
    estimates = run(filter_, None, inputs[None], z[None])
    watch, found, healthy = monitor.watch(z.shape[1]), [], []
    for k, seen in enumerate(z):
        health = watch.step(estimates.innovations[0, k], estimates.innovation_covs[0, k], seen)
        healthy.append(health.ok)
        found += [(k, TESTS.index(one.test), one.channel, one.since, one.size) for one in health.alarms]
    return found, healthy


def assert_same(found, expected, accuracy=1e-8):
    (alarms, healthy), (others, of_others) = found, expected
    assert [one[:4] for one in alarms] == [one[:4] for one in others]
    np.testing.assert_allclose([one[4] for one in alarms], [one[4] for one in others], rtol=accuracy, atol=1e-9)
    assert healthy == of_others


def faulty(model, steps=600):
    """A run whose last sensor is stuck, biased, noisy and gone, one after the other, and once far off."""
    inputs, z = (part[0] for part in simulated(model, steps, level=1.0, missing=0.1))
    last = z[:, -1]
    std = model.measurement_noise_cov[-1, -1] ** 0.5
    last[100:130] = last[np.flatnonzero(np.isfinite(last[:100]))[-1]]
    last[200:230] += 4.0 * std
    last[300:360] += 6.0 * std * np.random.default_rng(3).normal(size=60)
    last[400:420] = np.nan
    last[450] += 30.0 * std
    last[500:530] -= 3.0 * std
    return inputs, z


@pytest.mark.parametrize("make", [wide_model, thruster_model, lonely_model])
@pytest.mark.parametrize("name", ["ekf", "enkf", "sage-husa"])
def test_alarms_are_those_of_python_step_by_step(name, make, tmp_path):
    filter_ = made(name, make())
    inputs, z = faulty(filter_.model)
    expected = told_by_python(filter_, inputs, z)
    assert_same(told_by_c(filter_, inputs, z, tmp_path), expected)
    assert {one[1] for one in expected[0]} >= {TESTS.index(test) for test in ("outlier", "stuck", "missing")}
    assert not all(expected[1]) and any(expected[1])


def test_every_test_raises_alarms_in_c(tmp_path):
    filter_ = made("ekf", wide_model())
    inputs, z = faulty(filter_.model)
    alarms, healthy = told_by_c(filter_, inputs, z, tmp_path)
    assert {one[1] for one in alarms} == set(range(6))
    at = [one for one in alarms if TESTS[one[1]] == "stuck" and one[2] == 1]
    assert any(100 <= one[0] < 110 and one[4] == MONITOR.stuck for one in at)
    assert {one[0] for one in alarms if TESTS[one[1]] == "missing" and one[2] == 1 and 400 <= one[0] < 420}
    assert not any(healthy[106:130]) and not any(healthy[404:420])  # longer than MONITOR.memory after the alarm


def test_floats_raise_the_same_alarms_of_a_stuck_sensor(tmp_path):
    filter_ = made("ekf", wide_model())
    inputs, z = faulty(filter_.model)
    found, expected = told_by_c(filter_, inputs, z, tmp_path, single=True), told_by_python(filter_, inputs, z)
    counted = [TESTS.index(one) for one in ("stuck", "missing")]
    of_both = [[one for one in alarms if one[1] in counted] for alarms, _ in (found, expected)]
    assert of_both[0] == of_both[1] and len(of_both[0]) > 1
    assert len(set(one[:3] for one in found[0]) ^ set(one[:3] for one in expected[0])) <= len(expected[0]) // 10


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # Python says so when a number overflows
def test_a_filter_that_is_lost_says_nothing_of_its_sensors(tmp_path):
    filter_, inputs, z = diverging("ekf")
    inputs, z = np.repeat(inputs[0], 4, axis=0), np.concatenate([z[0, :1], np.repeat(z[0, 1:], 4, axis=0)])
    assert_same(told_by_c(filter_, inputs, z, tmp_path), told_by_python(filter_, inputs, z))


def test_a_project_counts_alarms_as_estimate_does(tmp_path):
    model = thruster_model()
    inputs, z = faulty(model)
    filter_ = made("ekf", model)
    monitor, log = {"steps_between": 2000.0, "stuck": 5}, log_of(model, inputs, z)
    program, _ = log_program(filter_, tmp_path, *SANITIZERS, monitor=monitor)
    headers, *rows = (line.split(",") for line in filtered(program, log).splitlines())
    (tmp_path / "log.csv").write_text(log)
    found = estimate_with(filter_, ReplayEnv(tmp_path / "log.csv", model).log)
    alarms = alarms_of(found, Monitor(steps_between=2000.0, stuck=5), 50)
    expected = columns_of(found, alarms)["alarm_thrust"]
    place = headers.index("alarm_thrust")
    assert [float(row[place]) for row in rows] == expected.tolist() and expected.sum() > 3


def test_the_readme_has_the_thresholds_and_the_bytes(tmp_path):
    filter_, monitor = made("ekf", wide_model()), Monitor()
    write_project(filter_, tmp_path, "one", monitor=100_000)
    readme = (tmp_path / "README.md").read_text()
    limits = monitor.limits(2)
    for number in (limits[1], limits[2], limits[3], limits[4], *limits[8:]):
        assert f"{number:.4g}" in readme
    code = c_filter(filter_, "one", monitor=monitor)
    tested, plain = sizes_of(code), sizes_of(c_filter(filter_, "one"))
    ring = 2 * 8 * monitor.window
    assert (
        f"| struct | {tested.struct}" in readme and plain.struct + ring < tested.struct < plain.struct + 2 * ring
    )
    assert "tests" not in c_filter(filter_, "one").header and "1 | `ONE_OUTLIER` |" in readme


def test_a_class_of_cpp_tells_alarms(tmp_path):
    write_project(made("ekf", lonely_model()), tmp_path, "one", monitor={"stuck": 3})
    (tmp_path / "use.cpp").write_text(
        '#include "one.hpp"\n#include <cstdio>\nint main()\n{\n    OneFilter filter;\n'
        "    const OneFilter::Real z[1] = {6};\n    for (int k = 0; k < 3; k++) {\n        filter.predict();\n"
        '        filter.update(z);\n        std::printf("%d ", (filter.alarms(0) & ONE_STUCK) != 0);\n    }\n'
        '    std::printf("%d ", filter.healthy());\n    filter.test_anew();\n'
        '    std::printf("%d %u\\n", filter.healthy(), filter.alarms(0));\n}\n'
    )
    compiled(tmp_path, "-c", "one.c")
    compiled(tmp_path, command="g++ -std=c++11 -Wall -Wextra -Werror use.cpp one.o -lm -o use".split())
    printed = subprocess.run([tmp_path / "use"], capture_output=True, text=True, check=True).stdout
    assert printed.split() == ["0", "0", "1", "0", "1", "0"]
