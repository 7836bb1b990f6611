"""Expressions of loops as instructions of LLVM, and calls of programs and functions in them."""

from __future__ import annotations

import ast
import builtins
import types
from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]

from thruster_env.core.compiled import FASTMATH, instead_of
from thruster_env.core.optimising import WIDE
from thruster_env.core.streams import fill_normals
from thruster_env.graphs.arithmetic import BOOL, FUNCTIONS, Arithmetic, Untranslated, as_value, is_known
from thruster_env.graphs.forms import Array, Known, common_form, form_of, value_of
from thruster_env.graphs.instructions import DOUBLE, LONG, LoopWriter, Writer
from thruster_env.graphs.programs import OF_MEMBERS, cut

LONGEST = 4096  # numbers of an array that a function makes for itself, on the stack
POINTER = DOUBLE.as_pointer()
FILL_NORMALS = "fill_normals"


class Functions(dict):
    """The functions and programs of a module, by what they are made of.

    Attributes:
        programs_apart: whether programs are never inlined: within a loop they would take other last digits.
        draws: whether normals are drawn, by machine code that all modules share.
    """

    programs_apart, draws = True, False


class Expressions:
    """Translates expressions: names stand for values of LLVM, arrays, tuples, or objects of Python that are known.

    Attributes:
        numbers: operations on numbers.
        has_loops: whether there are loops or calls of programs, also in what is called.
    """

    def __init__(self, builder: ir.IRBuilder, functions: Functions):
        self.numbers, self._builder, self._functions = Arithmetic(builder), builder, functions
        self.has_loops = False
        self._names: dict[str, Any] = {}
        self._slots: dict[str, Any] = {}  # forms and addresses of what changes
        self._function: Any = None
        self._ways_out: list[tuple[ir.Block, ir.Block]] = []  # of loops: where `continue` and `break` lead
        self._on_heap: list[ir.Value] = []  # slots of addresses that are freed at the end
        self._makes_arrays = self._makes_in_loop = False

    def call(self, function: Any, arguments: Sequence) -> Any:
        """Call a function with these arguments; return its result."""
        if hasattr(function, "program"):
            return self._call_program(function, arguments)
        if function in BUILTINS:
            return BUILTINS[function](self, *arguments)
        if function in FUNCTIONS:
            return FUNCTIONS[function](self.numbers, *arguments)
        if hasattr(function, "evaluation"):
            return self._evaluate(*function.evaluation, *arguments)
        if (instead := instead_of(function)) is not None:
            if instead.function is None or instead.fastmath != FASTMATH:
                raise Untranslated(f"a call of {function!r}")
            return self.call(instead.function, arguments)
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
        called, form, has_loops = self._functions[key]
        self.has_loops |= has_loops
        if known and has_loops:  # a second copy of loops would only take time to compile
            called.attributes.add("noinline")
        result = self._builder.call(called, numbers)
        if isinstance(result.type, ir.LiteralStructType):
            parts = [self._builder.extract_value(result, k) for k in range(len(result.type.elements))]
            return value_of(form, iter(parts))
        return value_of(form, iter([result]))

    def add_body(self, function: types.FunctionType, arguments: Sequence) -> Any:
        """Add the body of a function for its arguments; return the form of its results."""
        raise NotImplementedError

    def _added(self, key: tuple, kinds: Sequence[ir.Type]) -> tuple:
        """A new function, for arguments of these forms; with the form of its result, and whether it has loops."""
        function, *forms = key
        kind = ir.FunctionType(ir.VoidType(), kinds)  # the type of the result is known after the body
        target = new_function(self._builder.module, kind, function.__name__)
        translator = type(self)(ir.IRBuilder(target.append_basic_block("entry")), self._functions)
        numbers = iter(target.args)
        form = translator.add_body(function, [value_of(form, numbers) for form in forms])
        return target, form, translator.has_loops

    def array_at(self, pointer: ir.Value, shape: Sequence) -> Array:
        """An array in C order."""
        steps: list = [1]
        for size in reversed(shape[1:]):
            steps.insert(0, self.numbers.of_two("Mult", size, steps[0]))
        return Array(pointer, tuple(shape), tuple(steps[: len(shape)]))

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

    def _slot(self, kind: ir.Type, count: int = 1) -> ir.Value:
        with self._builder.goto_entry_block():
            return self._builder.alloca(kind, count)

    # Expressions.

    def _constant(self, node: ast.Constant) -> Any:
        return node.value

    def _name(self, node: ast.Name) -> Any:
        if node.id in self._slots:
            form, slots = self._slots[node.id]
            return value_of(form, (self._builder.load(slot, typ=kind) for slot, kind in slots))
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
        if is_known(value) or node.attr in getattr(value, "_fields", ()):
            return getattr(value, node.attr)
        raise Untranslated(f"the attribute {node.attr}")

    def _tuple(self, node: ast.Tuple) -> tuple:
        return tuple(self._value(part) for part in node.elts)

    def _call(self, node: ast.Call) -> Any:
        if node.keywords:
            raise Untranslated("arguments by name")
        if isinstance(node.func, ast.Attribute) and not is_known(value := self._value(node.func.value)):
            return self._method(value, node.func.attr, [self._value(argument) for argument in node.args])
        return self.call(self._value(node.func), [self._value(argument) for argument in node.args])

    def _method(self, value: Any, name: str, arguments: list) -> Any:
        if name == "reshape" and isinstance(value, Array):
            shape = arguments[0] if isinstance(arguments[0], tuple) else tuple(arguments)
            if value.steps == self.array_at(value.pointer, value.shape).steps:  # in C order
                return self.array_at(value.pointer, (self._count(value.shape),) if shape == (-1,) else shape)
        if name == "view" and isinstance(value, ir.Value):
            return self.numbers.bits_as({np.int64: LONG, np.float64: DOUBLE}[arguments[0]], value)
        raise Untranslated(f"the method {name}")

    def _binop(self, node: ast.BinOp) -> Any:
        a, b = self._value(node.left), self._value(node.right)
        if isinstance(node.op, ast.Add) and type(a) is type(b) is tuple:
            return a + b
        return self.numbers.of_two(type(node.op).__name__, a, b)

    def _unaryop(self, node: ast.UnaryOp) -> Any:
        value = self._value(node.operand)
        if isinstance(node.op, ast.Not):
            return not value if is_known(value) else self._builder.not_(self.numbers.truth(value))
        if not isinstance(node.op, ast.USub):
            raise Untranslated("an operator")
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
        pairs = zip(*(self._numbers_of(form, value) for value in values), strict=True)
        return value_of(form, (self._builder.select(test, *pair) for pair in pairs))

    def _slice(self, node: ast.Slice) -> slice:
        return slice(*(part and self._value(part) for part in (node.lower, node.upper, node.step)))

    def _subscript(self, node: ast.Subscript) -> Any:
        return self._part(self._value(node.value), self._value(node.slice))

    def _part(self, value: Any, index: Any) -> Any:
        """An entry or a part of a tuple or an array."""
        entry = self._entry(value, index)
        if isinstance(entry, Array) and not entry.shape:
            return self._builder.load(entry.pointer, align=8, typ=DOUBLE)
        return entry

    def _entry(self, value: Any, index: Any) -> Any:
        """What lies at an index: a tuple's entry, or an array's part, which has no lengths if it is a number."""
        if not isinstance(value, Array):
            if isinstance(value, tuple):
                return value[index] if is_known(index) else self._entry_of_known(value, index)
            raise Untranslated("an index")
        indices = list(index) if isinstance(index, tuple) else [index]
        indices += [slice(None)] * (len(value.shape) - len(indices))
        at, shape, steps, of_two = 0, [], [], self.numbers.of_two
        for part, size, step in zip(indices, value.shape, value.steps, strict=True):
            first: Any = _from_the_end(part, size, of_two)
            if isinstance(part, slice):
                if part.step is not None:
                    raise Untranslated("a slice with a step")
                if all(map(is_known, (part.start, part.stop, size))):
                    first, stop, _ = part.indices(size)
                    stop = max(first, stop)
                else:
                    first = 0 if part.start is None else _from_the_end(part.start, size, of_two)
                    stop = size if part.stop is None else _from_the_end(part.stop, size, of_two)
                shape.append(of_two("Sub", stop, first))
                steps.append(step)
            at = of_two("Add", at, of_two("Mult", first, step))
        return Array(self._behind(value.pointer, at), tuple(shape), tuple(steps))

    def _entry_of_known(self, values: tuple, index: Any) -> ir.Value:
        """An entry of a tuple of known numbers, at an index that is not known."""
        numbers = [as_value(value) for value in values if is_known(value)]
        kind = DOUBLE if any(number.type == DOUBLE for number in numbers) else LONG
        if len(numbers) < len(values) or not values:
            raise Untranslated("an index")
        module = self._builder.module
        table = ir.GlobalVariable(module, ir.ArrayType(kind, len(values)), module.get_unique_name("known"))
        table.linkage, table.global_constant = "internal", True
        table.initializer = ir.Constant(table.value_type, [float(v) if kind == DOUBLE else int(v) for v in values])
        pointer = self._builder.gep(table, [ir.Constant(LONG, 0), self.numbers.as_whole(index)])
        return self._builder.load(pointer, typ=kind)

    def _behind(self, pointer: ir.Value, count: Any) -> ir.Value:
        return self._builder.gep(pointer, [self.numbers.as_whole(count)], source_etype=DOUBLE)

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
        return value_of(form, iter(numbers))

    def _loop(self, first: Any, stop: Any, step: Any = 1) -> Iterator[ir.Value]:
        """The index of a loop, once: what is translated meanwhile is its body."""
        builder = self._builder
        head, inside, following, after = map(builder.append_basic_block, ("head", "inside", "following", "after"))
        self.has_loops = True
        first, stop, step = (self.numbers.as_whole(bound) for bound in (first, stop, step))
        before = builder.block
        self._lead_to(head)
        at = builder.phi(LONG)
        at.add_incoming(first, before)
        up, down = (builder.icmp_signed(sign, at, stop) for sign in "<>")
        if isinstance(step, ir.Constant):
            goes_on = up if step.constant > 0 else down
        else:
            goes_on = builder.select(builder.icmp_signed(">", step, ir.Constant(LONG, 0)), up, down)
        builder.cbranch(goes_on, inside, after)
        builder.position_at_end(inside)
        self._ways_out.append((following, after))
        yield at
        self._ways_out.pop()
        self._lead_to(following)
        at.add_incoming(builder.add(at, step, flags=("nsw",)), following)
        builder.branch(head)
        builder.position_at_end(after)

    def _lead_to(self, block: ir.Block) -> None:
        """Go on in another block."""
        if not self._builder.block.is_terminated:
            self._builder.branch(block)
        self._builder.position_at_end(block)

    # Calls.

    def _call_program(self, function: Any, arguments: Sequence) -> None:
        """Call a program, which is a function of its own."""
        self.has_loops = True
        program, width, names, scratch = function.program
        arrays = [argument for argument in arguments if isinstance(argument, Array)]
        if any(isinstance(step, int) and step != 1 for array in arrays for step in array.steps[-1:]):
            raise Untranslated("a program on every few numbers of an array")
        more: list = []
        if "memory" in names:  # a part of a wider array: the step from row to row is one more argument
            more = [arrays[names.index("memory")].steps[0]]
        if names == OF_MEMBERS:
            more = [arrays[names.index("table")].shape[1], arguments[-1]]
        called = self._functions.get(function)
        if called is not None:
            called.attributes.add("noinline")
        else:
            kind = ir.FunctionType(ir.VoidType(), [POINTER] * len(arrays) + [LONG] * len(more))
            called = new_function(self._builder.module, kind, "program")
            self._functions[function] = called
            if self._functions.programs_apart:
                called.attributes.add("noinline")
            builder, data = ir.IRBuilder(called.append_basic_block()), dict(zip(names, called.args, strict=False))
            if names == OF_MEMBERS:
                LoopWriter(None, builder, data, width, *called.args[-2:]).write(cut(program, scratch))
            else:
                writer = Writer(None, builder, data, width)
                writer.stride = called.args[-1]
                writer.write(program)
            builder.ret_void()
        self._builder.call(called, [*(array.pointer for array in arrays), *map(self.numbers.as_whole, more)])

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

    def _array_on_stack(self, count: int) -> Array:
        return self.array_at(self._slot(DOUBLE, max(count, 1)), (count,))

    def _new_array(self, shape: Any) -> Array:
        sizes, self._makes_arrays = shape if isinstance(shape, tuple) else (shape,), True
        self._makes_in_loop |= bool(self._ways_out)
        count = self._count(sizes)
        if not is_known(count) or count > LONGEST:
            return self._new_array_on_heap(sizes, count)
        array = self.array_at(self._slot(DOUBLE, max(count, 1)), sizes)
        for at in self._loop(0, count):
            self._builder.store(ir.Constant(DOUBLE, 0.0), self._behind(array.pointer, at), align=8)
        return array

    def _new_array_on_heap(self, sizes: tuple, count: Any) -> Array:
        """An array that is freed when the function ends, or another one takes its place."""
        slot, builder = self._slot(POINTER), self._builder
        with builder.goto_entry_block():
            builder.store(ir.Constant(POINTER, None), slot)
        self._on_heap.append(slot)
        builder.call(self._of_c("free"), [builder.load(slot, typ=POINTER)])
        pointer = builder.call(self._of_c("calloc"), [self.numbers.as_whole(count), ir.Constant(LONG, 8)])
        builder.store(pointer, slot)
        return self.array_at(pointer, sizes)

    def _of_c(self, name: str) -> ir.Function:
        kinds = {"calloc": (POINTER, [LONG, LONG]), "free": (ir.VoidType(), [POINTER])}[name]
        module = self._builder.module
        return module.globals.get(name) or ir.Function(module, ir.FunctionType(*kinds), name)

    def _fill_normals(self, out: Array, count: Any, *counter_and_key: Any) -> None:
        if out.steps != (1,):
            raise Untranslated("normals in a part of an array")
        self._functions.draws, module = True, self._builder.module
        kind = ir.FunctionType(ir.VoidType(), [POINTER, LONG, *[DOUBLE] * len(counter_and_key)])
        function = module.globals.get(FILL_NORMALS) or ir.Function(module, kind, FILL_NORMALS)
        numbers = self.numbers.as_whole(count), *map(self.numbers.as_float, counter_and_key)
        self._builder.call(function, [out.pointer, *numbers])

    def _count(self, shape: Sequence) -> Any:
        return reduce(lambda a, b: self.numbers.of_two("Mult", a, b), shape)

    def _length(self, value: Any) -> Any:
        return value.shape[0] if isinstance(value, Array) else len(value)


BUILTINS: dict[Any, Callable] = {
    np.zeros: Expressions._new_array,
    np.empty: Expressions._new_array,
    len: Expressions._length,
    fill_normals: Expressions._fill_normals,
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


def _from_the_end(bound: Any, size: Any, of_two: Callable) -> Any:
    """A known index or bound that is negative counts from the end; one that is not known must not be negative."""
    is_negative = isinstance(bound, int | np.integer) and bound < 0
    return of_two("Add", size, bound) if is_negative else bound


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
