"""Arrays of loops: their memory, their entries, and arithmetic entry by entry.

Memory of a known size that a function returns is its caller's, which is one more argument. Other memory is on the
stack as long as there is room, else on the heap, and freed where the function ends; what it returns of an unknown
size, its caller frees.
"""

from __future__ import annotations

import ctypes
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]

from thruster_env.graphs.arithmetic import Arithmetic, Untranslated, as_value, is_known
from thruster_env.graphs.forms import Array, is_tuple
from thruster_env.graphs.instructions import DOUBLE, LONG

LONGEST = 4096  # numbers of all arrays that a function makes for itself, on the stack
POINTER = DOUBLE.as_pointer()
INT, BYTES, INTS = ir.IntType(32), ir.IntType(8).as_pointer(), ir.IntType(32).as_pointer()
LAPACK = {  # dsyevd(job, triangle, n, a, n, values, work, its length, whole numbers, their length, error)
    "dsyevd": (ir.VoidType(), [BYTES, BYTES, INTS, POINTER, INTS, POINTER, POINTER, INTS, INTS, INTS, INTS]),
}
OF_C = {"malloc": (POINTER, [LONG]), "free": (ir.VoidType(), [POINTER]), **LAPACK}
"""Functions of C's library and of LAPACK: the result and the arguments."""


def of_lapack(name: str) -> int:
    """The address of a function of LAPACK, from SciPy, whose import takes a while."""
    from scipy.linalg import cython_lapack

    capsule = cython_lapack.__pyx_capi__[name]
    python, of = ctypes.pythonapi, ctypes.py_object
    name_of = ctypes.PYFUNCTYPE(ctypes.c_char_p, of)(("PyCapsule_GetName", python))
    address_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, of, ctypes.c_char_p)(("PyCapsule_GetPointer", python))
    return address_of(capsule, name_of(capsule))


class Memory:
    """Memory of an array that a function makes, or gets from a function that has made it.

    Attributes:
        pointer: to its first number.
        count: how many numbers it has; None if that is not known.
        has_name: whether a name stands for it, or for a tuple with it.
        changes: whether this name is assigned to several times, each time by a copy.
        is_copy: whether one of these was a copy of an argument.
    """

    def __init__(self, arrays: Arrays, count: Any = None, pointer: ir.Value | None = None):
        """Take a count, or a pointer to what another function has made."""
        builder = arrays._builder
        self.count = count if is_known(count) else None
        self.has_name = self.changes = self.is_copy = False
        self._slot: ir.Value | None = None
        if self.count is not None:
            self.pointer = arrays._slot(DOUBLE, max(count, 1))
        else:
            self._slot = arrays._slot(POINTER)
            with builder.goto_entry_block():
                builder.store(ir.Constant(POINTER, None), self._slot)
            self.free(arrays)
            size = None if pointer is not None else builder.mul(as_value(count), ir.Constant(LONG, 8))
            self.pointer = builder.call(arrays.of_c("malloc"), [size]) if pointer is None else pointer
            builder.store(self.pointer, self._slot)
        arrays._leads[self.pointer] = {self}
        arrays._made.append(self)

    def free(self, arrays: Arrays) -> None:
        """Free what is on the heap."""
        if self._slot is not None:
            arrays._builder.call(arrays.of_c("free"), [arrays._builder.load(self._slot, typ=POINTER)])

    def become_argument(self, function: ir.Function) -> None:
        """Lie where the caller of a function wants it."""
        argument = ir.Argument(function, POINTER)
        argument.add_attribute("noalias")
        function.args, function.ftype.args = (*function.args, argument), (*function.ftype.args, POINTER)
        self._become(function, ir.instructions.CastInstr(self.pointer.parent, "bitcast", argument, POINTER, ""))

    def become_of_heap(self, arrays: Arrays) -> None:
        """Lie on the heap from the beginning of a function to its end."""
        builder, function = arrays._builder, arrays._builder.function
        entry, size = self.pointer.parent, ir.Constant(LONG, 8 * (self.count or 0))
        allocation = ir.instructions.CallInstr(entry, arrays.of_c("malloc"), [size], "")
        self._become(function, allocation)
        with builder.goto_entry_block():
            self._slot = builder.alloca(POINTER)
            builder.store(self.pointer, self._slot)

    def _become(self, function: ir.Function, instruction: ir.Instruction) -> None:
        """Put another instruction in the place of the one that makes room on the stack."""
        instruction._name = self.pointer._name
        instructions = self.pointer.parent.instructions
        instructions[instructions.index(self.pointer)] = instruction
        self.pointer = instruction


