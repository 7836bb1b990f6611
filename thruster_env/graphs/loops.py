"""A program in which members of an ensemble have numbers of their own, cut into loops over these members.

What is the same for all members is worked out once. A sum over members (`graphs.over_members`) ends a loop: what
depends on it comes after, and belongs to the next turn.

    turn 0   y = h(x),  the sum of y                               a loop
             mean = sum/size                                       once
    turn 1   the sum of (y - mean)^2                               a loop
    ...

A loop works out a few sums at a time, so that these stay in registers. What a later loop needs of a member, too,
it works out again if that is one operation on what lies in the table; else the number is kept there, in a row of
its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from thruster_env.graphs.graphs import REDUCTIONS, Number, needed_by
from thruster_env.graphs.programs import BY_MEMBERS, Place, Program

SUMS = 16  # of one loop: as many vectors, and what they are made of, fit into the registers

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
        reads: numbers that are the same for all members, read at first.
        turns: what is done, in this order.
        stores: of such numbers, at last.
        rows: how many rows of the table it uses.
    """

    reads: list[tuple[Place, Number]]
    turns: list[Turn]
    stores: list[tuple[Place, Number]]
    rows: int


def cut(program: Program, scratch: int) -> Cut:
    """A program cut into loops, which keep numbers of members in rows of the table from `scratch` on."""
    outputs = {place: one for place, one in program.stores if place.array in BY_MEMBERS}
    outputs = {place: one for place, one in outputs.items() if one.arguments != (place,)}
    found = _Cutter(program, outputs, scratch)
    while late := found.overwritten:  # places that are written too early
        found = _Cutter(program, outputs, scratch, found.late | late)
    return found.cut()


class _Cutter:
    """Decides what is worked out in which loop."""

    def __init__(
        self, program: Program, outputs: Mapping[Place, Number], scratch: int, late: frozenset[Place] = frozenset()
    ):
        self._program, self._scratch, self.late = program, scratch, late
        self._outputs = outputs
        self._numbers = {one.place: one for one in [*(one for _, one in program.reads), *program.works]}
        self._turn: dict[int, int] = {}
        for k, one in self._numbers.items():
            self._turn[k] = max((self._turn[a.place] for a in one.of), default=0) + (one.operation in REDUCTIONS)
        self._last = max(self._turn.values(), default=0)
        self._loops: dict[Loop, list[Number]] = {}
        for turn in range(self._last + 1):
            self._add_loops(turn)
        self._end = self._last + 1, 0
        if late:
            self._loops[self._end] = []
        self._made: dict[int, Loop] = {}  # where a member's number is worked out first
        self._rows: dict[int, tuple[Loop, Place]] = {}  # what lies in the table, from which loop on, and where
        self.overwritten: frozenset[Place] = frozenset()
        for place, one in outputs.items():
            if one.member and one.operation != "given" and place not in late:
                self._rows.setdefault(one.place, (self._home(one), place))
        for place in late:
            self._keep(outputs[place])
        kept = -1
        while kept < len(self._rows) and not self.overwritten:
            kept = len(self._rows)
            for loop in self._loops:
                self._members_of(loop)

    def _add_loops(self, turn: int) -> None:
        sums = [
            one
            for one in self._numbers.values()
            if one.operation in REDUCTIONS and self._turn[one.place] == turn + 1
        ]
        for k in range(0, max(len(sums), 1), SUMS):
            self._loops[turn, k // SUMS] = sums[k : k + SUMS]

    def _home(self, one: Number) -> Loop:
        return self._turn[one.place], 0

    def _keep(self, one: Number) -> None:
        if one.member and one.operation != "given" and one.place not in self._rows:
            self._rows[one.place] = self._made.get(one.place, self._home(one)), Place("table", self._scratch)
            self._scratch += 1

    def _stores(self, loop: Loop) -> list[tuple[Place, Number]]:
        if loop == self._end:
            return [(place, self._outputs[place]) for place in sorted(self.late)]
        found = [(place, self._numbers[k]) for k, (home, place) in self._rows.items() if home == loop]
        known = {place for place, _ in found}
        return found + [
            (place, one)
            for place, one in self._outputs.items()
            if place not in known and place not in self.late and self._home(one) == loop
        ]

    def _place_of(self, one: Number, loop: Loop) -> Place | None:
        """Where a member's number lies when a loop begins."""
        if one.operation == "given":
            place = one.arguments[0]
            written = self._outputs.get(place)
            if written is not None and place not in self.late and self._home(written) < loop:
                self.overwritten |= {place}
            return place
        home, place = self._rows.get(one.place, (loop, None))
        return place if home < loop else None

    def _members_of(self, loop: Loop) -> tuple[list[Number], list[tuple[Place, Number]]]:
        """Numbers that a loop reads and works out, and what it stores; what it lacks is kept by another one."""
        stores = self._stores(loop)
        wanted = [one for _, one in stores] + [one.of[0] for one in self._loops[loop]]
        own = {one.place for one in wanted}

        cutter = self

        class Known:
            """Numbers whose arguments do not matter: they are the same for all members, or lie in the table."""

            def __contains__(self, place) -> bool:
                one = cutter._numbers[place]
                if not one.member or cutter._place_of(one, loop):
                    return True
                if place in own or cutter._made.get(place, loop) >= loop:
                    return False
                if all(not a.member or cutter._place_of(a, loop) for a in one.of):
                    return False  # one operation, done again
                cutter._keep(one)
                return True

        found = [one for one in needed_by(wanted, Known()) if one.member]
        for one in found:
            self._made.setdefault(one.place, loop)
        return found, stores

    def cut(self) -> Cut:
        """All turns."""
        turns = []
        for turn in range(self._last + 1 + bool(self.late)):
            works = [one for one in self._program.works if not one.member and self._turn[one.place] == turn]
            bodies = [self._body(loop) for loop in self._loops if loop[0] == turn]
            turns.append(Turn(works, [one for one in bodies if one.stores or one.sums]))
        reads = [(place, one) for place, one in self._program.reads if not one.member]
        stores = [(place, one) for place, one in self._program.stores if place.array not in BY_MEMBERS]
        return Cut(reads, turns, stores, self._scratch)

    def _body(self, loop: Loop) -> Body:
        numbers, stores = self._members_of(loop)
        places = [(self._place_of(one, loop), one) for one in numbers]
        reads = [(place, one) for place, one in places if place is not None]
        return Body(reads, [one for place, one in places if place is None], stores, self._loops[loop])
