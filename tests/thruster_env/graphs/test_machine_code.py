"""Loops around programs as machine code: the same numbers as Python, without numba."""

import gc
import math
import os
import subprocess
import sys

import numpy as np
import pytest
from llvmlite import ir

from thruster_env.core.sources import vector_reader, vector_writer
from thruster_env.graphs import machine_code
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.loops import Loops, Untranslated, add_function, machine_code_of, refusal_of, unknown
from thruster_env.graphs.machine_code import NotLinked, add_builtin, builtin_of, code_of, function_of
from thruster_env.graphs.programs import OF_STEPS, Place, callable_of, program_of


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder of machine code for each test."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path / machine_code.FOLDER


def machine(function, *shapes):
    module = ir.Module()
    add_function(module, "run", function, shapes)
    return function_of(code_of(module, "run"))


def squares_program(width=1):
    """rows[0] = rows[0]^2 - given[0] numbers[1]."""
    graph = Graph(100)
    x, u, c = (graph.given(Place(array, at)) for array, at in (("rows", 0), ("given", 0), ("numbers", 1)))
    return callable_of(program_of([(Place("rows", 0), x * x - u * c)], {}), width, OF_STEPS)


def weighted(x, y, count):
    total, least, double = 0.0, 0.0, 2 * count
    for i in range(x.shape[0]):
        for j in range(0, x.shape[1], 2):
            value = x[i, j]
            total += abs(value) * y[j] if value < 0.0 else value
            least = value if value < least else least
        x[i, 1] -= float_of(i // 2 % 3)
    for k in range(count - 1, 0, -1):
        y[k] = -y[k - 1]
    y[0] = total / double
    y[1] = least
    if not total < 3.0 or count == 2 and least != 0.0:
        y[2] = 7.0
    else:
        y[2] = int(total)
    return min(count, 4)


def float_of(whole):
    return 0.5 * whole


def test_loops_are_those_of_python():
    rng = np.random.default_rng(0)
    for count in (2, 3, 5):
        x, y = rng.normal(size=(4, 5)), rng.normal(size=5)
        expected = x.copy(), y.copy()
        result = weighted(*expected, count)
        assert machine(weighted, (None, 5), (None,), None)(x, y, count) == result
        np.testing.assert_allclose(x, expected[0], rtol=1e-15)
        np.testing.assert_allclose(y, expected[1], rtol=1e-14)


def test_tuples_parts_of_arrays_and_early_returns():
    read, store = vector_reader(2, 1), vector_writer(2)

    def first_negative(pair, values):
        row, _ = pair
        store(row[0], read(values[1:]))
        for i in range(values.shape[0]):
            if values[i] < 0.0:
                return i
        return -1

    run, row, values = machine(first_negative, [(1, 2), (None,)], (None,)), np.zeros((1, 2)), np.arange(4.0)
    assert run((row, row[0]), values) == -1 and row.tolist() == [[2.0, 3.0]]
    values[2] = -5.0
    assert run((row, row[0]), values) == 2 and row.tolist() == [[-5.0, 3.0]]


@pytest.mark.parametrize("width", [1, 8])
def test_programs_are_called_side_by_side(width):
    program = squares_program(width)

    def twice(rows, given, numbers):
        for g in range(rows.shape[0]):
            program(rows[g], given[g], numbers)

    rng = np.random.default_rng(1)
    rows, given, numbers = rng.normal(size=(3, width)), rng.normal(size=(3, width)), rng.normal(size=2)
    expected = rows**2 - given * numbers[1]
    machine(twice, (None, width), (None, width), (None,))(rows, given, numbers)
    np.testing.assert_allclose(rows, expected, rtol=1e-14)


def looked_up(x):
    x[0] = sum(value for value in x)


def printed(x):
    print(x)


def named(x):
    return float_of(whole=x.shape[0])


def at_times(x):
    if x[0] > 0.0:
        y = 2.0 * x[1]
    x[2] = y


def test_a_value_that_may_not_have_been_computed_is_a_fault():
    with pytest.raises(RuntimeError, match="does not dominate"):
        machine_code_of(at_times, [(None,)])


def after_its_loop(x):
    for k in range(3):
        x[0] += k
    x[1] = k


def after_a_break(x):
    for value in (x[1], x[2], x[0]):
        if value > 2.5:
            break
    x[0] = value


def of_the_turn_before(x):
    for k in range(4):
        if k > 0:
            x[0] += NOTHING_YET  # noqa: F823
        NOTHING_YET = x[1] + k  # noqa: F841, N806


def by_default(x):
    half(x)


def half(x, share=0.5):
    x[0] *= share


def made_in_a_loop(x):
    last = np.zeros(2)
    for _ in range(4):
        following = np.zeros(2)
        following[0] = last[0] + 1.0
        last = following
    x[0] = last[0]


def divided_by_nothing(x):
    x[0] = 1.0 / NOTHING


NOTHING = 0.0
NOTHING_YET = 1.0  # not the local of this name


def second_column(x):
    squares(x.reshape((4, 2))[:, 1], x, x)


squares = squares_program()


def of_indices_and_conditions(x, n):
    part, rest = x[-4:-1], x[n:]
    x[0] = n or 5
    x[1] = (x[2] > 1.0 and x[3]) or n
    x[-1] += part[-1] + x[6:100].shape[0] + rest.shape[0]
    for k in range(0, 8, n + 1):
        x[2] = 10.0 * x[2] + k
    for k in range(7, 0, -n - 1):
        x[3] = 10.0 * x[3] + k
    x[4] = x[n + 8] if n < 0 and x[n] > 0.0 else -1.0
    x[5] = 2.0 if n > 2 and x[n - 3] > 0.0 and x[n - 3] < 1.5 else 3.0


def test_indices_from_the_end_values_of_conditions_and_steps_are_those_of_python():
    run = machine(of_indices_and_conditions, (8,), None)
    for n in range(5):
        x = np.arange(1.0, 9.0)
        expected = x.copy()
        of_indices_and_conditions(expected, n)
        run(x, n)
        assert x.tolist() == expected.tolist()


def columns_doubled(x, first, most):
    k = 0
    while k < most and x[0, first] < 100.0:
        columns = x[1:, first : first + 2]
        for i in range(columns.shape[0]):
            for j in range(columns.shape[1]):
                columns[i, j] *= 2.0
        x[0, first] += 30.0
        k += 1
    return k


def test_parts_of_rows_and_loops_of_unknown_length():
    for most in (0, 2, 9):
        x = np.arange(15.0).reshape(3, 5)
        expected = x.copy()
        result = columns_doubled(expected, 2, most)
        assert machine(columns_doubled, (None, None), None, None)(x, 2, most) == result
        assert np.array_equal(x, expected)


def divided(a, b):
    return 1000 * (a // b) + a % b


@pytest.mark.parametrize("b", [3, -3, 1, 8])
def test_whole_numbers_are_divided_as_in_python(b):
    run = machine(divided, None, None)
    for a in range(-17, 18):
        assert run(a, b) == divided(a, b)


def test_what_cannot_be_linked_runs_as_python_and_says_so(monkeypatch):
    def refuse(module, *names, **options):
        raise NotLinked("Symbols not found: [ cos ]")

    assert machine_code_of(count_up, [(None,), None]) is not None
    monkeypatch.setattr("thruster_env.graphs.loops.code_of", refuse)
    with pytest.warns(UserWarning, match="could not be made: Symbols not found"):
        assert machine_code_of(count_up, [(None,), None]) is None


def count_up(x, by):
    x[0] += by
    return x.shape[0] + by


def builtin(x):
    module = ir.Module()
    function, count = add_function(module, "run", count_up, [(None,), None])
    add_builtin(module, "call", function, count - 1)
    return builtin_of(code_of(module, "call"), x)


def test_a_builtin_works_on_its_arrays_and_keeps_its_code(only_new_garbage):
    x = np.zeros(3)
    call = builtin(x)
    gc.collect()
    assert call(2) == 5 and call(-1) == 2 and x[0] == 1.0


@pytest.mark.parametrize("x", [np.zeros(3, dtype=int), np.zeros((3, 2))[:, 0], np.zeros(3, dtype=np.float32)])
def test_other_arrays_are_refused(x):
    with pytest.raises(TypeError, match="arrays must be of float64 in C order, but got"):
        builtin(x)


@pytest.mark.parametrize("number", [1.5, 2.0, np.float64(2.0), None, "2"])
def test_other_numbers_are_refused(number):
    with pytest.raises(TypeError, match="a number must be a whole one, but got"):
        machine(divided, None, None)(number, 3)
    assert machine(divided, None, None)(np.int32(7), 3) == 2001


def test_code_is_freed_with_its_last_user(only_new_garbage):
    machine_code._loaded.clear()
    call = builtin(np.zeros(3))
    assert len(machine_code._loaded) == 1
    del call
    gc.collect()
    assert not machine_code._loaded


def test_object_code_is_kept_and_damage_is_noticed(folder, monkeypatch):
    machine_code._loaded.clear()
    assert builtin(np.zeros(2))(1) == 3
    (file,) = folder.iterdir()
    content = file.read_bytes()
    for damaged in (content[:-1], b"", content[:40] + b"x" + content[41:]):
        machine_code._loaded.clear()
        file.write_bytes(damaged)
        assert builtin(np.zeros(2))(1) == 3 and file.read_bytes() == content
    machine_code._loaded.clear()
    monkeypatch.setattr(machine_code, "_compiled", None)
    assert builtin(np.zeros(2))(1) == 3


def test_a_folder_that_others_can_write_is_not_used(folder, tmp_path, monkeypatch):
    private = tmp_path / "private"
    monkeypatch.setattr(machine_code, "private_folder", lambda: str(private))
    machine_code._folder.cache_clear()
    assert machine_code._folder(str(tmp_path)) == folder and folder.stat().st_mode & 0o777 == 0o700
    for spoil in (lambda: folder.chmod(0o770), link_to_itself(folder, tmp_path)):
        machine_code._folder.cache_clear()
        spoil()
        assert machine_code._folder(str(tmp_path)) == private / machine_code.FOLDER
    private.chmod(0o700)
    (private / machine_code.FOLDER).chmod(0o777)
    machine_code._folder.cache_clear()
    assert machine_code._folder(str(tmp_path)) is None


def link_to_itself(folder, tmp_path):
    def spoil():
        folder.rename(tmp_path / "elsewhere")
        (tmp_path / "elsewhere").chmod(0o700)
        folder.symlink_to(tmp_path / "elsewhere")

    return spoil


def test_without_a_home_object_code_goes_to_the_private_folder(tmp_path, monkeypatch):
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as it is where neither HOME nor a user is known
    monkeypatch.setattr(machine_code, "private_folder", lambda: str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    machine_code._folder.cache_clear()
    assert machine_code._folder("") == tmp_path / machine_code.FOLDER
    machine_code._folder.cache_clear()


FORK = """
import os, threading, time
from thruster_env.graphs import machine_code
taken = threading.Event()
def compile_for_long():
    with machine_code._compiling:
        taken.set()
        time.sleep(0.2)
threading.Thread(target=compile_for_long).start()
taken.wait()
child = os.fork()
if child == 0:
    os._exit(0 if machine_code._compiling.acquire(timeout=5) else 1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), machine_code._compiling.acquire(timeout=5))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no forks")
def test_a_fork_while_another_thread_compiles_can_compile():
    result = subprocess.run([sys.executable, "-c", FORK], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["0", "True"]


FIRST_USE = """
import sys
import numpy as np
from filters import affine_model, make_filter, run
model = affine_model(a=0.9 * np.eye(2), b=np.ones((2, 1)), c=np.eye(1, 2), process_noise_cov=[0.1, 0.1],
                     measurement_noise_cov=[0.5], prior_mean=[0.0, 0.0], prior_cov=[1.0, 1.0])
filter_ = make_filter("ekf", model)
run(filter_, inputs=np.zeros((9, 3, 1)), measurements=np.ones((9, 4, 1)))
filter_.update(filter_.predict(filter_.init(), [0.0]), [1.0])
from filters.engine.batch import Beliefs
ensembles = Beliefs(make_filter("enkf", model, ensemble_size=9), 2)
ensembles.start(np.arange(2), np.zeros((2, 2)), np.ones((2, 1)))
print([name for name in ("numba", "scipy", "gymnasium") if name in sys.modules])
import gymnasium as gym
import thruster_env
env = gym.make_vec("BowThruster-EKF-v0", num_envs=300)
env.reset(seed=0)
env.step(env.action_space.sample())
print([name for name in ("numba", "scipy") if name in sys.modules])
"""


def test_filters_and_envs_need_no_numba():
    result = subprocess.run([sys.executable, "-c", FIRST_USE], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["[]", "[]"]


# Memory above six gigabytes is full but for a page: a module's parts cannot lie together there.
CROWDED = """
import ctypes, os
import numpy as np
from thruster_env.graphs.loops import machine_code_of
from thruster_env.graphs.machine_code import function_of

libc = ctypes.CDLL(None)
libc.mmap.restype, libc.mmap.argtypes = ctypes.c_size_t, [ctypes.c_size_t] * 6
libc.munmap.argtypes = [ctypes.c_size_t] * 2

def taken(size):
    return libc.mmap(0, size, 0, 0x4022, 2**64 - 1, 0)  # private, of no file, no access, unreserved

def scale(x):
    for i in range(x.shape[0]):
        x[i] = x[i] * 1.25 + 6.75

def shift(x):
    for i in range(x.shape[0]):
        x[i] = x[i] + 0.3

x = np.arange(5.0)
function_of(machine_code_of(scale, ((None,),)))(x)  # LLVM has its own memory now
large, page = taken(6 << 30), 0
for size in (1 << 24, 1 << 20, 1 << 16, 1 << 12):
    while (above := taken(size)) > large:
        page = above
    libc.munmap(above, size)
libc.munmap(page, 1 << 12)
function_of(machine_code_of(shift, ((None,),)))(x)
print(x.tolist() == [7.05, 8.3, 9.55, 10.8, 12.05], page > large, flush=True)
os._exit(0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="takes memory as Linux gives it")
def test_code_can_be_loaded_where_memory_is_crowded(tmp_path):
    file, environment = tmp_path / "crowded.py", {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    file.write_text(CROWDED)  # `machine_code_of` reads it
    result = subprocess.run([sys.executable, file], capture_output=True, text=True, env=environment)
    assert result.stdout == "True True\n", result.stderr


def doubled(x):
    out = np.empty(x.shape[0])
    for i in range(x.shape[0]):
        out[i] = 2.0 * x[i]
    return out


def four(x):
    return doubled(x[:4])


def sorted_pair(x, y):
    if x[0] > y[0]:
        return y, x, np.zeros((2, 2))
    return x, y, np.ones((2, 2))


def of_arrays(x, n):
    half, many = four(x), doubled(x[:n])
    for _ in range(n):
        half = doubled(half) + 1.0
        half[1] -= 0.5
    low, high, square = sorted_pair(four(x)[:2], x[1:3])
    x[0] += half[1]
    x[4:8] = x[3:7]
    x[:2], x[3] = np.array([x[1], x[0]]), many[n - 1]
    square *= np.sin(high[0]) / low[1]
    x[2] = square.T.copy()[0, 1] + square.reshape((4,))[3] + len(half) - many.size


def test_arrays_are_results_and_change_by_entries():
    run = machine(of_arrays, (8,), None)
    for n in (1, 2, 5):
        x = np.linspace(-1.0, 2.0, 8)
        expected = x.copy()
        of_arrays(expected, n)
        run(x, n)
        np.testing.assert_allclose(x, expected, rtol=1e-14)


def turned(x):
    values, vectors = np.linalg.eigh(x)
    x[:] = vectors
    x[0, 0] += 100.0 * values[1]


def test_eigenvectors_are_numpys():
    root = np.random.default_rng(3).normal(size=(4, 4))
    x = root @ root.T + np.triu(root, 1)  # of which the lower triangle counts
    expected = x.copy()
    turned(expected)
    Loops(turned, [(None, None)])(x)
    np.testing.assert_allclose(abs(x), abs(expected), rtol=1e-12)


def of_two_names(x):
    other = doubled(x)
    for _ in range(2):
        before = other  # noqa: F841
        other = doubled(other)
    x[:] = other


def changed_for_its_caller(x):
    x[0] = 1.0
    x = doubled(x)
    return x[0]


def of_truths(x):
    x[:] = (x > 0.0) + (x > 1.0)


def of_another_shape(x):
    x[:] = x[:3] + x[3:5]


REFUSED = [
    *(looked_up, printed, named, after_its_loop, after_a_break, of_the_turn_before, by_default, made_in_a_loop),
    *(divided_by_nothing, second_column, of_two_names, changed_for_its_caller, of_truths, of_another_shape),
]


@pytest.mark.parametrize("function", REFUSED)
def test_what_would_be_other_numbers_than_pythons_is_refused(function):
    with pytest.raises(Untranslated):
        add_function(ir.Module(), "run", function, [(8,)])


TABLE, WHOLE = (0.0, 1.0, 4.0, 9.0), (0, 1, 2)


def cut_off(x, n):
    x[0] = len(x[:n]) + 10 * len(x[n:6]) + 100 * len(x[-n:])
    x[n:10], rest = 7.0, x[3 : n + 5]
    rest[:] = 5.0
    x[:2], x[2:4] = x[2:4], x[:2]
    x[1] = TABLE[-1 - n % 4] + WHOLE[-(n % 3)] + max((x[1], 2.0, n)) + min([x[2], 3.0])
    x[4] = x.reshape((2, -1))[1, 0] + x.reshape(-1, 2)[3, 1]


def test_slices_are_cut_off_and_tuples_counted_from_their_ends():
    run = machine(cut_off, (8,), None)
    for n in range(13):
        x = np.linspace(-1.0, 2.0, 8)
        expected = x.copy()
        cut_off(expected, n)
        run(x, n)
        assert x.tolist() == expected.tolist()


def at_an_index(x, n):
    row = x.reshape(2, 4)
    x[0], x[1], x[2] = x[n], TABLE[n], row[n % 2, n]
    x[3] = TABLE[WHOLE[n]]
    x[n + 4] = 3.0


def test_what_lies_at_no_index_is_nan():
    run = machine(at_an_index, (8,), None)
    for n, are_known in ((2, [True] * 4), (3, [True, True, True, False]), (8, [False] * 4), (2**62, [False] * 4)):
        x = np.arange(8.0)
        run(x, n)
        assert np.isfinite(x).tolist() == [*are_known, *[True] * 4]


def largest_of_array(x):
    x[0] = max(x)


def in_another_shape(x):
    x[0] = x.reshape(3, 3)[0, 0]


def length_of_three(x):
    x[0] = math.hypot(x[0], x[1], x[2])


def of_another_base(x):
    x[0] = math.log(x[0], 2.0)


def of_itself(x):
    x[0] = factorial(x[0])


def factorial(n):
    return 1.0 if n < 1.0 else n * factorial(n - 1.0)


def with_a_new_axis(x):
    x[:] = x[:, None][:, 0]


@pytest.mark.parametrize(
    "function",
    [at_times, largest_of_array, in_another_shape, length_of_three, of_another_base, of_itself, with_a_new_axis],
)
def test_a_users_function_is_refused_whatever_its_translation_raises(function):
    assert refusal_of(function, [unknown(8, as_array=True)])


def of_two_lengths(x, n):
    x[5:8] = x[:n] + np.ones(3)
    x[:2] = x[1:n]


def test_arrays_of_lengths_that_do_not_fit_are_nan():
    run = machine(of_two_lengths, (8,), None)
    for n in (0, 1, 2, 3, 8):
        x = np.arange(8.0)
        run(x, n)
        assert np.isnan(x[5:]).all() == (n not in (1, 3))
        if n == 3:
            assert x.tolist() == [1.0, 2.0, 2.0, 3.0, 4.0, 1.0, 2.0, 3.0]
        else:
            assert x[:2].tolist() == [1.0, 1.0] if n == 2 else np.isnan(x[:2]).all()
