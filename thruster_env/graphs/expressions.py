"""Expressions of loops as instructions of LLVM, and calls of programs and functions in them."""

from __future__ import annotations

import ast
import builtins
import math
import types
from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]

from thruster_env.core.compiled import fastmath_of, instead_of
from thruster_env.core.sources import fill
from thruster_env.core.streams import fill_normals
from thruster_env.graphs.arithmetic import (
    BOOL,
    FUNCTIONS,
    OF_ENTRIES,
    OnlyPython,
    Untranslated,
    as_value,
    is_known,
)
from thruster_env.graphs.arrays import POINTER, Arrays, Memory
from thruster_env.graphs.forms import Array, Known, common_form, form_of, value_of
from thruster_env.graphs.instructions import DOUBLE, LONG, LoopWriter, Writer
from thruster_env.graphs.machine_code import WIDE
from thruster_env.graphs.programs import CALLED, OF_MEMBERS, READ_NUMBERS, cut

FILL_NORMALS = "fill_normals"
MOST_WITHIN = 60  # operations of a program that is compiled together with what calls it
MOST_NUMBERS = 2**40  # the length of an array of which only the pointer is known


class Functions(dict):
    """The functions and programs of a module, by what they are made of.

    Attributes:
        draws: whether normals are drawn, by machine code that all modules share.
        natives: functions that are machine code already, by their names.
        apart: programs that are modules of their own, as many filters of a model share them, by their names.
        innermost: the function that is translated.
    """

    draws = False
    innermost: Any = None

    def __init__(self):
        super().__init__()
        self.natives: dict[str, Native] = {}
        self.apart: dict[str, Any] = {}


class Native:
    """A function void f(double *given, double *results) that is machine code already.

    Attributes:
        address: of it.
        shape: of the results.
        as_array: whether these are an array, and no tuple.
    """

    def __init__(self, address: int, shape: tuple[int, ...], as_array: bool, holder: Any):
        """See the class; `holder` lives as long, and the code with it."""
        self.address, self.shape, self.as_array, self._holder = address, shape, as_array, holder


class ByAddress(NamedTuple):
    """A function of which only the address is known; it takes the words of its arguments, see `loops.Entry`."""

    address: ir.Value


class Translated(NamedTuple):
    """A function of a module.

    Attributes:
        function: that takes the numbers of its arguments, then the memory of results.
        form: of its result.
        has_loops: whether it has loops or calls of programs.
        memory: how many numbers each array takes that it returns.
        leads: of each number of the result, where it leads if it is a pointer, see `arrays.Memory`.
    """

    function: ir.Function
    form: Any
    has_loops: bool
    memory: Sequence[int]
    leads: Sequence[set]


