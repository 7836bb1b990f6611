"""Filters in C: compiled without a warning, and the numbers of `run`."""

import dataclasses
import itertools
import math
import re
import shutil
import subprocess

import numpy as np
import pytest

from filters import StateSpaceModel, make_filter, run, thruster_model
from filters.c.programs import programs_of, single_error
from filters.c.project import c_filter, write_project
from filters.logs.estimate import estimate_with
from filters.logs.findings import columns_of
from tests.filters.checks import refused
from tests.filters.test_filter_paths import diverging
from tests.filters.test_pages import wide_pendulum
from tests.models import lonely_model, random_affine, scalar_model, simulated, wide_model
from tests.oracles import each_close
from tests.slow import slow_but
from thruster_env.auv.model import auv_model
from thruster_env.core.angles import difference
from thruster_env.core.streams import filter_keys
from thruster_env.env.model_env import ReplayEnv
from thruster_env.graphs.graphs import Graph, arctan2, where
from thruster_env.graphs.programs import Place, literal, program_of, statements_of
from thruster_env.logs.read import read_log
from tuning.cli.templates.filter import Template

pytestmark = pytest.mark.usefixtures("as_python")

WARNINGS = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
SANITIZERS = ["-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
OWN = {
    "kf": {},
    "kf information": {"form": "information"},
    "kf square-root": {"form": "square-root"},
    "kf ud": {"form": "ud"},
    "kf-steady": {},
    "ekf": {},
    "ekf square-root": {"form": "square-root"},
    "ekf ud": {"form": "ud"},
    "iekf": {"iterations": 3},
    "ukf": {"alpha": 0.8, "beta": 1.5, "kappa": 1.0},
    "ukf square-root": {"form": "square-root"},
    "ckf": {},
    "fading": {"fading": 1.1},
    "h-infinity": {"theta": 0.002},
    "schmidt": {"considered": [0]},
    "ekf-robust": {"degrees_of_freedom": 3.0, "iterations": 3},
    "sage-husa": {"forgetting_factor": 0.9, "process_forgetting_factor": 0.8},
    "vb": {"forgetting_factor": 0.9, "prior_weight": 6.0, "iterations": 2},
}
ENSEMBLES = {
    "enkf": {},
    "enkf centred": {"centred_perturbations": 1, "inflation": 1.02},
    "etkf": {"relaxation": 0.3},
    "letkf": {},
    "ensrf": {"inflation": 1.02},
    "denkf": {},
    "ienkf": {"iterations": 2},
    "enkf-n": {"certainty": 1.5, "inflation": 1.02},
    "denkf adaptive": {"adaptive_inflation": 0.3, "inflation": 1.02, "relaxation": 0.3},
    "etkf by state": {"adaptive_inflation": 0.3, "least_deviation": 0.05, "inflation_by_state": 1},
}
KEPT = {
    "kf square-root": ["L"],
    "ekf ud": ["UD"],
    "ekf-robust": ["weight"],
    "sage-husa": ["R", "Q", "predicted"],
    "vb": ["V", "nu"],
    "denkf adaptive": ["factor"],
    "etkf by state": ["factor", "width"],
}
MODELS = {
    "thruster": lambda: thruster_model(operating_voltage=3.0),
    "pendulum": lambda: wide_pendulum().replace(operating_state=[0.3, 0.0], operating_input=[0.5]),
    "affine": wide_model,
    "no input": lonely_model,
}
MAIN = """\
#include "{name}.h"

#include <stdio.h>

static int numbers(int count, {real} *to)
{{
    for (int i = 0; i < count; i++) {{
        double number;
        if (scanf("%lf", &number) != 1) {{
            return 0;
        }}
        to[i] = ({real})number;
    }}
    return 1;
}}

static void show(int count, const {real} *of)
{{
    for (int i = 0; i < count; i++) {{
        printf("%.17g ", (double)of[i]);
    }}
}}

int main(void)
{{
    {name} filter;
    {real} u[{inputs} + 1], z[{m}];

    {name}_init(&filter{key});
    for (int k = 0; numbers(k > 0 ? {inputs} : 0, u) && numbers({m}, z); k++) {{
        if (k > 0) {{
            {name}_predict(&filter{u});
        }}
        {name}_update(&filter, z);
        show({n}, filter.x);
        show({n} * {n}, filter.P);
        show({m}, filter.innovation);
        show({m} * {m}, filter.S);
        show(1, &filter.log_likelihood);
        show(1, &filter.nis);
        {kept}printf("%d %lu\\n", filter.channels, filter.restarts);
    }}
    return 0;
}}
"""


def compiled(folder, *options, command=("gcc", *WARNINGS)):
    """Compile in a folder, without a warning."""
    done = subprocess.run([*command, *options], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def log_program(filter_, folder, *flags, **options):
    """The program that filters logs, of a project in a folder."""
    files = write_project(filter_, folder, "one", **options)
    compiled(folder, *flags, "one.c", "main.c", "-lm", "-o", "one_log")
    return folder / "one_log", [file.name for file in files]


def filtered(program, log, *words):
    """What the program prints of a log."""
    return subprocess.run([program, *words], input=log, capture_output=True, text=True, check=True).stdout


def built(filter_, folder, *, single=False, compiler="gcc", flags=(), key=None):
    """The program MAIN of a filter; an ensemble has the key of seed 0."""
    made, model = c_filter(filter_, "one", single=single), filter_.kernel_model
    key = "".join(f", {word:.0f}u" for word in key or filter_keys([0])[0]) if filter_.size else ""
    u, real = ", u" * (model.inputs > 0), "float" if single else "double"
    kept = "".join(
        f"show({math.prod(shape)}, {'' if shape else '&'}filter.{name});\n        "
        for name, shape in programs_of(filter_).extras.items()
    )
    main = MAIN.format(name="one", real=real, inputs=model.inputs, n=model.n, m=model.m, u=u, kept=kept, key=key)
    for name, text in {"one.h": made.header, "one.c": made.source, "main.c": main}.items():
        (folder / name).write_text(text)
    compiled(folder, *flags, "one.c", "main.c", "-lm", "-o", "one", command=(compiler, *WARNINGS))
    return folder / "one"


def printed(program, inputs, z):
    """The numbers that the program prints of each step, (K + 1, ...)."""
    rows = [z[0], *np.concatenate([inputs, z[1:]], axis=1)]
    text = "\n".join(" ".join(f"{number:.17g}" for number in row) for row in rows)
    result = subprocess.run(program, input=text, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return np.array([[float(word) for word in line.split()] for line in result.stdout.splitlines()])


def estimated(program, model, inputs, z):
    """Estimates of one run, NIS, channels and restarts of each step."""
    found, n, m = printed(program, inputs, z), model.n, model.m
    found, channels, restarts = found[:, :-2], found[:, -2:-1], found[:, -1:]
    x, p, v, s, level, nis, _ = np.split(found, np.cumsum([n, n * n, m, m * m, 1, 1]), axis=1)
    return (x, p.reshape(-1, n, n), v, s.reshape(-1, m, m), level[:, 0]), nis[:, 0], channels[:, 0], restarts[:, 0]


def assert_same(found, expected, accuracy):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=accuracy * abs(other).max())


NAMES = [*OWN, *ENSEMBLES]
# Every filter has the pendulum, with angles and two channels; the second model changes from filter to filter.
ALTERNATING = [
    pytest.param(name, which, "gcc", marks=pytest.mark.slow)
    for name, which in zip(NAMES, itertools.cycle(["thruster", "affine", "no input"]), strict=False)
]
CLANG = pytest.mark.skipif(shutil.which("clang") is None, reason="there is no clang to compile with")
OF_CLANG = "kf ud", "iekf", "ukf square-root", "vb", "letkf", "ienkf"


def made(name, model):
    if name in ENSEMBLES:
        return make_filter(name.split()[0], model, ensemble_size=13, **ENSEMBLES[name])
    return make_filter(name.split()[0], model, **OWN[name])


@pytest.mark.parametrize(
    ("name", "which", "compiler"),
    [
        *((name, "pendulum", "gcc") for name in NAMES),
        *ALTERNATING,
        *(pytest.param(name, "thruster", "clang", marks=CLANG) for name in OF_CLANG),
    ],
)
def test_steps_are_those_of_run(name, which, compiler, tmp_path):
    model = MODELS[which]()
    inputs, z = simulated(model, 200 if which == "thruster" else 60, level=1.0, missing=0.2)
    filter_ = made(name, model)
    expected = [part[0] for part in run(filter_, None, inputs, z)[:5]]
    program = built(filter_, tmp_path, compiler=compiler)
    found, nis, channels, restarts = estimated(program, filter_.kernel_model, inputs[0], z[0])
    assert_same(found, expected, 1e-12)
    v, s = expected[2:4]
    np.testing.assert_allclose(nis, (v * np.linalg.solve(s, v[..., None])[..., 0]).sum(-1), rtol=1e-8, atol=1e-10)
    assert channels.tolist() == np.isfinite(z[0]).sum(-1).tolist() and not restarts.any()


@pytest.mark.parametrize("name", [*KEPT, "schedule"])
def test_what_a_filter_keeps_has_a_name_and_the_numbers_of_the_belief(name, tmp_path):
    model = thruster_model()
    filter_ = make_filter("kf", model, schedule=4) if name == "schedule" else made(name, model)
    inputs, z = simulated(model, 60, level=10.0, missing=0.2)
    header = c_filter(filter_, "one").header
    assert all(re.search(rf"double {one}\W", header) for one in KEPT.get(name, ["c"]))
    belief, extras = filter_.init(filter_keys([0])[0]), []
    for k, seen in enumerate(z[0]):
        belief = filter_.predict(belief, inputs[0, k - 1]) if k else belief
        belief, _ = filter_.update(belief, seen)
        extras.append(belief.extras)
    program = built(filter_, tmp_path)
    found, *_ = estimated(program, filter_.kernel_model, inputs[0], z[0])
    assert_same(found, [part[0] for part in run(filter_, None, inputs, z)[:5]], 1e-12)
    assert_same(printed(program, inputs[0], z[0])[:, -2 - len(belief.extras) : -2].T, np.transpose(extras), 1e-12)


@pytest.mark.parametrize("which", ["thruster", "pendulum", "affine"])
def test_a_users_filter_is_that_of_run(which, tmp_path):
    filter_ = Template(model=MODELS[which](), bandwidth=2.0)
    inputs, z = simulated(filter_.model, 200, level=1.0, missing=0.2)
    found, *_ = estimated(built(filter_, tmp_path), filter_.kernel_model, inputs[0], z[0])
    assert_same(found, [one[0] for one in run(filter_, None, inputs, z)[:5]], 1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_a_vehicle_and_many_states(name, tmp_path):
    for model in (auv_model(states="velocities"), random_affine(9, 4, 1)):
        inputs, z = simulated(model, 25, level=1.0, missing=0.2)
        filter_ = made(name, model)
        found, *_ = estimated(built(filter_, tmp_path), model, inputs[0], z[0])
        assert_same(found, [part[0] for part in run(filter_, None, inputs, z)[:5]], 1e-12)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # Python says so when a number overflows
@pytest.mark.parametrize("name", NAMES)
def test_a_belief_that_is_lost_becomes_the_prior_and_no_sanitizer_complains(name, tmp_path):
    filter_, inputs, z = diverging(name.split()[0])
    own = OWN[name] if name in OWN else {"ensemble_size": 13, **ENSEMBLES[name]}
    chosen = {key: value for key, value in own.items() if key == "form" or name in ENSEMBLES}
    filter_ = dataclasses.replace(filter_, **chosen)
    program = built(filter_, tmp_path, flags=SANITIZERS)
    found, nis, _, restarts = estimated(program, filter_.kernel_model, inputs[0], z[0])
    expected = run(filter_, None, inputs, z)
    assert restarts[-1] == expected.divergences[0] > 0 and nis[np.diff(restarts, prepend=0) > 0].tolist()[0] == 0.0
    assert_same(found, [part[0] for part in expected[:5]], 1e-12)


@pytest.mark.parametrize("name", slow_but(NAMES, ("ekf", "kf square-root", "etkf")))
def test_single_precision(name, tmp_path):
    for which in ("thruster", "pendulum") if name in ("ekf", "ukf", "etkf") else ("pendulum",):
        model = MODELS[which]()
        inputs, z = simulated(model, 80, level=1.0, missing=0.2)
        filter_ = made(name, model)
        program = built(filter_, tmp_path, single=True, flags=["-Wdouble-promotion", *SANITIZERS])
        found, *_, restarts = estimated(program, filter_.kernel_model, inputs[0], z[0])
        exact = run(filter_, None, inputs, z)
        assert_same(found, [part[0] for part in exact[:5]], 1e-3)
        assert not restarts.any()
        off = abs(difference(found[0], exact.means[0], filter_.kernel_model.shape.state_angles))
        compiled = (off / np.sqrt(np.einsum("kii->ki", exact.covs[0]))).max()
        told = single_error(filter_, programs_of(filter_), inputs[0], z[0])
        assert 1e-8 < told < 1e-3 and told / 10 < compiled < 10 * told


def test_a_program_computes_in_c_what_it_computes_in_python(tmp_path):
    """Every operation, at a few numbers."""
    graph = Graph()
    x, y = (graph.given(Place("given", k)) for k in range(2))
    functions = [getattr(abs(x), name)() for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "arctan", "tanh")]
    functions += [x.sinh(), x.cosh(), x.floor(), x.ceil(), abs(x), arctan2(y, x), abs(x) ** y, abs(x) ** 1.7, -x]
    functions += [x + y, x - y, x * y, x / y, 0.1 * x, x - 3e-7, x * 1e300, x % 2.0]
    functions += [where(x < y, 1.0, -2.5), where(x <= y, x, y), where(x > y, x, y), where(x >= y, math.nan, y)]
    functions += [where(x == y, x, math.inf), where(x != y, x, -math.inf), where((x == x) & (y == y), x, 7.0)]
    program = program_of([(Place("out", k), one) for k, one in enumerate(functions)], {})
    body = "".join(f"    {line}\n" for line in statements_of(program))
    shown = f'    for (int i = 0; i < {len(functions)}; i++) printf("%.17g\\n", out[i]);\n'
    source = "#include <math.h>\n#include <stdio.h>\n#include <stdlib.h>\nint main(int count, char **words)\n{\n"
    source += f"    double out[{len(functions)}], given[2] = {{atof(words[1]), atof(words[count - 1])}};\n"
    (tmp_path / "main.c").write_text(source + body + shown + "    return 0;\n}\n")
    compiled(tmp_path, "main.c", "-lm", "-o", "main")
    for a, b in ((0.3, 1.2), (-1.7, 0.4), (2.5, 2.5), (math.nan, 1.0)):
        printed = subprocess.run([tmp_path / "main", repr(a), repr(b)], capture_output=True, text=True, check=True)
        with np.errstate(all="ignore"):
            expected = evaluated(program, len(functions), [a, b])
        np.testing.assert_allclose([float(line) for line in printed.stdout.split()], expected, rtol=1e-14)


def evaluated(program, count, numbers):
    names = {**vars(np), "given": np.array(numbers), "out": np.empty(count)}
    exec("\n".join(program.text), names)
    return names["out"]


def test_numbers_are_written_with_all_their_digits():
    rng = np.random.default_rng(0)
    for value in map(float, [*(rng.normal(size=50) * 10.0 ** rng.integers(-300, 300, 50)), 0.1, 1.0, 0.0]):
        assert float(literal(value).strip("()")) == value
        with np.errstate(over="ignore"):
            single = np.float32(value)
        text = literal(value, single=True).strip("()")
        if 2e-38 < abs(single) < math.inf:
            assert text.endswith("f") and np.float32(text[:-1]) == single
    assert [literal(value, single=True) for value in (1e-200, -1e-200, 1e200)] == [
        "1.1754944e-38f",
        "(-1.1754944e-38f)",
        "INFINITY",
    ]
    assert literal(math.nan) == "NAN" and literal(-math.inf) == "(-INFINITY)"


def decides(x, u, c):
    return (x[0] if int(x[0] > 1.0) else u[0],)


def looked_up(x, c):
    return ([3.0, 4.0][int(x[0])],)


def plain(x, u, c):
    return (0.5 * x[0] + u[0],)


def sight(x, c):
    return (x[0],)


def small(**functions):
    chosen = {"transition": plain, "observe": sight, **functions}
    return StateSpaceModel(
        **chosen,
        process_noise_cov=[0.1],
        measurement_noise_cov=[0.1],
        prior_mean=[0.2],
        prior_cov=[1.0],
        inputs=1,
        states=[("a */ b", "level", "\N{DEGREE SIGN}")],
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: c_filter(make_filter("pf", scalar_model())),
            "a filter in C must have a page without resampling, as 'ekf' and 'enkf' have, but got 'pf'",
        ),
        (
            lambda: c_filter(make_filter("etkf", scalar_model(), rotations=1)),
            "an ensemble in C must have no random rotations, but got rotations=1",
        ),
        (lambda: c_filter(made("ekf", scalar_model()), "a b"), "no keyword, but got 'a b'"),
        (lambda: c_filter(made("ekf", scalar_model()), "double"), "no keyword, but got 'double'"),
        (
            lambda: c_filter(made("ekf", small(transition=decides))),
            "transition must .* but decides raised TypeError",
        ),
        (
            lambda: c_filter(made("ukf", small(observe=looked_up))),
            "observe must .* but looked_up raised TypeError",
        ),
    ],
)
def test_an_error_names_what_is_wrong(make, message):
    refused(message, make)


