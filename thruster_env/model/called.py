"""A model's functions as others call them: machine code of their graphs where they can be traced, else numba's.

    def f(x, u, c):                                               def f(x, u, c):
        pull = [k.force(y) for k, y in zip(SPRINGS, x)]    is         evaluate a program
        return tuple(x[i] + c.dt * ...)                               return its results

So loops over known numbers, comprehensions, arrays, dataclasses and dictionaries are machine code wherever a model
is used. numba compiles the package's own functions, plain loops over large arrays, and what cannot be traced, such
as a loop until a value is small, if it can; else the model runs as Python, and one warning names the function, the
line, the reason and what to write in its place.
"""

from __future__ import annotations

import dis
import hashlib
import inspect
import traceback
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.core.compiled import Instead, compiled_in_place_of, fastmath_of, inlined, overloaded
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.modules import error_line
from thruster_env.core.results import array_valued
from thruster_env.core.sources import is_array, written_out
from thruster_env.core.user_functions import codes_in, functions_in, is_copy, is_plain, needs_python, stand_in
from thruster_env.graphs.graphs import TooLarge
from thruster_env.graphs.programs import OF_STEPS, Program, callable_of
from thruster_env.graphs.python_floats import in_python
from thruster_env.model.shape import constants_are_array
from thruster_env.model.traced import traced_function

MOST = 3000  # operations of a program: numba compiles loops of more in less time
ODD = {  # instructions of what numba refuses, or makes no array of
    *"IMPORT_NAME FORMAT_VALUE FORMAT_SIMPLE BUILD_MAP BUILD_CONST_KEY_MAP".split(),
    *"BUILD_LIST LIST_APPEND LIST_EXTEND".split(),
}
MOST_INLINED = 300  # operations of a program of which each caller has a copy


@makes_functions
def called_function(
    function: Callable, arguments: str, sizes: tuple[int, ...], form: type | int, shape: tuple[int, ...]
) -> Callable:
    """Return a function of a model that calls it with Python's floats; compiled functions call its machine code.

    Args:
        function: of x, perhaps u, and constants c, or its Jacobian.
        arguments: their names, "x, u, c" or, of h without input, "x, c".
        sizes: number of components of each argument.
        form: of the constants, their NamedTuple class, or how many there are in a tuple.
        shape: of the result, which is an array if it is large: (count,), or (rows, columns) of a tuple of rows.
    """
    inlined(function)

    def called(*arguments):
        result = in_python(function, arguments)
        return np.array(result, dtype=np.float64) if is_array(*shape) else result

    called.__name__, called.__module__ = (getattr(function, name, "") for name in ("__name__", "__module__"))
    stand_in(called, function)
    return compiled_in_place_of(called, lambda: _machine_code(function, arguments, sizes, form, shape))


def _machine_code(function: Callable, arguments: str, sizes: Sequence[int], form, shape: Sequence[int]) -> Instead:
    """Machine code of a function's graph, else the function for numba, if that takes it."""
    parts, for_numba = [*functions_in(function)], array_valued(function, arguments, *shape)
    large = is_array(max(sizes[:-1])) or is_array(*shape)
    if not parts or large and _is_translated(for_numba, sizes, form):
        return Instead(for_numba, "", frozenset(fastmath_of(function)))
    if large and all(map(_has_plain_loops, parts)):
        return Instead(for_numba, "", frozenset(fastmath_of(function)))
    try:
        program = traced_function(function, sizes, form, shape).program()
        if len(program.works) > MOST:
            raise TooLarge(f"has {len(program.works)} operations, of which {MOST} compile in seconds")
        key = hashlib.sha256("\n".join(program.text).encode()).hexdigest()
        return Instead(_evaluation(program, arguments, sizes, shape), key)
    except Exception as error:  # whatever a user's function raises if it gets Numbers
        reason = why_not_traced(function, error)
    if not isinstance(function, types.FunctionType) and not hasattr(function, "py_func"):
        return Instead(None, reason=f"{reason}; numba takes no {type(function).__name__}")
    return Instead(None if needs_python(function) else for_numba, "", frozenset(fastmath_of(function)), reason)


def _is_translated(function: Callable, sizes: Sequence[int], form: type | int) -> bool:
    """Whether `graphs.loops` can translate a function of vectors and constants: loops are shorter than a graph."""
    from thruster_env.graphs.loops import refusal_of, unknown

    *before, count = sizes
    vectors = [unknown(size, as_array=is_array(size)) for size in before]
    constants = unknown(count, as_array=constants_are_array(form))
    return not refusal_of(function, [*vectors, constants if isinstance(form, int) else form(*constants)])


def _has_plain_loops(function: types.FunctionType) -> bool:
    """Whether numba takes a function, by its code: loops over large arrays are shorter than their graph."""
    codes = [*codes_in(function.__code__)]
    later = any(code.co_flags & inspect.CO_GENERATOR for code in codes)
    odd = any(not ODD.isdisjoint(part.opname for part in dis.get_instructions(code)) for code in codes)
    cells = (cell.cell_contents for cell in function.__closure__ or ())
    names = (function.__globals__.get(name) for name in function.__code__.co_names)
    kinds = types.ModuleType, types.FunctionType, types.BuiltinFunctionType, np.ufunc, type
    return not (later or odd) and all(is_plain(value) or isinstance(value, kinds) for value in (*cells, *names))


