"""The loops around programs as instructions of LLVM: a small part of Python, read from a function's source.

    for k in range(steps):                      for, while, if, break, continue, conditional expressions
        for g in range(groups):                 whole numbers, floats, tuples, arrays of floats and their parts
            update(rows[g], zs[g], numbers)     calls of programs, functions of numbers, and such functions
        if not total < LARGEST:
            restart((belief, None, None), numbers, 0)

What a function has in its closure is known when it is translated, so sizes are constants. A function that it
calls is translated once for all calls that differ in numbers alone. Whatever else it contains raises
`Untranslated`. The same function runs as Python. An index that is not known must lie within the array and counts
from its beginning; only a user's function may have others, which count from the end, or read NaN as Python raises.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
import threading
import types
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]

from thruster_env.core.compiled import FASTMATH, IN_PYTHON, OURS, is_interpreting
from thruster_env.core.modules import error_line
from thruster_env.core.streams import fill_in_loop
from thruster_env.graphs.arithmetic import OnlyPython, Untranslated, is_known
from thruster_env.graphs.arrays import LAPACK, POINTER, Memory, of_lapack
from thruster_env.graphs.expressions import FILL_NORMALS, ByAddress, Expressions, Functions
from thruster_env.graphs.forms import Array, changing_form, common_form, is_tuple
from thruster_env.graphs.graphs import uncollected
from thruster_env.graphs.instructions import DOUBLE, LONG
from thruster_env.graphs.machine_code import (
    WIDE,
    Code,
    NotLinked,
    add_builtin,
    check,
    code_folder,
    code_of,
    function_of,
)

ADDRESS = object()  # the shape of an argument that is called by its address


class Entry(NamedTuple):
    """A function that Python calls, a builtin "call" or "run" of words, or one that is called by its address.

    The address is that of its `name`.
    """

    function: Callable
    shapes: Sequence
    as_builtin: bool = False
    name: str = ""


def machine_code_of(
    function: Callable, shapes: Sequence, *, as_builtin: bool = False, unrolled: bool = True
) -> Code | None:
    """Machine code of a function, or None if there is none; see `add_function` and `common_code_of`.

    Called from Python as a builtin function it has the last argument of the function, of an array the address; the
    words have the others.
    Its loops are `unrolled` or not, see `machine_code.code_of`.
    """
    return common_code_of(Entry(function, shapes, as_builtin), unrolled=unrolled)


@uncollected()
def common_code_of(*entries: Entry, unrolled: bool = True) -> Code | None:
    """Machine code of functions that share those they call; at most one of them is builtin, and one "run".

    If there is none, it returns None after a warning: a user's function can neither be traced, translated, nor
    compiled by numba; or this system's libraries lack a function; or the package has a fault.
    """
    module, names, functions = ir.Module(), list[str](), Functions()
    try:
        for entry in entries:
            name = entry.name or ("operate" if entry.as_builtin else "run")
            by_words = not entry.name
            target, count = add_function(module, name, entry.function, entry.shapes, functions, by_words=by_words)
            if entry.as_builtin:
                target.linkage = "internal"
                add_builtin(module, "call", target, count - 1 - len(entry.shapes[-1] or ()))
            names.append("call" if entry.as_builtin else name)
        libraries = [_library_of_normals()] if functions.draws else []
        libraries += [_code_of_program(module.globals[name], work) for name, work in functions.apart.items()]
        symbols = functions.natives | {name: of_lapack(name) for name in LAPACK if name in module.globals}
        return code_of(module, *names, unrolled=unrolled, libraries=libraries, symbols=symbols)
    except OnlyPython as error:
        reason = str(error)
    except (TypeError, NameError, AttributeError) as error:
        fault = "this is a fault of the package and not of the model: please report it"
        where = "" if functions.innermost is None else f" in {_name_of(functions.innermost)}"
        reason = f"{error_line(error)}{where}; {fault}"
    except (NotLinked, OSError, MemoryError) as error:
        reason = f"machine code of it could not be made: {error}"
    warnings.warn(f"{IN_PYTHON}: {reason}", stacklevel=3)
    return None


def _name_of(function: Callable) -> str:
    """A function's name with the file of its text, or its module."""
    code = function.__code__
    file = code.co_filename
    return f"{code.co_name} of {file.strip('<>') if file.startswith('<') else function.__module__}"