def test_comments_hold_any_unit():
    header = c_filter(made("ekf", small())).header
    assert header.isascii() and header.count("*/") == header.count("/*")


def test_a_filter_is_the_same_text_each_time():
    assert c_filter(made("ukf", thruster_model())) == c_filter(made("ukf", thruster_model()))


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("which", ["thruster", "no input"])
@pytest.mark.parametrize("name", ["ekf", "enkf"])
def test_a_project_filters_a_log_as_estimate_does(name, which, single, tmp_path):
    model = MODELS[which]()
    inputs, z = simulated(model, 40, level=1.0, missing=0.2)
    filter_ = made(name, model)
    program, files = log_program(filter_, tmp_path, *SANITIZERS, single=single)
    assert files == ["one.h", "one.c", "one.hpp", "main.c", "CMakeLists.txt", "README.md"]
    log = log_of(model, inputs[0], z[0])
    headers, *rows = (line.split(",") for line in filtered(program, log).splitlines())
    recorded = tmp_path / "log.csv"
    recorded.write_text(log)
    found = estimate_with(filter_, ReplayEnv(recorded, model).log)
    wanted = columns_of(found)
    assert set(headers) <= set(wanted) and len(rows) == 41
    for header, column in zip(headers, zip(*rows, strict=True), strict=True):
        numbers = [float(word) if word else math.nan for word in column]
        atol = (1e-4 if single else 1e-8) * np.nanmax(abs(wanted[header]))
        np.testing.assert_allclose(numbers, wanted[header], rtol=0, atol=atol, equal_nan=True)