def _evaluation(program: Program, arguments: str, sizes: Sequence[int], shape: Sequence[int]) -> Callable:
    """The function of tuples or arrays that evaluates a program."""
    work, count = callable_of(program, 1, OF_STEPS), int(np.prod(shape))

    def evaluate(vectors, out=None):
        numbers = np.concatenate([np.asarray(vector, dtype=np.float64) for vector in vectors])
        results = np.empty(count)
        work(results, numbers, numbers)
        if out is None:
            return tuple(results) if len(shape) == 1 else tuple(map(tuple, results.reshape(shape)))
        out[...] = results.reshape(shape)

    evaluate.evaluation = work, shape, sizes  # type: ignore[attr-defined]  # of which `loops` makes a call
    overloaded(evaluate, lambda evaluate: _teach(evaluate, work, program, sizes, shape))
    large = is_array(*shape)
    lines = [f"out = np.empty({shape})", f"evaluate(({arguments}, ), out)"] if large else []
    result = "out" if large else f"evaluate(({arguments}, ))"
    loops = large or len(program.works) > MOST_INLINED
    return written_out("of_graph", arguments, *lines, result, _loops=loops, evaluate=evaluate, np=np)


def _teach(
    evaluate: Callable, work: Callable, program: Program, sizes: Sequence[int], shape: Sequence[int]
) -> None:
    """Have numba put a program in the place of a call of `evaluate`, with its arguments on the stack.

    It takes a tuple of vectors, and returns a tuple of this shape, or writes to an array.
    """
    from numba.core import cgutils, types
    from numba.extending import lower_builtin, type_callable
    from numba.np.arrayobj import populate_array

    number, count = types.float64, int(np.prod(shape))
    result: Any = number
    for length in reversed(shape):
        result = types.UniTuple(result, length)
    vector_at = [(i, j) for i, size in enumerate(sizes) for j in range(size)]

    @type_callable(evaluate)
    def of_vectors(context):
        return lambda vectors, out=None: result if out is None else types.none

    def component(context, builder, vectors, of_vectors: Any, k: int):
        """A number of the arguments as float64."""
        i, j = vector_at[k]
        vector, of_vector = builder.extract_value(vectors, i), of_vectors.types[i]
        if kinds := getattr(of_vector, "types", ()):  # of a tuple
            return context.cast(builder, builder.extract_value(vector, j), kinds[j], number)
        array, at = context.make_array(of_vector)(context, builder, vector), context.get_constant(types.intp, j)
        pointer = cgutils.get_item_pointer(context, builder, of_vector, array, [at])
        return context.cast(
            builder, context.unpack_value(builder, of_vector.dtype, pointer), of_vector.dtype, number
        )

    def on_stack(context, builder, length: int):
        size, double = context.get_constant(types.intp, length), context.get_data_type(number)
        data = cgutils.alloca_once(builder, double, size)
        return data, lambda k: builder.gep(data, [context.get_constant(types.intp, k)], source_etype=double)

    def run(context, builder, vectors, of_vectors: Any, out) -> None:
        components, at = on_stack(context, builder, len(vector_at))
        for source, _ in program.reads:
            builder.store(component(context, builder, vectors, of_vectors, source.at), at(source.at))
        arrays, kind = [], types.Array(number, 1, "C")
        for data, length in ((out, count), *2 * [(components, len(vector_at))]):
            array = context.make_array(kind)(context, builder)
            size, stride = (context.get_constant(types.intp, of) for of in (length, 8))
            populate_array(array, data, (size,), (stride,), stride, None)
            arrays.append(array._getvalue())
        called = context.typing_context.resolve_value_type(work)
        signature = called.get_call_type(context.typing_context, (kind,) * 3, {})
        context.get_function(called, signature)(builder, arrays)

    @lower_builtin(evaluate, types.BaseTuple)
    def as_tuple(context, builder, signature, arguments):
        out, at = on_stack(context, builder, count)
        run(context, builder, arguments[0], signature.args[0], out)
        numbers = [builder.load(at(k), typ=context.get_data_type(number)) for k in range(count)]
        if len(shape) == 2:
            rows = (numbers[k : k + shape[1]] for k in range(0, count, shape[1]))
            numbers = [context.make_tuple(builder, result.dtype, row) for row in rows]
        return context.make_tuple(builder, result, numbers)

    @lower_builtin(evaluate, types.BaseTuple, types.Array)
    def to_array(context, builder, signature, arguments):
        out = context.make_array(signature.args[1])(context, builder, arguments[1])
        run(context, builder, arguments[0], signature.args[0], out.data)
        return context.get_dummy_value()


# Why a function is not traced, for those whom that costs time.

TABLES = "look values up by np.interp, of at most a hundred points, or choose by if"
REMEDIES = {  # words of a reason, and what to write instead
    "decide": "loop a fixed number of times, and choose by min, max or np.where",
    "outcomes": "choose by min, max or np.where in place of so many ifs",
    "catches": "ask before, by an if, in place of try",
    "is` True": "compare by == in place of `is`",
    "operations": "use fewer substeps, or loops that numba takes",
    "hash": TABLES,
    "integer": TABLES,
    "int()": TABLES,
    "indices": TABLES,
}
OTHERWISE = "use arithmetic and functions of math and numpy that docs/machine_code.md names"


def why_not_traced(function: Callable, error: Exception) -> str:
    """The name of a function, its file and line, why it cannot be traced, and what to write in its place."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__) if is_copy(frame)]
    lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if is_copy(frame)]
    code = frames[-1].f_code if frames else getattr(function, "__code__", None)
    where = getattr(function, "__name__", type(function).__name__) if code is None else code.co_name
    if code is not None:
        where += f" ({Path(code.co_filename).name}, line {lines[-1] if lines else code.co_firstlineno})"
    text = str(error).split("\n")[0] if isinstance(error, TypeError) else error_line(error)
    remedy = next((remedy for words, remedy in REMEDIES.items() if words in text), OTHERWISE)
    return f"{where} cannot be traced, because {text}: {remedy}"