@cache
def _library_of_normals() -> Code:
    """`streams.fill_normals` for all modules, whose instructions would take a third of the time of a kernel."""
    module = ir.Module()
    kind = ir.FunctionType(ir.VoidType(), [POINTER, LONG, *[DOUBLE] * 4])
    target = ir.Function(module, kind, FILL_NORMALS)
    builder = ir.IRBuilder(target.append_basic_block())
    out, count, *counter_and_key = target.args
    translator = _Translator(builder, Functions(), FASTMATH)
    translator.call(fill_in_loop, (translator.array_at(out, [count]), count, *counter_and_key))
    builder.ret_void()
    set.add(target.attributes, WIDE)
    return code_of(module, FILL_NORMALS)


_programs: WeakValueDictionary[str, Code] = WeakValueDictionary()


def _code_of_program(declared: ir.Function, work: Any) -> Code:
    """A program for all modules that call it."""
    code = _programs.get(declared.name)
    if code is None:
        module = ir.Module()
        target = ir.Function(module, declared.ftype, declared.name)
        _Translator(ir.IRBuilder(), Functions(), frozenset()).write_program(work, target)
        set.add(target.attributes, WIDE)
        code = _programs[declared.name] = code_of(module, declared.name, unrolled=False)
    return code


def add_function(
    module: ir.Module,
    name: str,
    function: Callable,
    shapes: Sequence,
    functions: Functions | None = None,
    *,
    by_words: bool = True,
) -> tuple[ir.Function, int]:
    """Add `i64 name(words)`, a Python function of arrays and whole numbers; return it and its number of words.

    It returns 0 where Python returns nothing.

    Args:
        module: to which it is added.
        name: of the function.
        function: of Python.
        shapes: of its arguments: of an array its lengths, None for those that a call tells; None for a whole
            number, `float` for a float, `ADDRESS` for a function that is called by it; a list for a tuple of such,
            or a named tuple of such. The words are those of `machine_code.words_of`.
        functions: those that the module has already, for functions that are added later.
        by_words: whether it takes the address of its words, or, as a function that is called by its address, each
            word as an argument.

    Raises:
        TypeError: if it contains what cannot be translated.
    """
    kinds = [*_kinds(list(shapes))]
    target = ir.Function(module, ir.FunctionType(LONG, [LONG.as_pointer()] if by_words else kinds), name)
    builder = ir.IRBuilder(target.append_basic_block("entry"))
    translator = _Translator(builder, Functions() if functions is None else functions, FASTMATH)

    def word(k: int, kind: ir.Type) -> ir.Value:
        pointer = builder.gep(target.args[0], [ir.Constant(LONG, k)], source_etype=LONG)
        value = builder.load(pointer, typ=LONG)
        return {LONG: lambda: value, DOUBLE: lambda: builder.bitcast(value, DOUBLE)}.get(
            kind, lambda: builder.inttoptr(value, POINTER)
        )()

    words = iter([word(k, kind) for k, kind in enumerate(kinds)] if by_words else target.args)

    def argument_of(shape: Any) -> Any:
        if shape is None or shape is float:
            return next(words)
        if shape is ADDRESS:
            return ByAddress(next(words))
        if isinstance(shape, list | Parts):
            return tuple(map(argument_of, shape))
        if hasattr(shape, "_fields"):
            return type(shape)(*map(argument_of, shape))
        pointer, lengths = next(words), [next(words) for _ in shape]
        lengths = [b if a is None else a for a, b in zip(shape, lengths, strict=True)]
        return translator.array_at(pointer, lengths)

    result = translator.call(function, [argument_of(shape) for shape in shapes])
    translator.arrange_memory([[]])
    translator.free_all_but([])
    builder.ret(translator.numbers.as_whole(0 if result is None else result))
    set.add(target.attributes, WIDE)
    return target, len(kinds)


def _kinds(shape: Any) -> Iterator[ir.Type]:
    """The types of the words of an argument."""
    if shape is None or shape is ADDRESS:
        yield LONG
    elif shape is float:
        yield DOUBLE
    elif isinstance(shape, list | Parts) or hasattr(shape, "_fields"):
        for part in shape:
            yield from _kinds(part)
    else:
        yield from (POINTER, *(LONG for _ in shape))


def unknown(count: int, *, as_array: bool) -> Any:
    """As many numbers that are not known, in an array or a tuple, for `refusal_of`."""
    if as_array:
        return Array(ir.Constant(POINTER, ir.Undefined), (count,), (1,))
    return (ir.Constant(DOUBLE, ir.Undefined),) * count