class Arrays:
    """What a function does with arrays.

    Attributes:
        numbers: operations on numbers.
        wraps: whether an index that is not known may be negative and count from the end, or be none: of a user's.
    """

    has_loops: bool

    def __init__(self, builder: ir.IRBuilder, flags: frozenset[str]):
        self.numbers, self._builder, self.wraps = Arithmetic(builder, tuple(sorted(flags))), builder, False
        self._ways_out: list[tuple[ir.Block, ir.Block]] = []  # of loops: where `continue` and `break` lead
        self._made: list[Memory] = []
        # Of pointers: the memory to which they may lead, or ("argument", k).
        self._leads: defaultdict[ir.Value, set] = defaultdict(set)

    def _slot(self, kind: ir.Type, count: int = 1) -> ir.Value:
        with self._builder.goto_entry_block():
            return self._builder.alloca(kind, count)

    def of_c(self, name: str) -> ir.Function:
        """A function of OF_C."""
        module = self._builder.module
        return module.globals.get(name) or ir.Function(module, ir.FunctionType(*OF_C[name]), name)

    def array_at(self, pointer: ir.Value, shape: Sequence) -> Array:
        """An array in C order."""
        steps: list = [1]
        for size in reversed(shape[1:]):
            steps.insert(0, self.numbers.of_two("Mult", size, steps[0]))
        return Array(pointer, tuple(shape), tuple(steps[: len(shape)]))

    def _memory_of(self, value: Any) -> list[Memory]:
        """Memory of the function itself to which the arrays of a value lead."""
        if is_tuple(value):
            return [memory for part in value for memory in self._memory_of(part)]
        leads = self._leads[value.pointer] if isinstance(value, Array) else ()
        return [lead for lead in leads if isinstance(lead, Memory)]

    def arrange_memory(self, returned: Sequence[Sequence[ir.Value]]) -> tuple[list[int], list[set]]:
        """Decide where arrays lie that this function makes, for the numbers that each of its ends returns.

        Returns how many numbers each of those has that lie where the caller wants it, and of each number of the
        results where it leads: ("result", k), ("argument", k), or None to what the caller frees.
        """
        leads = [
            set[Any]().union(*map(self._leads.__getitem__, numbers)) for numbers in zip(*returned, strict=True)
        ]
        free = [
            lead for of_number in leads for lead in of_number if isinstance(lead, Memory) and lead.count is None
        ]
        pointers = [number for numbers in returned for number in numbers]
        if len({*free}) < len(free) or any(memory.pointer not in pointers for memory in free):
            raise Untranslated("a part of an array of unknown size, or two of them, as results")
        mixed = [of_number for of_number in leads if {*free} & of_number and len(of_number) > 1]
        if mixed:
            raise Untranslated("results of which one is made and another is not")
        results = [memory for memory in self._made if memory.count is not None and memory in set().union(*leads)]
        room = LONGEST
        for memory in self._made:
            if memory in results:
                memory.become_argument(self._builder.function)
            elif memory.count is not None:
                room -= memory.count
                if room < 0:
                    room += memory.count
                    memory.become_of_heap(self)

        def way(lead: Any) -> Any:
            if not isinstance(lead, Memory):
                return lead
            return ("result", results.index(lead)) if lead in results else None

        counts = [memory.count for memory in results if memory.count is not None]
        return counts, [set(map(way, of_number)) for of_number in leads]

    def free_all_but(self, numbers: Sequence[ir.Value]) -> None:
        """Free what is on the heap, at an end of the function that returns these numbers."""
        for memory in self._made:
            if memory.pointer not in numbers:
                memory.free(self)

    # Entries.

    def _part(self, value: Any, index: Any) -> Any:
        """An entry or a part of a tuple or an array; NaN at an index that is not within an array of a user's."""
        if not isinstance(value, Array):
            if not isinstance(value, tuple):
                raise Untranslated("an index")
            if is_known(index):
                return value[index]
            if is_known(value):
                return self._entry_of_known(value, index)
            value = self._copied(value)
        entry, within = self._entry(value, index)
        return entry if entry.shape else self._or_nan(within, self._load(entry))

    def _load(self, entry: Array) -> ir.Value:
        return self._builder.load(entry.pointer, align=8, typ=DOUBLE)

    def _or_nan(self, within: Any, value: ir.Value) -> ir.Value:
        """A number, or NaN if an index is not within its array."""
        return value if within is None else self._builder.select(within, value, ir.Constant(DOUBLE, math.nan))

    def _entry(self, array: Array, index: Any) -> tuple[Array, Any]:
        """What lies at an index of an array, which has no lengths if it is a number.

        Also whether the index lies within the array, or None if it must: else the entry is another one.
        """
        indices = list(index) if isinstance(index, tuple) else [index]
        if len(indices) > len(array.shape):
            raise Untranslated("more indices than an array has")
        indices += [slice(None)] * (len(array.shape) - len(indices))
        at, shape, steps, of_two, all_within = 0, [], [], self.numbers.of_two, None
        for part, size, step in zip(indices, array.shape, array.steps, strict=True):
            if isinstance(part, slice):
                first, stop = self._bounds(part, size)
                shape.append(of_two("Sub", stop, first))
                steps.append(step)
            else:
                first, within = self._within(part, size)
                if within is not None:
                    all_within = within if all_within is None else self._builder.and_(all_within, within)
            at = of_two("Add", at, of_two("Mult", first, step))
        return Array(self._behind(array.pointer, at), tuple(shape), tuple(steps)), all_within

    def _bounds(self, part: slice, size: Any) -> tuple[Any, Any]:
        """The first index of a slice, and the one after its last; in functions of users cut off as in Python."""
        if part.step is not None:
            raise Untranslated("a slice with a step")
        if all(map(is_known, (part.start, part.stop, size))):
            first, stop, _ = part.indices(size)
            return first, max(first, stop)
        first = 0 if part.start is None else self._from_the_end(part.start, size)
        stop = size if part.stop is None else self._from_the_end(part.stop, size)
        if self.wraps:
            least, most = (partial(self.numbers.extreme, name) for name in ("Lt", "Gt"))
            first = least(most(first, 0), size)
            stop = least(most(stop, first), size)
        return first, stop

    def _within(self, index: Any, size: Any) -> tuple[Any, Any]:
        """An index from the beginning, in functions of users 0 if it is not within; and whether it is, or None."""
        index = self._from_the_end(index, size)
        if not self.wraps:
            return index, None
        if is_known(index) and is_known(size):
            if not 0 <= index < size:
                raise Untranslated(f"the index {index} of {size} numbers")
            return index, None
        index, zero = self.numbers.as_whole(index), ir.Constant(LONG, 0)
        within = self._builder.icmp_unsigned("<", index, self.numbers.as_whole(size))
        return self._builder.select(within, index, zero), within

    def _at(self, array: Array, indices: tuple) -> Array:
        """The part of an array at indices of a loop over all of it."""
        count, of_two = len(indices), self.numbers.of_two
        at = reduce(partial(of_two, "Add"), map(partial(of_two, "Mult"), indices, array.steps), 0)
        return Array(self._behind(array.pointer, at), array.shape[count:], array.steps[count:])

    def _entry_of_known(self, values: tuple, index: Any) -> ir.Value:
        """An entry of a tuple of known numbers, at an index that is not known; NaN if it is not within.

        Of whole numbers it is the least one then, which is no index either.
        """
        numbers = [as_value(value) for value in values if is_known(value)]
        kind = DOUBLE if any(number.type == DOUBLE for number in numbers) else LONG
        if len(numbers) < len(values) or not values:
            raise Untranslated("an index")
        module = self._builder.module
        table = ir.GlobalVariable(module, ir.ArrayType(kind, len(values)), module.get_unique_name("known"))
        table.linkage, table.global_constant = "internal", True
        table.initializer = ir.Constant(table.value_type, [float(v) if kind == DOUBLE else int(v) for v in values])
        index, within = self._within(index, len(values))
        pointer = self._builder.gep(table, [ir.Constant(LONG, 0), self.numbers.as_whole(index)])
        value = self._builder.load(pointer, typ=kind)
        if kind == DOUBLE or within is None:
            return self._or_nan(within, value)
        return self._builder.select(within, value, ir.Constant(LONG, -(2**63)))

    def _from_the_end(self, bound: Any, size: Any) -> Any:
        """An index or a bound that counts from the beginning: a negative one counts from the end.

        One that is not known must not be negative, but in functions of users.
        """
        of_two = self.numbers.of_two
        if isinstance(bound, int | np.integer):
            return of_two("Add", size, bound) if bound < 0 else bound
        if not self.wraps or not isinstance(bound, ir.Value):
            return bound
        bound = self.numbers.as_whole(bound)
        return self._builder.select(of_two("Lt", bound, 0), of_two("Add", bound, size), bound)

    def _behind(self, pointer: ir.Value, count: Any) -> ir.Value:
        if is_known(count) and count == 0:
            return pointer
        behind = self._builder.gep(pointer, [self.numbers.as_whole(count)], source_etype=DOUBLE)
        self._leads[behind] = self._leads[pointer]
        return behind

    def _count(self, shape: Sequence) -> Any:
        return reduce(lambda a, b: self.numbers.of_two("Mult", a, b), shape)

    def _length(self, value: Any) -> Any:
        return value.shape[0] if isinstance(value, Array) else len(value)

    # New arrays.

    def _array_on_stack(self, count: int) -> Array:
        return self.array_at(Memory(self, count).pointer, (count,))

    def _new_array(self, shape: Any) -> Array:
        sizes = shape if isinstance(shape, tuple) else (shape,)
        return self.array_at(Memory(self, self._count(sizes)).pointer, sizes)

    def _full(self, shape: Any, value: Any) -> Array:
        if as_value(value).type != DOUBLE:
            raise Untranslated("an array of whole numbers")
        return self._filled(self._new_array(shape), value)

    def _zeros(self, shape: Any) -> Array:
        return self._full(shape, 0.0)

    def _identity(self, size: Any) -> Array:
        out = self._zeros((size, size))
        step = size + 1 if isinstance(size, int) else self._builder.add(as_value(size), as_value(1))
        self._fill(Array(out.pointer, (size,), (step,)), 1.0)
        return out

    def _copied(self, values: Any) -> Array:
        """A new array with the numbers of another, or of a tuple."""
        if isinstance(values, Array):
            return self._filled(self._new_array(values.shape), values)
        if not is_tuple(values):
            raise Untranslated("an array of what is no tuple")
        shape: tuple = (len(values),)
        if values and is_tuple(values[0]):
            shape = len(values), len(values[0])
        entries = [entry for part in values for entry in (part if len(shape) == 2 else (part,))]
        if not any(not is_tuple(entry) and as_value(entry).type == DOUBLE for entry in entries):
            raise Untranslated("an array of whole numbers")
        return self._filled(self._new_array(shape), values)

    def _filled(self, out: Array, values: Any) -> Array:
        self._fill(out, values)
        return out

    def _fill(self, out: Array, values: Any) -> None:
        """Copy numbers into an array: those of a tuple or of an array, or one."""
        if is_tuple(values):
            if out.shape[0] != len(values) if is_known(out.shape[0]) else self.wraps:
                raise Untranslated("numbers of another shape than their array")
            for k, part in enumerate(values):
                self._fill(self._at(out, (k,)), part)
            return
        if isinstance(values, Array) and not self._is_apart(out, values):
            values = self._copied(values)
        self._common_shape(out, values)
        shape = out.shape
        for indices in self._indices(shape):
            self._put(self._at(out, indices), self._number_at(values, indices, shape))

    def _put(self, entry: Array, number: Any) -> None:
        self._builder.store(self.numbers.as_float(number), entry.pointer, align=8)

    def _is_apart(self, out: Array, values: Array) -> bool:
        """Whether two arrays have no memory in common, for sure, or are one."""
        first, second = (self._leads[array.pointer] for array in (out, values))
        new = [all(isinstance(lead, Memory) for lead in leads) and bool(leads) for leads in (first, second)]
        return out.pointer is values.pointer and out.steps == values.steps or any(new) and not first & second

    def _by_entries(self, function: Callable, *values: Any) -> Array:
        """The array of a function's values for the entries of arrays, and for numbers."""
        shape = self._common_shape(*values)
        out = self._new_array(shape)
        for indices in self._indices(shape):
            numbers = (self._number_at(value, indices, shape) for value in values)
            self._put(self._at(out, indices), function(*numbers))
        return out

    def _common_shape(self, *values: Any) -> tuple:
        shapes = [value.shape for value in values if isinstance(value, Array)]
        if any(map(is_tuple, values)) or any(len(shape) != len(shapes[0]) for shape in shapes):
            raise Untranslated("arithmetic of arrays of different kinds")
        for sizes in zip(*shapes, strict=True):
            if len({size for size in sizes if is_known(size)}) > 1:
                raise Untranslated("arithmetic of arrays of different shapes")
        if self.wraps:  # the others may have one number, for all
            return tuple(next(filter(is_known, sizes), sizes[0]) for sizes in zip(*shapes, strict=True))
        return shapes[0]

    def _indices(self, shape: Sequence) -> Iterator[tuple]:
        """The indices of an array, once, in loops."""
        if not shape:
            yield ()
            return
        for first in self._loop(0, shape[0]):
            for rest in self._indices(shape[1:]):
                yield (first, *rest)

    def _number_at(self, value: Any, indices: tuple, shape: tuple) -> Any:
        """A number, or an array's at indices of a shape; NaN in a user's function if its shape does not fit."""
        if not isinstance(value, Array):
            return value
        within, builder, of_two = None, self._builder, self.numbers.of_two
        if self.wraps:
            for k, (size, other) in enumerate(zip(value.shape, shape, strict=True)):
                if size is not other and not is_known((size, other)):
                    alike, zero = of_two("Eq", size, other), ir.Constant(LONG, 0)
                    indices = (*indices[:k], builder.select(alike, indices[k], zero), *indices[k + 1 :])
                    fits = builder.or_(alike, self.numbers.truth(of_two("Eq", size, 1)))  # one counts for all
                    within = fits if within is None else builder.and_(within, fits)
        return self._or_nan(within, self._load(self._at(value, indices)))

    def _eigenvectors(self, a: Array) -> tuple[Array, Array]:
        """NumPy's `eigh`, by the same function of LAPACK, on the lower triangle; columns follow one another."""
        n, builder, of_two = a.shape[0], self._builder, self.numbers.of_two
        vectors, values = self._copied(Array(a.pointer, a.shape[::-1], a.steps[::-1])), self._new_array(n)
        count = of_two("Add", of_two("Mult", 5, n), 3)
        length = of_two("Add", of_two("Mult", 2, of_two("Mult", n, n)), of_two("Add", of_two("Mult", 6, n), 1))
        work, whole_work = self._new_array(length), self._new_array(count)
        sizes = [self._slot(INT) for _ in range(4)]
        for slot, size in zip(sizes, (n, length, count, 0), strict=True):
            builder.store(builder.trunc(as_value(size), INT), slot)
        letters = [self._slot(ir.IntType(8)) for _ in "VL"]
        for slot, letter in zip(letters, "VL", strict=True):
            builder.store(ir.Constant(ir.IntType(8), ord(letter)), slot)
        of_n, of_length, of_whole, error = sizes
        ints = builder.bitcast(whole_work.pointer, INTS)
        arguments = [
            *letters,
            of_n,
            vectors.pointer,
            of_n,
            values.pointer,
            work.pointer,
            of_length,
            ints,
            of_whole,
        ]
        builder.call(self.of_c("dsyevd"), [*arguments, error])
        return values, Array(vectors.pointer, vectors.shape, vectors.steps[::-1])

    # Loops.

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
