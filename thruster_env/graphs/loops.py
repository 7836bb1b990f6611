"""The loops around programs as instructions of LLVM: a small part of Python, read from a function's source.

    for k in range(steps):                      for, while, if, else, conditional expressions
        for g in range(groups):                 whole numbers, floats, arrays of floats, their lengths, parts
            update(rows[g], zs[g], numbers)     calls of programs, a few builtin functions, and such functions
        if not total < LARGEST:
            restart((belief, None, None), numbers, 0)

What a function has in its closure is known when it is translated, so sizes are constants, and functions that it
calls become part of it. Whatever else it contains raises `Untranslated`; numba then compiles it. The same function
runs as Python.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import operator
import textwrap
import types
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]

from thruster_env.graphs.instructions import DOUBLE, FLAGS, LONG, Writer
from thruster_env.graphs.machine_code import Code, NotLinked, add_builtin, code_of

BOOL = ir.IntType(1)
LONGEST = 4096  # numbers of an array that a function makes for itself, on the stack
OF_KNOWN = {"Add": operator.add, "Sub": operator.sub, "Mult": operator.mul}  # of numbers that are known
OF_WHOLE = {"Add": "add", "Sub": "sub", "Mult": "mul", "BitAnd": "and_"}
OF_FLOATS = {"Add": "fadd", "Sub": "fsub", "Mult": "fmul", "Div": "fdiv"}
COMPARISONS = {"Lt": "<", "LtE": "<=", "Gt": ">", "GtE": ">=", "Eq": "==", "NotEq": "!="}


class Untranslated(TypeError):
    """A function has what cannot be translated."""


class Array(NamedTuple):
    """An array of float64: the address of its first number, its lengths, and the steps along them, in numbers."""

    pointer: ir.Value
    shape: tuple
    steps: tuple


def machine_code_of(function: Callable, shapes: Sequence, *, as_builtin: bool = False) -> Code | None:
    """Machine code of a function, or None if it cannot be translated or linked; see `add_function`.

    Called from Python as a builtin function it has the last argument of the function; the words have the others.
    """
    module = ir.Module()
    try:
        entry, word_count = add_function(module, "run", function, shapes)
    except TypeError:
        return None
    if as_builtin:
        add_builtin(module, "call", entry, word_count - 1)
    try:
        return code_of(module, "call" if as_builtin else "run")
    except NotLinked:  # numba brings the function that is lacking
        return None


def add_function(module: ir.Module, name: str, function: Callable, shapes: Sequence) -> tuple[ir.Function, int]:
    """Add `i64 name(words)`, a Python function of arrays and whole numbers; return it and its number of words.

    It returns 0 where Python returns nothing.

    Args:
        module: to which it is added.
        name: of the function.
        function: of Python.
        shapes: of its arguments: of an array its lengths, None for those that a call tells; None for a whole
            number; a list for a tuple of such. The words are those of `machine_code.words_of`.

    Raises:
        TypeError: if it contains what cannot be translated.
    """
    target = ir.Function(module, ir.FunctionType(LONG, [LONG.as_pointer()]), name)
    builder, word = ir.IRBuilder(target.append_basic_block("entry")), 0

    def next_word() -> ir.Value:
        nonlocal word
        pointer, word = builder.gep(target.args[0], [ir.Constant(LONG, word)], source_etype=LONG), word + 1
        return builder.load(pointer, typ=LONG)

    def argument_of(shape: Any) -> Any:
        if shape is None:
            return next_word()
        if isinstance(shape, list):
            return tuple(map(argument_of, shape))
        pointer, lengths = builder.inttoptr(next_word(), DOUBLE.as_pointer()), [next_word() for _ in shape]
        lengths = [b if a is None else a for a, b in zip(shape, lengths, strict=True)]
        return translator.array_at(pointer, lengths)

    translator = _Translator(builder, {})
    arguments = [argument_of(shape) for shape in shapes]
    body = builder.append_basic_block("body")
    builder.branch(body)
    builder.position_at_end(body)
    result = translator.call(function, arguments)
    builder.ret(ir.Constant(LONG, 0) if result is None else _whole(builder, result))
    return target, word


class _Translator:
    """Translates a call: names stand for values of LLVM, arrays, tuples, or objects of Python that are known."""

    def __init__(self, builder: ir.IRBuilder, programs: dict):
        self._builder, self._programs = builder, programs
        self._names: dict[str, Any] = {}
        self._slots: dict[str, tuple[ir.Value, ir.Type]] = {}  # of numbers that change
        self._changing: set[str] = set()
        self._function: Any = None
        self._result: Any = None  # of a function with several returns: its slot, and the block behind them

    def call(self, function: Any, arguments: Sequence) -> Any:
        """Translate a call of a function with these arguments; return its result."""
        if hasattr(function, "program"):
            return self._call_program(function, arguments)
        if function in BUILTINS:
            return BUILTINS[function](self, *arguments)
        if not isinstance(function, types.FunctionType):
            raise Untranslated(f"a call of {function!r}")
        return _Translator(self._builder, self._programs)._body(function, arguments)

    def array_at(self, pointer: ir.Value, shape: Sequence) -> Array:
        """An array in C order."""
        steps: list = [1]
        for size in reversed(shape[1:]):
            steps.insert(0, self._of_two("Mult", size, steps[0]))
        return Array(pointer, tuple(shape), tuple(steps[: len(shape)]))

    def _body(self, function: types.FunctionType, arguments: Sequence) -> Any:
        node, self._function = _definition(function), function
        self._names = dict(zip((argument.arg for argument in node.args.args), arguments, strict=True))
        counts = Counter(name for part in ast.walk(node) for name in _assigned(part))
        self._changing = {name for name, count in counts.items() if count > 1}
        *body, last = node.body
        if any(isinstance(part, ast.Return) for statement in body for part in ast.walk(statement)):
            self._result = self._slot(LONG), self._builder.append_basic_block("end")
            self._statements(node.body)
            self._builder.branch(self._result[1])
            self._builder.position_at_end(self._result[1])
            return self._builder.load(self._result[0], typ=LONG)
        self._statements(body)
        if isinstance(last, ast.Return):
            return self._value(last.value)
        return self._statements([last])

    def _statements(self, body: Sequence[ast.stmt]) -> None:
        for statement in body:
            self._translated(statement)

    def _value(self, node: ast.expr | None) -> Any:
        return self._translated(node)

    def _translated(self, node: ast.AST | None) -> Any:
        translate = getattr(self, f"_{type(node).__name__.lower()}", None)
        if translate is None:
            raise Untranslated(f"{type(node).__name__} in {self._function.__name__}")
        return translate(node)

    # Statements.

    def _expr(self, statement: ast.Expr) -> None:
        self._value(statement.value)

    def _return(self, statement: ast.Return) -> None:
        slot, end = self._result
        self._builder.store(_whole(self._builder, self._value(statement.value)), slot)
        self._builder.branch(end)
        self._builder.position_at_end(self._builder.append_basic_block("never"))

    def _assign(self, statement: ast.Assign) -> None:
        for target in statement.targets:
            self._store(target, self._value(statement.value))

    def _augassign(self, statement: ast.AugAssign) -> None:
        self._store(statement.target, self._value(ast.BinOp(statement.target, statement.op, statement.value)))

    def _store(self, target: ast.expr, value: Any) -> None:
        builder = self._builder
        if isinstance(target, ast.Tuple):
            for part, entry in zip(target.elts, value, strict=True):
                self._store(part, entry)
        elif isinstance(target, ast.Subscript):
            entry = self._entry(self._value(target.value), self._value(target.slice))
            if entry.shape:
                raise Untranslated("an assignment to a part of an array")
            builder.store(_float(builder, value), entry.pointer, align=8)
        elif not isinstance(target, ast.Name):
            raise Untranslated("an assignment")
        elif target.id in self._changing:
            value = _as_value(value)
            if target.id not in self._slots:
                kind = DOUBLE if value.type == DOUBLE else LONG
                self._slots[target.id] = self._slot(kind), kind
            slot, kind = self._slots[target.id]
            builder.store(_float(builder, value) if kind == DOUBLE else _whole(builder, value), slot)
        else:
            self._names[target.id] = value

    def _if(self, statement: ast.If) -> None:
        with self._builder.if_else(self._truth(statement.test)) as (then, otherwise):
            with then:
                self._statements(statement.body)
            with otherwise:
                self._statements(statement.orelse)

    def _for(self, statement: ast.For) -> None:
        source, target = statement.iter, statement.target
        if not isinstance(source, ast.Call) or self._value(source.func) is not range:
            raise Untranslated("a loop that is over no range")
        if not isinstance(target, ast.Name) or statement.orelse:
            raise Untranslated("a loop with several names or an else")
        bounds = [self._value(argument) for argument in source.args]
        first, stop, step = (0, *bounds, 1) if len(bounds) == 1 else (*bounds, 1)[:3]
        for at in self._loop(first, stop, step):
            self._names[target.id] = at
            self._statements(statement.body)

    def _while(self, statement: ast.While) -> None:
        if statement.orelse:
            raise Untranslated("a loop with an else")
        builder = self._builder
        head, inside, after = (builder.append_basic_block(name) for name in ("head", "inside", "after"))
        builder.branch(head)
        builder.position_at_end(head)
        builder.cbranch(self._truth(statement.test), inside, after)
        builder.position_at_end(inside)
        self._statements(statement.body)
        builder.branch(head)
        builder.position_at_end(after)

    def _loop(self, first: Any, stop: Any, step: Any = 1) -> Iterator[ir.Value]:
        """The index of a loop, once: what is translated meanwhile is its body."""
        builder, before = self._builder, self._builder.block
        head, inside, after = (builder.append_basic_block(name) for name in ("head", "inside", "after"))
        stop, step = _as_value(stop), _as_value(step)
        builder.branch(head)
        builder.position_at_end(head)
        at = builder.phi(LONG)
        at.add_incoming(_as_value(first), before)
        descends = isinstance(step, ir.Constant) and step.constant < 0
        builder.cbranch(builder.icmp_signed(">" if descends else "<", at, stop), inside, after)
        builder.position_at_end(inside)
        yield at
        at.add_incoming(builder.add(at, step, flags=("nsw",)), builder.block)
        builder.branch(head)
        builder.position_at_end(after)

    def _slot(self, kind: ir.Type, count: int = 1) -> ir.Value:
        with self._builder.goto_entry_block():
            return self._builder.alloca(kind, count)

    # Expressions.

    def _constant(self, node: ast.Constant) -> Any:
        return node.value

    def _name(self, node: ast.Name) -> Any:
        if node.id in self._slots:
            slot, kind = self._slots[node.id]
            return self._builder.load(slot, typ=kind)
        function = self._function
        cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
        if node.id in self._names:
            return self._names[node.id]
        if node.id in cells:
            return cells[node.id].cell_contents
        return function.__globals__[node.id] if node.id in function.__globals__ else getattr(builtins, node.id)

    def _attribute(self, node: ast.Attribute) -> Any:
        value = self._value(node.value)
        if isinstance(value, types.ModuleType) or isinstance(value, Array) and node.attr == "shape":
            return getattr(value, node.attr)
        raise Untranslated(f"the attribute {node.attr}")

    def _tuple(self, node: ast.Tuple) -> tuple:
        return tuple(self._value(part) for part in node.elts)

    def _call(self, node: ast.Call) -> Any:
        if node.keywords:
            raise Untranslated("arguments by name")
        return self.call(self._value(node.func), [self._value(argument) for argument in node.args])

    def _binop(self, node: ast.BinOp) -> Any:
        return self._of_two(type(node.op).__name__, self._value(node.left), self._value(node.right))

    def _of_two(self, name: str, a: Any, b: Any) -> Any:
        if isinstance(a, (int, float)) and isinstance(b, (int, float)) and name in OF_KNOWN:
            return OF_KNOWN[name](a, b)
        a, b, builder = _as_value(a), _as_value(b), self._builder
        if DOUBLE not in (a.type, b.type) and name in (*OF_WHOLE, "FloorDiv", "Mod"):
            a, b = _whole(builder, a), _whole(builder, b)
            return getattr(builder, OF_WHOLE[name])(a, b) if name in OF_WHOLE else self._divided(name, a, b)
        if name not in OF_FLOATS:
            raise Untranslated(f"{name} of two numbers")
        return getattr(builder, OF_FLOATS[name])(_float(builder, a), _float(builder, b), flags=FLAGS)

    def _divided(self, name: str, a: ir.Value, b: ir.Value) -> ir.Value:
        """Python's `//` or `%`: LLVM rounds towards zero, Python down, and its remainder has the sign of b."""
        builder, zero = self._builder, ir.Constant(LONG, 0)
        rest = builder.srem(a, b)
        rounded_up = builder.and_(
            builder.icmp_signed("!=", rest, zero), builder.icmp_signed("<", builder.xor(rest, b), zero)
        )
        if name == "Mod":
            return builder.add(rest, builder.select(rounded_up, b, zero))
        return builder.sub(builder.sdiv(a, b), builder.zext(rounded_up, LONG))

    def _unaryop(self, node: ast.UnaryOp) -> Any:
        if isinstance(node.op, ast.Not):
            return self._builder.not_(self._truth(node.operand))
        if not isinstance(node.op, ast.USub):
            raise Untranslated("an operator")
        return self._of_two("Sub", 0, self._value(node.operand))

    def _compare(self, node: ast.Compare) -> ir.Value:
        name, builder = type(node.ops[0]).__name__, self._builder
        if len(node.ops) != 1 or name not in COMPARISONS:
            raise Untranslated("a comparison")
        a, b = _as_value(self._value(node.left)), _as_value(self._value(node.comparators[0]))
        if DOUBLE not in (a.type, b.type):
            return builder.icmp_signed(COMPARISONS[name], _whole(builder, a), _whole(builder, b))
        compare = builder.fcmp_unordered if name == "NotEq" else builder.fcmp_ordered
        return compare(COMPARISONS[name], _float(builder, a), _float(builder, b))

    def _boolop(self, node: ast.BoolOp) -> ir.Value:
        combine = self._builder.and_ if isinstance(node.op, ast.And) else self._builder.or_
        return reduce(combine, [self._truth(value) for value in node.values])  # all of them: they have no effects

    def _ifexp(self, node: ast.IfExp) -> ir.Value:
        test, a, b = self._truth(node.test), _as_value(self._value(node.body)), _as_value(self._value(node.orelse))
        if DOUBLE in (a.type, b.type):
            a, b = _float(self._builder, a), _float(self._builder, b)
        return self._builder.select(test, a, b)

    def _truth(self, node: ast.expr) -> ir.Value:
        value = _as_value(self._value(node))
        if value.type == DOUBLE:
            return self._builder.fcmp_unordered("!=", value, ir.Constant(DOUBLE, 0.0))
        return value if value.type == BOOL else self._builder.icmp_signed("!=", value, ir.Constant(LONG, 0))

    def _slice(self, node: ast.Slice) -> slice:
        return slice(*(part and self._value(part) for part in (node.lower, node.upper, node.step)))

    def _subscript(self, node: ast.Subscript) -> Any:
        entry = self._entry(self._value(node.value), self._value(node.slice))
        if isinstance(entry, Array) and not entry.shape:
            return self._builder.load(entry.pointer, align=8, typ=DOUBLE)
        return entry

    def _entry(self, value: Any, index: Any) -> Any:
        """What lies at an index: a tuple's entry, or an array's part, which has no lengths if it is a number."""
        if not isinstance(value, Array):
            if isinstance(value, tuple) and isinstance(index, int):
                return value[index]
            raise Untranslated("an index")
        indices = list(index) if isinstance(index, tuple) else [index]
        indices += [slice(None)] * (len(value.shape) - len(indices))
        at, shape, steps = 0, [], []
        for part, size, step in zip(indices, value.shape, value.steps, strict=True):
            if isinstance(part, slice):
                if part.step is not None:
                    raise Untranslated("a slice with a step")
                part, stop = part.start or 0, size if part.stop is None else part.stop
                shape.append(self._of_two("Sub", stop, part))
                steps.append(step)
            at = self._of_two("Add", at, self._of_two("Mult", part, step))
        return Array(self._behind(value.pointer, at), tuple(shape), tuple(steps))

    def _behind(self, pointer: ir.Value, count: Any) -> ir.Value:
        return self._builder.gep(pointer, [_as_value(count)], source_etype=DOUBLE)

    # Calls.

    def _call_program(self, function: Any, arrays: Sequence[Array]) -> None:
        """Call a program, which is a function of its own: within a loop it would take other last digits."""
        program, width, names, _ = function.program
        called = self._programs.get(function)
        of_copies = "memory" in names  # a part of a wider array: the step from row to row is one more argument
        if called is None:
            pointers, steps = [DOUBLE.as_pointer()] * len(names), [LONG] * of_copies
            kind = ir.FunctionType(ir.VoidType(), pointers + steps)
            called = ir.Function(self._builder.module, kind, f"program_{len(self._programs)}")
            called.linkage, self._programs[function] = "internal", called
            called.attributes.add("noinline")
            builder = ir.IRBuilder(called.append_basic_block())
            writer = Writer(None, builder, dict(zip(names, called.args, strict=False)), width)
            writer.stride = called.args[-1]
            writer.write(program)
            builder.ret_void()
        strides = [_as_value(arrays[names.index("memory")].steps[0])] if of_copies else []
        self._builder.call(called, [*(array.pointer for array in arrays), *strides])

    def _new_array(self, shape: Any) -> Array:
        sizes = shape if isinstance(shape, tuple) else (shape,)
        if not all(isinstance(size, int) for size in sizes) or np.prod(sizes) > LONGEST:
            raise Untranslated("an array whose size is not known, or a large one")
        count = int(np.prod(sizes))
        array = self.array_at(self._slot(DOUBLE, max(count, 1)), sizes)
        for at in self._loop(0, count):
            self._builder.store(ir.Constant(DOUBLE, 0.0), self._behind(array.pointer, at), align=8)
        return array

    def _as_whole(self, x: Any) -> ir.Value:
        x = _as_value(x)
        return self._builder.fptosi(x, LONG) if x.type == DOUBLE else _whole(self._builder, x)

    def _least(self, a: Any, b: Any) -> ir.Value:
        a, b = _whole(self._builder, a), _whole(self._builder, b)
        return self._builder.select(self._builder.icmp_signed("<", b, a), b, a)

    def _of_llvm(self, name: str, x: Any) -> ir.Value:
        function = self._builder.module.declare_intrinsic(f"llvm.{name}", [DOUBLE])
        return self._builder.call(function, [_float(self._builder, x)], fastmath=FLAGS)