def refusal_of(function: Callable, arguments: Sequence) -> str:
    """Why a function cannot be translated for arguments of these kinds; an empty text if it can."""
    target = ir.Function(ir.Module(), ir.FunctionType(ir.VoidType(), []), "refused")
    translator = _Translator(ir.IRBuilder(target.append_basic_block()), Functions(), FASTMATH)
    try:
        translator.call(function, arguments)
        translator._builder.ret_void()
        check(target.parent)
    except Exception as error:  # also of names that have a value in another branch only, which LLVM finds
        return error_line(error)
    return ""


class Loops:
    """A function of arrays and numbers that is translated at its first call, or runs as Python.

    Its arguments are arrays of float64 in C order, numbers, and tuples of these.

    Attributes:
        in_python: whether calls run as Python, as far as is known before the first.
    """

    def __init__(self, function: Callable, shapes: Sequence | None = None, *, unrolled: bool = True):
        """Take a function and the shapes of its arguments, see `add_function`, by default those of each call."""
        self._function, self._shapes, self._unrolled = function, shapes, unrolled
        self.in_python = is_interpreting()
        self._runs: dict[tuple, Callable] = {}  # by shapes, if these are those of calls
        self._first = threading.Lock()

    def __call__(self, *arguments):
        """Call the function."""
        if self.in_python:
            return self._as_python(*arguments)
        key = tuple(map(_shape_of, arguments)) if self._shapes is None else ()
        if key not in self._runs:
            with self._first:
                if key not in self._runs:
                    self._runs[key] = self._compiled(key)
        return self._runs[key](*arguments)

    def _compiled(self, shapes: tuple) -> Callable:
        code = machine_code_of(self._function, self._shapes or shapes, unrolled=self._unrolled)
        self.in_python = code is None
        return self._as_python if code is None else function_of(code, floats=self._shapes is None)

    def _as_python(self, *arguments):
        with np.errstate(all="ignore"):  # machine code does not warn of overflow either
            return self._function(*arguments)

    @property
    def folder(self) -> Path | None:
        """Where its machine code is kept; None where none is."""
        return None if self.in_python else code_folder()


class Parts(tuple):
    """The shapes of the parts of a tuple, as a list of them; it has a hash."""

    __slots__ = ()


def _shape_of(argument: Any) -> Any:
    """The kind of an argument, of an array without its lengths, see `add_function`."""
    if isinstance(argument, np.ndarray):
        return (None,) * argument.ndim
    if isinstance(argument, tuple):
        parts = tuple(map(_shape_of, argument))
        return type(argument)(*parts) if hasattr(argument, "_fields") else Parts(parts)
    return float if isinstance(argument, float) else None