def log_of(model, inputs, z):
    """A log as CSV; the second column is the true thrust, whose symbol a measured one could have."""
    names = ["time_s", "thrust_N", *["voltage_V"] * model.inputs]
    names += ["measured_thrust_N"] if model.inputs else ["z_1"]
    rows = [",".join(names)]
    for k, measured in enumerate(z):
        u = inputs[min(k, len(inputs) - 1)].tolist()
        words = [f"{one:.17g}" if one == one else "" for one in (0.01 * k, 7.0, *u, *measured)]
        rows.append(",".join(words))
    return "\r\n".join(rows) + "\r\n"


UZ = ["u", "z"]
UNIT = "must be one that this program converts, but got"
SECONDS = "times must be in seconds, or their column say its unit"
STEP = "times must be one step apart, to a twentieth of a step"
WAY = "; thruster log LOG --out NEW.csv writes what thruster estimate reads of it\n"


def test_a_log_that_is_none_is_refused_with_the_line(tmp_path):
    program, _ = log_program(made("ekf", thruster_model()), tmp_path)
    for words, log, told in [
        ([], "time_s,voltage_V\n", "a log must have a column measured_thrust_N, or its headers be given\n"),
        ([], "V_s,force\n", "a log must have a column measured_thrust_N, or its headers be given\n"),
        (UZ, "u,thrust\n", "a log must have a column z, or its headers be given\n"),
        (["u"], "u,z\n", "give no header, or 2, inputs first, and the log as standard input: < log.csv\n"),
        (UZ, "u,z\n,2\n1,3\n4,5\n", "line 2: an input must be known from the first row on, but got 'voltage_V'\n"),
        (UZ, "u,z\n1,2\n1,3.1 N\n4,5\n", "line 3: column z must hold numbers, but got '3.1 N'\n"),
        (UZ, 'u,z\n1,2\n"off",3\n4,5\n', "line 3: column u must hold numbers, but got 'off'\n"),
        (UZ, "u,z\n1,2\n1,--\n4,5\n", "line 3: column z must hold numbers, but got '--'\n"),
        (UZ, "u,z\n1,2\n1,inf\n4,5\n", "line 3: column z must hold numbers, but got 'inf'\n"),
        (UZ, "u,z\n1,2\n1,0x1p3\n4,5\n", "line 3: column z must hold numbers, but got '0x1p3'\n"),
        (UZ, "u,z\n1,2\n1,-1e400\n4,5\n", "line 3: column z must hold finite numbers, but got '-1e400'\n"),
        (UZ, "u,z\n1,2\n1\n4,5\n", "line 3: a row must have as many cells as the header, but got 'fewer'\n"),
        (UZ, "u,z\n1,2\n\n4,5\n4,6\n", "line 3 is empty: rows of a log without times must follow one another\n"),
        (UZ, "u,z,u\n1,2,1\n", "line 1: names of columns must differ from one another, but got 'u'\n"),
        (UZ, "u,z,t\n1,2,0\n1,3,.01\n4,5,.03\n", f"line 4: {STEP}, but got '.03'{WAY}"),
        (UZ, "u,z,t\n1,2,0\n1,3,.01\n4,5,.01\n", f"line 4: {STEP}, but got '.01'{WAY}"),
        (UZ, "u,z,t\n1,2,0\n1,3,-.01\n4,5,.01\n", f"line 3: {STEP}, but got '-.01'{WAY}"),
        (UZ, "u,z,timestamp\n1,2,0\n1,3,10000\n4,5,20000\n", f"line 3: {SECONDS}, but got '10000'{WAY}"),
        (UZ, "u,z,t\n1,2,1700000000000\n1,3,1\n", f"line 2: {SECONDS}, but got '1700000000000'{WAY}"),
        (UZ, "u,z,t\n1,2,46143\n1,3,46143.0000001\n", f"line 3: {SECONDS}, but got '46143.0000001'{WAY}"),
        (UZ, "u,z,t\n1,2,0\n1,3,\n4,5,.01\n", "line 3: every row must have a time, but got ''\n"),
        (["u_uA", "z"], "u_uA,z\n", f"line 1: the unit of column u_uA {UNIT} 'uA'{WAY}"),
        (["U_parsec", "z"], "U_parsec,z\n", f"line 1: the unit of column U_parsec {UNIT} 'parsec'{WAY}"),
        (["u", "z[kg]"], "u,z\n", f"line 1: the unit of column z {UNIT} 'kg'{WAY}"),
        (UZ, "u,z\n1,2\n2,2\n3,2\n", "a measurement must vary, but column z does not\n"),
        (UZ, "u,z\n1,2\n2,3\n", "a log must have at least 3 rows, but got 2\n"),
        ([], "", "a log must have a line of headers\n"),
    ]:
        result = subprocess.run([program, *words], input=log, capture_output=True, text=True)
        assert (result.returncode, result.stderr) == (2, told)