class Expressions(Arrays):
    """Translates expressions: names stand for values of LLVM, arrays, tuples, or objects of Python that are known.

    Attributes:
        has_loops: whether there are loops or calls of programs, also in what is called.
    """

    def __init__(self, builder: ir.IRBuilder, functions: Functions, flags: frozenset[str]):
        super().__init__(builder, flags)
        self._functions, self.has_loops = functions, False
        self._names: dict[str, Any] = {}
        self._slots: dict[str, Any] = {}  # forms and addresses of what changes
        self._function: Any = None

    def call(self, function: Any, arguments: Sequence) -> Any:
        """Call a function with these arguments; return its result."""
        if hasattr(function, "program"):
            return self._call_program(function, arguments)
        if isinstance(function, ByAddress):
            return self._call_address(function.address, arguments)
        if function in BUILTINS:
            return BUILTINS[function](self, *arguments)
        if function in FUNCTIONS:
            if function in OF_ENTRIES and any(isinstance(argument, Array) for argument in arguments):
                return self._by_entries(lambda *entries: FUNCTIONS[function](self.numbers, *entries), *arguments)
            return FUNCTIONS[function](self.numbers, *arguments)
        if hasattr(function, "evaluation"):
            return self._evaluate(*function.evaluation, *arguments)
        if (instead := instead_of(function)) is not None:
            if instead.function is None:
                raise OnlyPython(instead.reason)
            return self.call(instead.function, arguments)
        if hasattr(function, "native"):
            return self._call_native(function, *arguments)
        if hasattr(function, "_fields"):  # a kind of tuple
            return function(*arguments)
        if not isinstance(function, types.FunctionType):
            raise Untranslated(f"a call of {function!r}")
        numbers: list[ir.Value] = []
        key = function, *(form_of(argument, numbers) for argument in arguments)
        known = key in self._functions
        if not known:
            self._functions[key] = None  # which a function that calls itself would unpack
            self._functions[key] = self._added(key, [number.type for number in numbers])
        called: Translated = self._functions[key]
        self.has_loops |= called.has_loops
        if known and called.has_loops:  # a second copy of loops would only take time to compile
            called.function.attributes.add("noinline")
        results = [Memory(self, count) for count in called.memory]
        value = self._builder.call(called.function, [*numbers, *(memory.pointer for memory in results)])
        parts = [value]
        if isinstance(value.type, ir.LiteralStructType):
            parts = [self._builder.extract_value(value, k) for k in range(len(value.type.elements))]
        for part, leads in zip(parts, called.leads, strict=False):
            self._leads[part] = {
                lead for way in leads for lead in self._where_result_leads(way, part, numbers, results)
            }
        return value_of(called.form, iter(parts))

    def _where_result_leads(self, way: Any, part: ir.Value, numbers: Sequence, results: Sequence) -> set:
        """Where a pointer leads that another function returns, see `Translated.leads`."""
        if way is None:  # memory that it has asked for
            return {Memory(self, pointer=part)}
        kind, k = way
        return {results[k]} if kind == "result" else self._leads[numbers[k]]

    def add_body(self, function: types.FunctionType, arguments: Sequence) -> tuple[Any, list[int], list[set]]:
        """Add the body of a function for its arguments; return form, memory and leads of `Translated`."""
        raise NotImplementedError

    def _added(self, key: tuple, kinds: Sequence[ir.Type]) -> Translated:
        """A new function, for arguments of these forms."""
        function, *forms = key
        kind = ir.FunctionType(ir.VoidType(), kinds)  # the type of the result is known after the body
        target = new_function(self._builder.module, kind, function.__name__)
        builder = ir.IRBuilder(target.append_basic_block("entry"))
        translator = type(self)(builder, self._functions, frozenset(fastmath_of(function)))
        for k, argument in enumerate(target.args):
            if argument.type == POINTER:
                translator._leads[argument] = {("argument", k)}
        numbers, caller = iter(target.args), self._functions.innermost
        form, memory, leads = translator.add_body(function, [value_of(form, numbers) for form in forms])
        self._functions.innermost = caller
        return Translated(target, form, translator.has_loops, memory, leads)

    def _value(self, node: ast.expr | None) -> Any:
        return self._translated(node)

    def _translated(self, node: ast.AST | None) -> Any:
        translate = getattr(self, f"_{type(node).__name__.lower()}", None)
        if translate is None:
            raise Untranslated(f"{type(node).__name__} in {self._function.__name__}")
        return translate(node)

    def _numbers_of(self, form: Any, value: Any) -> list[ir.Value]:
        """The numbers of a value in a form."""
        if isinstance(form, ir.Type):
            return [self.numbers.converted(form, value)]
        if isinstance(form, Known):
            return []
        return [
            number for part, entry in zip(form[1:], value, strict=True) for number in self._numbers_of(part, entry)
        ]

    # Expressions.

    def _constant(self, node: ast.Constant) -> Any:
        return node.value

    def _name(self, node: ast.Name) -> Any:
        if node.id in self._slots:
            form, slots = self._slots[node.id]
            numbers = []
            for slot, kind, leads in slots:
                numbers.append(self._builder.load(slot, typ=kind))
                self._leads[numbers[-1]] = leads
            return value_of(form, iter(numbers))
        function = self._function
        cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
        if node.id in self._names:
            return self._names[node.id]
        if node.id in function.__code__.co_varnames:  # of another turn of a loop, or of one that has ended
            raise Untranslated(f"{node.id} of {function.__name__} where it may have no value, or another one")
        if node.id in cells:
            return cells[node.id].cell_contents
        return function.__globals__[node.id] if node.id in function.__globals__ else getattr(builtins, node.id)

    def _attribute(self, node: ast.Attribute) -> Any:
        value = self._value(node.value)
        if isinstance(value, Array) and node.attr in ATTRIBUTES:
            return ATTRIBUTES[node.attr](self, value)
        if not isinstance(value, Array) and (is_known(value) or node.attr in getattr(value, "_fields", ())):
            return getattr(value, node.attr)
        raise Untranslated(f"the attribute {node.attr}")

    def _tuple(self, node: ast.Tuple | ast.List) -> tuple:
        return tuple(self._values(node.elts))

    def _values(self, nodes: Sequence[ast.expr]) -> list:
        """The values of expressions, those of a tuple with a star one after the other."""
        values: list = []
        for node in nodes:
            value = self._value(node.value if isinstance(node, ast.Starred) else node)
            values += self._entries_of(value) if isinstance(node, ast.Starred) else [value]
        return values

    _list = _tuple  # what reads it cannot change it

    def _call(self, node: ast.Call) -> Any:
        if node.keywords:
            raise Untranslated("arguments by name")
        if isinstance(node.func, ast.Attribute) and not is_known(value := self._value(node.func.value)):
            return self._method(value, node.func.attr, self._values(node.args))
        return self.call(self._value(node.func), self._values(node.args))

    def _method(self, value: Any, name: str, arguments: list) -> Any:
        if name == "copy" and isinstance(value, Array) and not arguments:
            return self._copied(value)
        if name == "reshape" and isinstance(value, Array):
            shape = arguments[0] if isinstance(arguments[0], tuple) else tuple(arguments)
            if value.steps == self.array_at(value.pointer, value.shape).steps:  # in C order
                return self.array_at(value.pointer, self._of_same_count(shape, value))
        if name == "view" and isinstance(value, ir.Value):
            return self.numbers.bits_as({np.int64: LONG, np.float64: DOUBLE}[arguments[0]], value)
        raise Untranslated(f"the method {name}")

    def _of_same_count(self, shape: tuple, value: Array) -> tuple:
        """A shape for the numbers of an array, whose -1 is what remains for it."""
        count = self._count(value.shape)
        if shape == (-1,):
            return (count,)
        if is_known((count, *shape)):
            rest = math.prod(size for size in shape if size != -1)
            shape = tuple(count // max(rest, 1) if size == -1 else size for size in shape)
            if math.prod(shape) != count:
                raise Untranslated(f"{count} numbers in the shape {shape}")
        elif any(is_known(size) and size == -1 for size in shape):
            raise Untranslated("a shape with -1 for a count that is not known")
        return shape

    def _binop(self, node: ast.BinOp) -> Any:
        a, b = self._value(node.left), self._value(node.right)
        if isinstance(node.op, ast.Add) and type(a) is type(b) is tuple:
            return a + b
        name = type(node.op).__name__
        if isinstance(a, Array) or isinstance(b, Array):
            if name not in ("Add", "Sub", "Mult", "Div", "Pow"):
                raise Untranslated(f"{name} of arrays")
            return self._by_entries(lambda *entries: self.numbers.of_two(name, *entries), a, b)
        return self.numbers.of_two(name, a, b)

    def _unaryop(self, node: ast.UnaryOp) -> Any:
        value = self._value(node.operand)
        if isinstance(node.op, ast.Not):
            return not value if is_known(value) else self._builder.not_(self.numbers.truth(value))
        if not isinstance(node.op, ast.USub):
            raise Untranslated("an operator")
        if isinstance(value, Array):
            return self._by_entries(lambda entry: self.numbers.of_two("Sub", 0, entry), value)
        return -value if is_known(value) else self.numbers.of_two("Sub", 0, value)

    def _compare(self, node: ast.Compare) -> Any:
        values = [self._value(part) for part in (node.left, *node.comparators)]
        triples = zip(node.ops, values[:-1], values[1:], strict=True)
        results = [self._compared(type(op).__name__, a, b) for op, a, b in triples]
        return results[0] if len(results) == 1 else self._all(results)

    def _compared(self, name: str, a: Any, b: Any) -> Any:
        if name not in ("In", "NotIn"):
            return self.numbers.of_two(name, a, b)
        if is_known(a) and is_known(b):
            return (a in b) == (name == "In")
        equal = [self.numbers.truth(self.numbers.of_two("Eq", a, entry)) for entry in b]
        matches = reduce(self._builder.or_, equal, ir.Constant(BOOL, 0))
        return matches if name == "In" else self._builder.not_(matches)

    def _all(self, values: Sequence) -> ir.Value:
        return reduce(self._builder.and_, map(self.numbers.truth, values))

    def _boolop(self, node: ast.BoolOp) -> Any:
        """Python's `and` and `or`, of numbers, too: what may fail, or takes long, is skipped if it can be."""
        ends = isinstance(node.op, ast.Or)
        first, *rest = node.values
        value = self._value(first)
        if not rest:
            return value
        remaining = ast.BoolOp(node.op, rest)
        if is_known(value):
            return value if bool(value) == ends else self._boolop(remaining)
        if not _is_plain(remaining, first):
            parts = (lambda: value), (lambda: self._boolop(remaining))
            return self._either(value, *(parts if ends else parts[::-1]))
        values = value, self._boolop(remaining)
        if all(as_value(part).type == BOOL for part in values):
            return (self._builder.or_ if ends else self._builder.and_)(*map(self.numbers.truth, values))
        return self._selected(value, values if ends else values[::-1])

    def _ifexp(self, node: ast.IfExp) -> Any:
        test = self._value(node.test)
        if is_known(test):
            return self._value(node.body if test else node.orelse)
        if not (_is_plain(node.body, node.test) and _is_plain(node.orelse, node.test)):
            return self._either(test, lambda: self._value(node.body), lambda: self._value(node.orelse))
        return self._selected(test, (self._value(node.body), self._value(node.orelse)))

    def _selected(self, test: Any, values: Sequence) -> Any:
        """The first of two values if the test is true, else the second."""
        test, form = self.numbers.truth(test), common_form(values)
        numbers = []
        for pair in zip(*(self._numbers_of(form, value) for value in values), strict=True):
            numbers.append(self._builder.select(test, *pair))
            self._leads[numbers[-1]] = {lead for number in pair for lead in self._leads[number]}
        return value_of(form, iter(numbers))

    def _slice(self, node: ast.Slice) -> slice:
        return slice(*(part and self._value(part) for part in (node.lower, node.upper, node.step)))

    def _subscript(self, node: ast.Subscript) -> Any:
        return self._part(self._value(node.value), self._value(node.slice))

    # Branches and loops.

    def _either(self, test: Any, then: Callable, otherwise: Callable) -> Any:
        """Translate `then` and `otherwise` as branches; return the result of the one that is taken."""
        builder = self._builder
        blocks = [builder.append_basic_block(name) for name in ("then", "otherwise")]
        builder.cbranch(self.numbers.truth(test), *blocks)
        ends, values = [], []
        for block, translate in zip(blocks, (then, otherwise), strict=True):
            builder.position_at_end(block)
            value = translate()
            if not builder.block.is_terminated:
                ends.append(builder.block)
                values.append(value)
        if not ends:
            return None
        form, after = common_form(values), builder.append_basic_block("after")
        phis: list[list[tuple]] = []
        for block, value in zip(ends, values, strict=True):
            builder.position_at_end(block)
            phis.append([(number, block) for number in self._numbers_of(form, value)])
            builder.branch(after)
        builder.position_at_end(after)
        numbers = []
        for incoming in zip(*phis, strict=True):
            numbers.append(builder.phi(incoming[0][0].type))
            for number, block in incoming:
                numbers[-1].add_incoming(number, block)
            self._leads[numbers[-1]] = {lead for number, _ in incoming for lead in self._leads[number]}
        return value_of(form, iter(numbers))

    # Calls.

    def _call_program(self, function: Any, arguments: Sequence) -> None:
        """Call a program, which is a function of its own."""
        self.has_loops = True
        program, _, names, _ = function.program
        arrays = [argument for argument in arguments if isinstance(argument, Array)]
        if any(isinstance(step, int) and step != 1 for array in arrays for step in array.steps[-1:]):
            raise Untranslated("a program on every few numbers of an array")
        more: list = []
        if "memory" in names:  # a part of a wider array: the step from row to row is one more argument
            more = [arrays[names.index("memory")].steps[0]]
        if names == OF_MEMBERS:
            more = [arrays[names.index("table")].shape[1], arguments[-1]]
        called, module = self._functions.get(function), self._builder.module
        kind = ir.FunctionType(ir.VoidType(), [POINTER] * len(arrays) + [LONG] * len(more))
        if called is None and len(program.works) > MOST_WITHIN and not function.calls:
            self._functions.apart[function.name] = function
            called = module.globals.get(function.name) or ir.Function(module, kind, function.name)
        elif called is None:
            called = self._functions[function] = new_function(module, kind, "program")
            called.attributes.add("noinline")  # within a loop it would take other last digits
            self.write_program(function, called)
        self._builder.call(called, [*(array.pointer for array in arrays), *map(self.numbers.as_whole, more)])

    def write_program(self, function: Any, target: ir.Function) -> None:
        """Write a program's instructions as the body of a function."""
        program, width, names, scratch = function.program
        set.add(target.attributes, "alignstack(64)")  # else vectors that it keeps there lie across cache lines
        builder, data = ir.IRBuilder(target.append_basic_block()), dict(zip(names, target.args, strict=False))
        translator = type(self)(builder, self._functions, frozenset())
        if names == OF_MEMBERS:
            columns, size = target.args[-2:]
            LoopWriter(translator.call_by_name, builder, data, width, columns, size).write(cut(program, scratch))
        else:
            writer = Writer(translator.call_by_name, builder, data, width)
            writer.stride = target.args[-1]
            writer.write_repeated(program, lambda kind: new_function(builder.module, kind, "repeated"))
        translator.arrange_memory([[]])
        translator.free_all_but([])
        builder.ret_void()

    def _call_address(self, address: ir.Value, arguments: Sequence) -> None:
        self.has_loops, words = True, self._words_of(arguments)
        kind = ir.FunctionType(LONG, [word.type for word in words])
        self._builder.call(self._builder.inttoptr(address, kind.as_pointer()), words)

    def _words_of(self, value: Any) -> list[ir.Value]:
        """The words of arguments as `machine_code.words_of` has them; arrays are in C order."""
        if isinstance(value, Array):
            return [value.pointer, *map(self.numbers.as_whole, value.shape)]
        if isinstance(value, tuple | list):
            return [word for part in value for word in self._words_of(part)]
        return [as_value(value)]

    def call_by_name(self, name: str, numbers: Sequence, count: int, table: ir.Value | None) -> list[ir.Value]:
        """The `count` results of a function of CALLED for some numbers, and perhaps the array `numbers`."""
        arguments, results = self._copied((*numbers,)), self._array_on_stack(count)
        tables = [self.array_at(table, (MOST_NUMBERS,))] if name in READ_NUMBERS else []
        self.call(CALLED[name], [arguments, results, *tables])
        return [self._part(results, k) for k in range(count)]

    def _evaluate(self, work: Callable, shape: Sequence, sizes: Sequence, vectors: tuple, out: Any = None) -> Any:
        """The results of a program of vectors of some sizes: in a tuple of this shape, or in an array."""
        count, arguments = int(np.prod(shape)), self._array_on_stack(sum(sizes))
        entries = [(vector, k) for vector, size in zip(vectors, sizes, strict=True) for k in range(size)]
        for source, _ in work.program[0].reads:  # type: ignore[attr-defined]
            value = self._part(*entries[source.at])
            self._builder.store(self.numbers.as_float(value), self._behind(arguments.pointer, source.at), align=8)
        results = self._array_on_stack(count) if out is None else out
        self._call_program(work, (results, arguments, arguments))
        if out is not None:
            return None
        numbers = [self._part(results, k) for k in range(count)]
        rows = zip(*[iter(numbers)] * shape[-1], strict=True)
        return tuple(numbers) if len(shape) == 1 else tuple(rows)

    def _call_native(self, function: Any, *vectors: Any) -> Any:
        """The results of a function that is machine code already, in a tuple or an array of its shape."""
        native, names = function.native, self._functions.natives
        name = next((name for name, other in names.items() if other is native), f"native_{len(names)}")
        names[name] = native
        numbers = [entry for vector in vectors for entry in self._entries_of(vector)]
        arguments, results = self._copied((*map(self.numbers.as_float, numbers),)), self._new_array(native.shape)
        kind = ir.FunctionType(ir.VoidType(), [POINTER, POINTER])
        module = self._builder.module
        called = module.globals.get(name) or ir.Function(module, kind, name)
        self._builder.call(called, [arguments.pointer, results.pointer])
        if native.as_array:
            return results
        rows = [self._entries_of(self._part(results, k)) for k in range(native.shape[0])]
        return tuple(rows) if len(native.shape) == 2 else tuple(row for (row,) in rows)

    def _entries_of(self, value: Any) -> tuple:
        """The numbers of a vector whose length is known, or of a number."""
        if isinstance(value, Array):
            return tuple(self._part(value, k) for k in range(value.shape[0]))
        return value if isinstance(value, tuple) else (value,)

    def _fill_normals(self, out: Array, count: Any, *counter_and_key: Any) -> None:
        if out.steps != (1,):
            raise Untranslated("normals in a part of an array")
        self._functions.draws, module = True, self._builder.module
        kind = ir.FunctionType(ir.VoidType(), [POINTER, LONG, *[DOUBLE] * len(counter_and_key)])
        function = module.globals.get(FILL_NORMALS) or ir.Function(module, kind, FILL_NORMALS)
        numbers = self.numbers.as_whole(count), *map(self.numbers.as_float, counter_and_key)
        self._builder.call(function, [out.pointer, *numbers])


BUILTINS: dict[Any, Callable] = {
    np.zeros: Expressions._zeros,
    np.empty: Expressions._new_array,
    np.empty_like: lambda translator, like: translator._new_array(like.shape),
    np.zeros_like: lambda translator, like: translator._zeros(like.shape),
    np.ones: lambda translator, shape: translator._full(shape, 1.0),
    np.full: Expressions._full,
    np.eye: Expressions._identity,
    np.identity: Expressions._identity,
    np.array: Expressions._copied,
    np.linalg.eigh: Expressions._eigenvectors,
    fill: Expressions._fill,
    len: Expressions._length,
    fill_normals: Expressions._fill_normals,
}
ATTRIBUTES: dict[str, Callable] = {
    "shape": lambda translator, array: array.shape,
    "ndim": lambda translator, array: len(array.shape),
    "size": lambda translator, array: translator._count(array.shape),
    "T": lambda translator, array: Array(array.pointer, array.shape[::-1], array.steps[::-1]),
}


def instruction(write: Callable) -> Callable:
    """What translated functions may call to have `write(builder, *numbers)` write instructions of LLVM."""

    def call(*_):
        raise NotImplementedError(f"{write.__name__} is machine code alone")

    BUILTINS[call] = lambda translator, *values: write(translator._builder, *map(as_value, values))
    return call


def new_function(module: ir.Module, kind: ir.FunctionType, name: str) -> ir.Function:
    """Add a function to a module, for its own calls."""
    function = ir.Function(module, kind, module.get_unique_name(f"_{name}"))  # no name of an entry
    function.linkage = "internal"
    set.add(function.attributes, WIDE)  # its own `add` knows attributes without a value only
    return function


def _is_plain(node: ast.expr, test: ast.expr) -> bool:
    """Whether a part may be evaluated where it is not needed: it calls nothing, and reads what the test reads."""
    alike = {ast.dump(part) for part in _always_evaluated(test) if isinstance(part, ast.Subscript)}
    skipped = ast.Call, ast.Subscript, ast.FloorDiv, ast.Mod
    return all(not isinstance(part, skipped) or ast.dump(part) in alike for part in ast.walk(node))


def _always_evaluated(node: ast.AST) -> Iterator[ast.AST]:
    """An expression and its parts, without those that `and`, `or` and conditions may skip."""
    yield node
    parts = [node.values[0]] if isinstance(node, ast.BoolOp) else ast.iter_child_nodes(node)
    for part in [node.test] if isinstance(node, ast.IfExp) else parts:
        yield from _always_evaluated(part)