class _Translator(Expressions):
    """Translates functions."""

    def __init__(self, builder: ir.IRBuilder, functions: Functions, flags: frozenset[str]):
        super().__init__(builder, functions, flags)
        self._changing: set[str] = set()  # names of what changes
        self._written: set[str] = set()  # names of arrays of which parts are assigned to
        self._of_names: dict[str, tuple[Array, Memory]] = {}  # of arrays that change
        self._returns: list[tuple[ir.Block, Any]] = []

    def add_body(self, function: types.FunctionType, arguments: Sequence) -> tuple[Any, list[int], list[set]]:
        """Add the body of a function for its arguments; return form, memory and leads of `Translated`."""
        self._function = self._functions.innermost = function
        node, assigned, self._written = _definition(function.__code__)
        self.wraps = (function.__module__ or "").partition(".")[0] not in OURS
        if len(arguments) != len(node.args.args):
            raise Untranslated(f"{function.__name__} with arguments by default, or too many")
        self._names = dict(zip((argument.arg for argument in node.args.args), arguments, strict=True))
        self._changing = {name for name, count in assigned.items() if count + (name in self._names) > 1}
        for name in sorted(self._changing & set(self._names)):  # so that all processes write the same
            self._store(ast.Name(name, ast.Store()), self._names[name])
        entry, body = self._builder.block, self._builder.append_basic_block("body")
        self._builder.position_at_end(body)
        self._statements(node.body)
        if not self._builder.block.is_terminated:
            self._returns.append((self._builder.block, None))
        values, builder = [value for _, value in self._returns], self._builder
        form = common_form(values)
        results = []
        for block, value in self._returns:
            builder.position_at_end(block)
            results.append(self._numbers_of(form, value))
        memory, leads = self.arrange_memory(results)
        kinds = [number.type for number in results[0]]
        kind = ir.LiteralStructType(kinds)
        _set_result(builder.function, kinds[0] if len(kinds) == 1 else kind if kinds else None)
        for (block, _), numbers in zip(self._returns, results, strict=True):
            builder.position_at_end(block)
            self.free_all_but(numbers)
            if not numbers:
                builder.ret_void()
            elif len(numbers) == 1:
                builder.ret(*numbers)
            else:
                struct = ir.Constant(kind, ir.Undefined)
                for k, number in enumerate(numbers):
                    struct = builder.insert_value(struct, number, k)
                builder.ret(struct)
        builder.position_at_end(entry)
        builder.branch(body)
        return form, memory, leads

    def _statements(self, body: Sequence[ast.stmt]) -> None:
        for statement in body:
            if self._builder.block.is_terminated:  # after a return
                return
            self._translated(statement)

    def _expr(self, statement: ast.Expr) -> None:
        self._value(statement.value)

    def _pass(self, statement: ast.Pass) -> None:
        pass

    def _return(self, statement: ast.Return) -> None:
        value = None if statement.value is None else self._value(statement.value)
        block = self._builder.append_basic_block("return")
        self._builder.branch(block)
        self._returns.append((block, value))

    def _continue(self, statement: ast.Continue) -> None:
        self._builder.branch(self._ways_out[-1][0])

    def _break(self, statement: ast.Break) -> None:
        self._builder.branch(self._ways_out[-1][1])

    def _assign(self, statement: ast.Assign) -> None:
        value = self._value(statement.value)
        for target in statement.targets:
            self._store(target, value)

    def _augassign(self, statement: ast.AugAssign) -> None:
        before = self._value(statement.target)
        value = self._value(ast.BinOp(statement.target, statement.op, statement.value))
        if isinstance(before, Array):
            if any(memory.is_copy for memory in self._memory_of(before)):
                raise Untranslated("an argument that changes in place")
            self._fill(before, value)
        else:
            self._store(statement.target, value)

    def _store(self, target: ast.expr, value: Any) -> None:
        if isinstance(target, ast.Tuple):
            if not is_tuple(value):
                raise Untranslated("an assignment of parts of what is no tuple")
            for part, entry in zip(target.elts, value, strict=True):
                self._store(part, entry)
        elif isinstance(target, ast.Subscript):
            array = self._value(target.value)
            if not isinstance(array, Array):
                raise Untranslated("an assignment to a part of what is no array")
            if any(memory.is_copy for memory in self._memory_of(array)):
                raise Untranslated("an assignment to a part of an argument that changes")
            entry, within = self._entry(array, self._value(target.slice))
            if entry.shape:
                self._fill(entry, value)
            else:
                self._put(entry, self._or_nan(within, self.numbers.as_float(value)))
        elif not isinstance(target, ast.Name):
            raise Untranslated("an assignment")
        elif (
            target.id in self._changing
            and isinstance(value, Array)
            and is_known(value.shape)
            and not (target.id in self._written and not self._memory_of(value))
        ):
            self._store_array(target.id, value)
        elif target.id in self._changing:
            if target.id not in self._slots:
                form = changing_form(value)
                kinds = [number.type for number in self._numbers_of(form, value)]
                self._slots[target.id] = form, [(self._slot(kind), kind, set()) for kind in kinds]
            form, slots = self._slots[target.id]
            for number, (slot, _, leads) in zip(self._numbers_of(form, value), slots, strict=True):
                if self._ways_out and any(isinstance(lead, Memory) for lead in self._leads[number]):
                    raise Untranslated("arrays of unknown size that change in a loop")
                leads |= self._leads[number]
                self._builder.store(number, slot)
        else:
            for memory in self._memory_of(value):
                if memory.changes:
                    raise Untranslated(f"{target.id} as another name for an array that changes")
                memory.has_name = True
            self._names[target.id] = value

    def _store_array(self, name: str, value: Array) -> None:
        """Copy an array to the memory of a name that changes; no other name may stand for either."""
        memory_list = self._memory_of(value)
        is_new = len(memory_list) == len(self._leads[value.pointer]) > 0
        if any(memory.has_name for memory in memory_list) or self.wraps and not is_new:
            raise Untranslated(f"another name for what {name} stands for, which changes")
        if name not in self._of_names:
            memory = Memory(self, self._count(value.shape))
            self._of_names[name] = self.array_at(memory.pointer, value.shape), memory
        self._names[name], memory = self._of_names[name]
        memory.changes = memory.has_name = True
        memory.is_copy |= not is_new
        self._fill(self._names[name], value)

    def _if(self, statement: ast.If) -> None:
        test = self._value(statement.test)
        if is_known(test):
            self._statements(statement.body if test else statement.orelse)
            return
        self._either(test, lambda: self._statements(statement.body), lambda: self._statements(statement.orelse))

    def _for(self, statement: ast.For) -> None:
        source = statement.iter
        if statement.orelse:
            raise Untranslated("a loop with an else")
        if not isinstance(source, ast.Call) or self._value(source.func) is not range:
            self._for_each(statement, self._value(source))
            return
        bounds = [self._value(argument) for argument in source.args]
        first, stop, step = (0, *bounds, 1) if len(bounds) == 1 else (*bounds, 1)[:3]
        if all(map(is_known, bounds)) and not range(*bounds):
            return
        for at in self._loop(first, stop, step):
            self._store(statement.target, at)
            self._statements(statement.body)
        self._forget(statement.target)

    def _for_each(self, statement: ast.For, entries: Any) -> None:
        if isinstance(entries, Array):
            for at in self._loop(0, entries.shape[0]):
                self._store(statement.target, self._part(entries, at))
                self._statements(statement.body)
            self._forget(statement.target)
            return
        if type(entries) is not tuple:
            raise Untranslated("a loop that is over no range or tuple")
        after = self._builder.append_basic_block("after")
        for entry in entries:
            following = self._builder.append_basic_block("following")
            self._store(statement.target, entry)
            self._ways_out.append((following, after))
            self._statements(statement.body)
            self._ways_out.pop()
            self._lead_to(following)
        self._lead_to(after)
        self._forget(statement.target)

    def _forget(self, target: ast.expr) -> None:
        """Forget what counted a loop: after the loop it would be one too many, or the last even after a break."""
        for part in ast.walk(target):
            if isinstance(part, ast.Name):
                self._names.pop(part.id, None)

    def _while(self, statement: ast.While) -> None:
        if statement.orelse:
            raise Untranslated("a loop with an else")
        builder = self._builder
        head, inside, after = map(builder.append_basic_block, ("head", "inside", "after"))
        self.has_loops = True
        self._lead_to(head)
        builder.cbranch(self.numbers.truth(self._value(statement.test)), inside, after)
        builder.position_at_end(inside)
        self._ways_out.append((head, after))
        self._statements(statement.body)
        self._ways_out.pop()
        if not builder.block.is_terminated:
            builder.branch(head)
        builder.position_at_end(after)