@pytest.mark.parametrize(
    ("words", "log"),
    [
        ([], "voltage_mV,measured thrust [kN],t\n1000,.002,0\n3000,0.003,1\n2000,.005,2\n"),
        ([], "V_s;thrust\n1;2\n3;3\n2;5\n\n"),
        ([], '\ufeffvoltage_V,thrust_N,"time [min]"\r\n1,"2",0\r\n 3 ,3,1\r\n2,+.5e1,2\r\n\r\n'),
        (["U_mV", "F_N"], "U_mV,F_N\n1000,2\n3000,3\n2000,5\n"),
        (["U[kV]", "F[mN]"], "#U\tF\n1e-3\t2000\n3e-3\t3000\n.002\t5000\n,,\n".replace(",,", "\t")),
        (["U_uV", "F"], "U_uV,F,x\n1e6,2,text\n3e6,3,\n2e6,5,-\n"),
    ],
)
def test_a_log_is_read_in_any_unit_as_estimate_reads_it(words, log, tmp_path):
    model = thruster_model()
    program, _ = log_program(made("ekf", model), tmp_path)
    plain = "voltage_V,measured_thrust_N\n1,2\n3,3\n2,5\n"
    of_units, same = filtered(program, log, *words), filtered(program, plain)
    for one, other in zip(of_units.splitlines()[1:], same.splitlines()[1:], strict=True):
        np.testing.assert_allclose(np.array(one.split(",")[1:], float), np.array(other.split(",")[1:], float))
    (tmp_path / "log.csv").write_text(log)
    columns, header = dict(zip(("V_s", "thrust"), words, strict=False)), log.split("\n")[0]
    has_times = "time" in header or header.endswith(",t")
    log = read_log(tmp_path / "log.csv", model, columns, dt=None if has_times else 1.0)
    each_close((log.inputs[:, 0], log.measurements[:, 0]), ([1.0, 3.0], [2.0, 3.0, 5.0]))


