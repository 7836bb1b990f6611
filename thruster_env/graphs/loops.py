"""A program with numbers of each member of an ensemble, cut into loops over the members.

Numbers that are the same for all members are evaluated once. A sum over members (`graphs.over_members`) ends a
loop: numbers that depend on it belong to the next turn.

    turn 0   y = h(x),  the sum of y                               a loop
             mean = sum/size                                       once
    turn 1   the sum of (y - mean)^2                               a loop
    ...

A loop evaluates a few sums at a time, so that these stay in registers. If a later loop needs a member's number,
too, it evaluates it again if that takes one operation on numbers of the table; else the table keeps it in a row.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from thruster_env.graphs.graphs import REDUCTIONS, Number, needed_by
from thruster_env.graphs.programs import BY_MEMBERS, Place, Program

SUMS = 16  # of one loop: as many vectors, with their terms, fit into the registers

Loop = tuple[int, int]  # its turn, and which one it is in that


class Body(NamedTuple):
    """What a loop does for each member."""

    reads: list[tuple[Place, Number]]
    works: list[Number]
    stores: list[tuple[Place, Number]]
    sums: list[Number]


class Turn(NamedTuple):
    """Numbers that are the same for all members, and the loops that follow."""

    works: list[Number]
    bodies: list[Body]


class Cut(NamedTuple):
    """A program as turns.

    Attributes:
        reads: numbers that are the same for all members, read first.
        turns: the turns in their order.
        stores: of numbers that are the same for all members, last.
        rows: how many rows of the table it uses.
    """

    reads: list[tuple[Place, Number]]
    turns: list[Turn]
    stores: list[tuple[Place, Number]]
    rows: int


def cut(program: Program, scratch: int) -> Cut:
    """A program cut into loops, which keep numbers of members in rows of the table from `scratch` on."""
    outputs = {target: number for target, number in program.stores if target.array in BY_MEMBERS}
    outputs = {target: number for target, number in outputs.items() if number.arguments != (target,)}
    cutter = _Cutter(program, outputs, scratch)
    while late := cutter.overwritten:  # places that are written too early
        cutter = _Cutter(program, outputs, scratch, cutter.late | late)
    return cutter.cut()


class _Cutter:
    """Assigns numbers to loops."""

    def __init__(
        self, program: Program, outputs: Mapping[Place, Number], scratch: int, late: frozenset[Place] = frozenset()
    ):
        self._program, self._scratch, self.late = program, scratch, late
        self._outputs = outputs
        self._numbers = {
            number.place: number for number in [*(number for _, number in program.reads), *program.works]
        }
        self._turn: dict[int, int] = {}
        for k, number in self._numbers.items():
            self._turn[k] = max((self._turn[a.place] for a in number.of), default=0) + (
                number.operation in REDUCTIONS
            )
        self._last = max(self._turn.values(), default=0)
        self._loops: dict[Loop, list[Number]] = {}
        for turn in range(self._last + 1):
            self._add_loops(turn)
        self._end = self._last + 1, 0
        if late:
            self._loops[self._end] = []
        self._made: dict[int, Loop] = {}  # the loop that evaluates a member's number first
        self._rows: dict[
            int, tuple[Loop, Place]
        ] = {}  # rows of the table: the number's place in the graph -> first loop, place
        self.overwritten: frozenset[Place] = frozenset()
        for target, number in outputs.items():
            if number.member and number.operation != "given" and target not in late:
                self._rows.setdefault(number.place, (self._home(number), target))
        for target in late:
            self._keep(outputs[target])
        row_count = -1
        while row_count < len(self._rows) and not self.overwritten:
            row_count = len(self._rows)
            for loop in self._loops:
                self._members_of(loop)

    def _add_loops(self, turn: int) -> None:
        sums = [
            number
            for number in self._numbers.values()
            if number.operation in REDUCTIONS and self._turn[number.place] == turn + 1
        ]
        for k in range(0, max(len(sums), 1), SUMS):
            self._loops[turn, k // SUMS] = sums[k : k + SUMS]

    def _home(self, number: Number) -> Loop:
        return self._turn[number.place], 0

    def _keep(self, number: Number) -> None:
        if number.member and number.operation != "given" and number.place not in self._rows:
            self._rows[number.place] = (
                self._made.get(number.place, self._home(number)),
                Place("table", self._scratch),
            )
            self._scratch += 1

    def _stores(self, loop: Loop) -> list[tuple[Place, Number]]:
        if loop == self._end:
            return [(target, self._outputs[target]) for target in sorted(self.late)]
        stores = [(target, self._numbers[k]) for k, (home, target) in self._rows.items() if home == loop]
        known = {target for target, _ in stores}
        return stores + [
            (target, number)
            for target, number in self._outputs.items()
            if target not in known and target not in self.late and self._home(number) == loop
        ]

    def _place_of(self, number: Number, loop: Loop) -> Place | None:
        """Where a member's number lies when a loop begins."""
        if number.operation == "given":
            location = number.arguments[0]
            written = self._outputs.get(location)
            if written is not None and location not in self.late and self._home(written) < loop:
                self.overwritten |= {location}
            return location
        home, location = self._rows.get(number.place, (loop, None))
        return location if home < loop else None

    def _members_of(self, loop: Loop) -> tuple[list[Number], list[tuple[Place, Number]]]:
        """Numbers that a loop reads or evaluates, and its stores; earlier loops keep what it lacks."""
        stores = self._stores(loop)
        wanted = [number for _, number in stores] + [number.of[0] for number in self._loops[loop]]
        wanted_indices = {number.place for number in wanted}

        cutter = self

        class Known:
            """Numbers whose arguments do not matter: they are the same for all members, or lie in the table."""

            def __contains__(self, index) -> bool:
                number = cutter._numbers[index]
                if not number.member or cutter._place_of(number, loop):
                    return True
                if index in wanted_indices or cutter._made.get(index, loop) >= loop:
                    return False
                if all(not a.member or cutter._place_of(a, loop) for a in number.of):
                    return False  # one operation, done again
                cutter._keep(number)
                return True

        members = [number for number in needed_by(wanted, Known()) if number.member]
        for number in members:
            self._made.setdefault(number.place, loop)
        return members, stores

    def cut(self) -> Cut:
        """All turns."""
        turns = []
        for turn in range(self._last + 1 + bool(self.late)):
            works = [
                number for number in self._program.works if not number.member and self._turn[number.place] == turn
            ]
            bodies = [self._body(loop) for loop in self._loops if loop[0] == turn]
            turns.append(Turn(works, [body for body in bodies if body.stores or body.sums]))
        reads = [(source, number) for source, number in self._program.reads if not number.member]
        stores = [(target, number) for target, number in self._program.stores if target.array not in BY_MEMBERS]
        return Cut(reads, turns, stores, self._scratch)

    def _body(self, loop: Loop) -> Body:
        numbers, stores = self._members_of(loop)
        located = [(self._place_of(number, loop), number) for number in numbers]
        reads = [(source, number) for source, number in located if source is not None]
        return Body(reads, [number for source, number in located if source is None], stores, self._loops[loop])
