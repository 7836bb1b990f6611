"""The blocks of logs for training, for the choice of the ensemble size, and for held-out evaluation."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import at_least, short_repr
from thruster_env.logs.log import Log, shared_by
from thruster_env.model.continuous import same_dt

LEAD = 50  # steps at the start of a block that are filtered and not scored
WANTED = 72  # approximate number of blocks that logs are cut into: tests and standard errors need many
SHORTEST = 25  # scored rows of a block
SIZES = (
    (LEAD, SHORTEST),
    (25, 12),
    (12, 6),
    (6, 4),
    (2, 3),
)  # lead-ins and scored rows: short logs have later ones
EVERY_THIRD = 3
LENGTHS = 64  # lengths of a block that are tried, to lose few rows
MOST_LOST = 0.05  # share of rows that blocks of one length may leave out, if shorter ones leave out fewer
FEWEST = 2  # training blocks, and as many held-out blocks
FEWEST_APART = 3  # blocks that are set aside, if any are
SHARE = 4  # a block has at least the usual share of rows with a measurement divided by this


class Block(NamedTuple):
    """Rows of one run: a lead-in, in which a filter settles, and then the scored ones."""

    run: int  # index of the log
    first: int  # row with which the lead-in begins
    rows: int  # lead-in and scored ones


class Piece(NamedTuple):
    """Rows of one run between gaps."""

    run: int
    first: int
    rows: int


class Parts(NamedTuple):
    """All blocks, in the order of their seeds 0, 1, ...: training, ensemble size, held out; unused rows."""

    blocks: tuple[Block, ...]
    training: range
    sizes: range
    held_out: range
    lead: int = LEAD
    shortest: int = SHORTEST
    is_short: bool = False  # lead-in and blocks are shorter than usual, for the logs are short
    empty: int = 0  # blocks that were left out, with too few measurements
    short_pieces: int = 0  # pieces between gaps that are too short for a block

    def sentences(self) -> list[str]:
        """The lost rows, in words; empty if there are none."""
        sentences = []
        if self.empty:
            are, have = ("is", "has") if self.empty == 1 else ("are", "have")
            sentences.append(
                f"{self.empty} of {self.empty + len(self.blocks)} blocks {are} left out and in no score: "
                f"{'it' if self.empty == 1 else 'they'} {have} no measurements, or too few."
            )
        if self.short_pieces:
            is_single = self.short_pieces == 1
            sentences.append(
                f"{self.short_pieces} piece{'' if is_single else 's'} of a run between gaps "
                f"{'is' if is_single else 'are'} shorter than a lead-in and a block, {self.lead + self.shortest} "
                "rows, and left out."
            )
        if self.is_short:
            sentences.append(
                f"The logs are short: a lead-in has {self.lead} rows, a block {self.shortest} scored ones or more "
                f"({LEAD} and {SHORTEST} are usual), so the model's prior counts in the score and intervals are "
                f"wide."
            )
        return sentences


def parts_of(
    logs: Sequence[Log],
    lead: int | None = None,
    blocks: int | None = None,
    held_out: Collection[str] | None = None,
    *,
    hold_gaps: bool = False,
    sizes: bool = False,
    known: Sequence[np.ndarray] | None = None,
    shortest: int | None = None,
) -> Parts:
    """Cut logs into blocks for training, for the choice of the ensemble size, and for held-out evaluation.

    Each run is cut at its gaps (`thruster_env.logs.log.Log.pieces`), and each piece into consecutive blocks
    of one length, so that they can be compared with one another; a block's lead-in are the rows before it, and the
    first rows of a piece that make no block belong to its first lead-in. A block that is measured in less than a
    quarter of the usual share of its rows is left out. Held out are the named runs, else every third run of three
    or more, else every third block.

    Args:
        logs: of at least one run.
        lead: rows of a lead-in; if None 50, of short logs fewer, as many as let them have blocks.
        blocks: number of blocks of each run, of nearly one length; if None there are about 72 in all, each of 25
            rows or more, of short logs 3 or more.
        held_out: names of the held-out runs.
        hold_gaps: whether runs are not cut at gaps, and their inputs are held there.
        sizes: whether every third of the other blocks is set aside for the choice at the end.
        known: which rows of each log have a truth, (rows,) bool; a block without any that is scored is left out.
        shortest: scored rows of a block; if None 25, of short logs fewer.

    Raises:
        ValueError: if a log is too short, or there are too few training or held-out blocks.
    """
    _check_names(logs, held_out)
    if lead is not None:
        lead = at_least("lead", lead, 0)
    if blocks is not None:
        blocks = at_least("blocks", blocks, 1)
    pieces = [
        Piece(run, first, rows)
        for run, log in enumerate(logs)
        for first, rows in ([(0, log.steps + 1)] if hold_gaps else log.pieces)
    ]
    for rows, least in SIZES if shortest is None else ((LEAD, at_least("shortest", shortest, 1)),):
        try:
            parts = _parts(logs, pieces, rows if lead is None else lead, least, blocks, held_out, sizes, known)
            return parts._replace(is_short=shortest is None and least < SHORTEST)
        except ValueError as error:
            refused = error
    raise refused


def _parts(
    logs: Sequence[Log],
    pieces: Sequence[Piece],
    lead: int,
    shortest: int,
    blocks: int | None,
    held_out: Collection[str] | None,
    sizes: bool,
    known: Sequence[np.ndarray] | None,
) -> Parts:
    """The blocks with a lead-in and a least number of scored rows; ValueError where there are too few."""
    long = [piece for piece in pieces if piece.rows >= lead + shortest]
    _check_lengths(logs, long, lead, shortest, 1 if blocks is None else blocks)
    if blocks is None:
        length = _length(long, lead, shortest)
        cut = [block for piece in long for block in _cut_equally(piece, lead, length)]
    else:
        counts = _counts(long, lead, blocks)
        cut = [block for piece, count in zip(long, counts, strict=True) for block in _cut(piece, lead, count)]
    if known is not None:
        rows = [known[block.run][block.first + lead : block.first + block.rows] for block in cut]
        cut = [block for block, mask in zip(cut, rows, strict=True) if mask.any()]
    measured = np.array([_measured(logs, block, lead) for block in cut])
    usual = np.median(measured[measured > 0]) if measured.any() else 0.0
    all_blocks = [block for block, share in zip(cut, measured, strict=True) if share and share * SHARE >= usual]
    is_held_out = _mask_of_held_out(logs, all_blocks, held_out)
    held_blocks = [block for block, out in zip(all_blocks, is_held_out, strict=True) if out]
    left = [block for block, out in zip(all_blocks, is_held_out, strict=True) if not out]
    choosing = left[EVERY_THIRD - 1 :: EVERY_THIRD] if sizes else []
    if len(choosing) < FEWEST_APART:
        choosing = []
    training = [block for block in left if block not in choosing]
    for part, what in ((training, "to learn from"), (held_blocks, "held out")):
        if len(part) < FEWEST:
            raise ValueError(
                f"there must be at least {FEWEST} blocks with measurements {what}, but "
                f"{', '.join(log.name for log in logs)} give {len(part)}: give more "
                f"logs, longer ones or more blocks"
            )
    ends = np.cumsum([len(training), len(choosing), len(held_blocks)]).tolist()
    ranges = range(0, ends[0]), range(ends[0], ends[1]), range(ends[1], ends[2])
    ordered = (*training, *choosing, *held_blocks)
    empty, short = len(cut) - len(all_blocks), len(pieces) - len(long)
    return Parts(ordered, *ranges, lead, shortest, empty=empty, short_pieces=short)


def _check_lengths(logs: Sequence[Log], pieces: Sequence[Piece], lead: int, shortest: int, count: int) -> None:
    """Raise ValueError where a run is too short for so many blocks."""
    for run, log in enumerate(logs):
        most = sum((piece.rows - lead) // shortest for piece in pieces if piece.run == run)
        if most < count:
            raise ValueError(
                f"a log must have at least {lead + shortest * count} rows, {lead} of a lead-in and {shortest} of "
                f"each block, but {log.name} has {log.steps + 1}"
                + (f" in {len(log.pieces)} pieces between gaps" if len(log.pieces) > 1 else "")
            )


def _length(pieces: Sequence[Piece], lead: int, shortest: int) -> int:
    """The length of blocks: about 72 in all, two or more of each run that is long enough, few rows left over."""
    rows = np.array([piece.rows - lead for piece in pieces])
    runs = np.array([piece.run for piece in pieces])
    longest = min(int(rows[runs == run].max()) for run in set(runs.tolist()))
    usual = max(shortest, min(int(rows.sum()) // WANTED, longest // FEWEST))
    lengths = np.unique(np.linspace(shortest, usual, LENGTHS).astype(int))[::-1]
    lost = [float((rows % length).sum() / rows.sum()) for length in lengths.tolist()]
    few = [length for length, share in zip(lengths.tolist(), lost, strict=True) if share <= MOST_LOST]
    return few[0] if few else int(lengths[int(np.argmin(lost))])


def _cut_equally(piece: Piece, lead: int, length: int) -> list[Block]:
    """As many blocks of a length as a piece has, up to its last row."""
    last = piece.first + piece.rows
    starts = range(last - (piece.rows - lead) // length * length, last, length)
    return [Block(piece.run, start - lead, length + lead) for start in starts]


def _counts(pieces: Sequence[Piece], lead: int, blocks: int) -> list[int]:
    """The number of blocks of each piece, of so many of each run."""
    scored = [piece.rows - lead for piece in pieces]
    of_runs = [
        sum(r for piece, r in zip(pieces, scored, strict=True) if piece.run == other.run) for other in pieces
    ]
    return [max(1, round(blocks * rows / all_rows)) for rows, all_rows in zip(scored, of_runs, strict=True)]


def _cut(piece: Piece, lead: int, count: int) -> list[Block]:
    last = piece.first + piece.rows
    ends = np.linspace(piece.first + lead, last, count + 1).round().astype(int).tolist()
    return [Block(piece.run, start - lead, end - start + lead) for start, end in zip(ends, ends[1:], strict=False)]


def _measured(logs: Sequence[Log], block: Block, lead: int) -> float:
    """The share of a block's scored rows in which something is measured."""
    scored = logs[block.run].measurements[block.first + lead : block.first + block.rows]
    return float((~np.isnan(scored)).any(axis=1).mean())