def test_rows_that_a_log_lacks_are_predicted_as_estimate_does(tmp_path):
    model = thruster_model()
    inputs, z = simulated(model, 60, level=1.0)
    lines = log_of(model, inputs[0], z[0]).splitlines()
    lines = [line for k, line in enumerate(lines) if k not in (4, 9, 10, *range(20, 41))]
    filter_ = made("ekf", model)
    program, _ = log_program(filter_, tmp_path, *SANITIZERS, dt=0.01)
    headers, *rows = (line.split(",") for line in filtered(program, "\n".join(lines)).splitlines())
    (tmp_path / "log.csv").write_text("\n".join(lines))
    wanted = columns_of(estimate_with(filter_, ReplayEnv(tmp_path / "log.csv", model).log))
    assert len(rows) == 61 == len(wanted["time_s"])
    for header, column in zip(headers, zip(*rows, strict=True), strict=True):
        numbers = [float(word) if word else math.nan for word in column]
        np.testing.assert_allclose(numbers, wanted[header], rtol=1e-8, atol=1e-9)
    for some in (lines[:1] + lines[1::2], [lines[0], *lines[1:4], lines[2]]):  # of another dt; back in time
        ended = subprocess.run([program], input="\n".join(some), capture_output=True, text=True)
        assert ended.returncode == 2
        assert re.match(r"line \d+: times must be steps of 0.01 s, .*" + re.escape(WAY), ended.stderr)


def test_spaces_part_cells_and_a_mark_of_order_may_stand_twice(tmp_path):
    program, _ = log_program(made("ekf", thruster_model()), tmp_path)
    plain = "t,voltage_V,measured_thrust_N\n0,1,2\n1,3,nan\n2,2,5\n3,2,4\n"
    log = "\ufeff\ufeff#t voltage_V   measured_thrust_N \n 0 1 2\n\n1\t3 nan \n2 2 5\n3 2 4"
    assert filtered(program, plain) == filtered(program, log)
    (tmp_path / "log.csv").write_text(log, encoding="utf-8")
    assert read_log(tmp_path / "log.csv", thruster_model()).inputs[:, 0].tolist() == [1.0, 3.0, 2.0]