BUILTINS: dict[Any, Callable] = {
    np.zeros: _Translator._new_array,
    np.empty: _Translator._new_array,
    int: _Translator._as_whole,
    min: _Translator._least,
    abs: lambda translator, x: translator._of_llvm("fabs", x),
}


def _definition(function: types.FunctionType) -> ast.FunctionDef:
    try:
        node = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    except (OSError, SyntaxError):
        raise Untranslated(f"the source of {function.__name__} cannot be read") from None
    if not isinstance(node, ast.FunctionDef):
        raise Untranslated(f"{function.__name__} is no plain function")
    return node


def _assigned(node: ast.AST) -> list[str]:
    """Names to which a statement assigns numbers, twice if it changes them in place."""
    if isinstance(node, ast.AugAssign):
        return [node.target.id] * 2 if isinstance(node.target, ast.Name) else []
    targets = node.targets if isinstance(node, ast.Assign) else []
    names = [part for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
    return [name.id for name in names if isinstance(name.ctx, ast.Store) and name.id != "_"]


def _as_value(value: Any) -> ir.Value:
    if isinstance(value, ir.Value):
        return value
    for kind, known in ((BOOL, bool), (LONG, int), (DOUBLE, float)):
        if isinstance(value, known):
            return ir.Constant(kind, value)
    raise Untranslated(f"a number must be known, or one of LLVM, but got {value!r}")


def _float(builder: ir.IRBuilder, value: Any) -> ir.Value:
    value = _as_value(float(value) if isinstance(value, int) else value)
    return value if value.type == DOUBLE else builder.sitofp(_whole(builder, value), DOUBLE)


def _whole(builder: ir.IRBuilder, value: Any) -> ir.Value:
    value = _as_value(value)
    if value.type == DOUBLE:
        raise Untranslated("a float in the place of a whole number")
    return builder.zext(value, LONG) if value.type == BOOL else value