@cache
def _definition(code: types.CodeType) -> tuple[ast.FunctionDef, Counter[str], set[str]]:
    """A function as a tree, how often it assigns to each name, and the arrays whose parts it assigns to."""
    try:
        node = ast.parse(textwrap.dedent(inspect.getsource(code))).body[0]
    except (OSError, SyntaxError):
        raise Untranslated(f"the source of {code.co_name} cannot be read") from None
    names = code.co_name, *code.co_varnames[: code.co_argcount]
    if not isinstance(node, ast.FunctionDef) or (node.name, *(part.arg for part in node.args.args)) != names:
        raise Untranslated(f"{code.co_name} is no plain function, or its file has changed")
    parts = [*ast.walk(node)]
    stores = (part.value for part in parts if isinstance(part, ast.Subscript) and isinstance(part.ctx, ast.Store))
    assigned = Counter(name for part in parts for name in _assigned(part))
    return node, assigned, {part.id for part in stores if isinstance(part, ast.Name)}


def _set_result(function: ir.Function, kind: ir.Type | None) -> None:
    """Set the type of a function's result, which is known after its body only."""
    function.ftype.return_type = function.return_value.type = ir.VoidType() if kind is None else kind


def _assigned(node: ast.AST) -> list[str]:
    """Names to which a statement assigns numbers, twice if it changes them in place."""
    if isinstance(node, ast.AugAssign):
        return [node.target.id] * 2 if isinstance(node.target, ast.Name) else []
    targets = node.targets if isinstance(node, ast.Assign) else []
    names = [part for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
    return [name.id for name in names if isinstance(name.ctx, ast.Store) and name.id != "_"]