def _check_names(logs: Sequence[Log], held_out: Collection[str] | None) -> None:
    names = [log.name for log in logs]
    unknown = [name for name in held_out or () if name not in names]
    if unknown:
        raise ValueError(
            f"runs that are held out must be among {', '.join(names)}, but got {short_repr(unknown[0])}"
        )


def _mask_of_held_out(
    logs: Sequence[Log], blocks: Sequence[Block], held_out: Collection[str] | None
) -> list[bool]:
    if held_out is not None:
        return [logs[block.run].name in held_out for block in blocks]
    if len(logs) >= EVERY_THIRD:
        return [block.run % EVERY_THIRD == EVERY_THIRD - 1 for block in blocks]
    return [i % EVERY_THIRD == EVERY_THIRD - 1 for i in range(len(blocks))]


def check_times(logs: Sequence[Log]) -> None:
    """Raise ValueError unless all logs have the same sample time, all on grids or all on their own stamps."""
    for log in logs[1:]:
        if (log.stamps is None) != (logs[0].stamps is None):
            stamped, gridded = (logs[0], log) if log.stamps is None else (log, logs[0])
            raise ValueError(
                f"logs must all lie on grids or none, but {stamped.name} does not and {gridded.name} does"
            )
        if not same_dt(log.dt, logs[0].dt):
            first, dt = logs[0].name, f"{logs[0].dt:g}"
            how = "put them on one grid" if log.stamps is None else "give both the same"
            raise ValueError(
                f"logs of one problem must have the same sample time, but {first} has {dt} s and {log.name} "
                f"{log.dt:g} s: {how} with --dt {dt}, in Python dt={dt}"
            )


def check_apart(learning: Sequence[Log], held_out: Sequence[Log]) -> None:
    """Raise ValueError if a training and a held-out run have rows in common, as a copy or a part of one has."""
    pair = shared_by(learning, held_out) if learning and held_out else None
    if pair is not None:
        raise ValueError(
            f"held-out runs must have no rows in common with the others, but {pair[1].name} has some of "
            f"{pair[0].name}"
        )
