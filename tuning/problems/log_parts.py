"""The rows of logs for training, for the choice of the ensemble size, and for held-out evaluation."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from numerics.checks import at_least, shown
from plants.logs.log import Log

LEAD = 50  # steps at the start of a block that are filtered and not scored
WANTED = 24  # approximate number of blocks that logs are cut into: standard errors need several
SHORTEST = 25  # scored rows of a block
EVERY_THIRD, EVERY_FOURTH = 3, 4
FEWEST = 2  # training blocks, and as many held-out blocks


class Block(NamedTuple):
    """Rows of one run: a lead-in, in which a filter settles, and then the scored ones."""

    run: int  # index of the log
    first: int  # row with which the lead-in begins
    rows: int  # lead-in and scored ones


class Parts(NamedTuple):
    """All blocks, in the order of their seeds 0, 1, ...: training, ensemble size, held out."""

    blocks: tuple[Block, ...]
    training: range
    sizes: range
    held_out: range


def parts_of(
    logs: Sequence[Log],
    lead: int = LEAD,
    blocks: int | None = None,
    held_out: Collection[str] | None = None,
    *,
    sizes: bool = False,
) -> Parts:
    """Cut logs into blocks for training, for the choice of the ensemble size, and for held-out evaluation.

    Each run is cut into consecutive blocks of nearly equal length; a block's lead-in are the rows before it. Held
    out are the named runs, else every third run of three or more, else every third block.

    Args:
        logs: of at least one run.
        lead: rows of a lead-in.
        blocks: number of blocks of each run; if None there are about 24 in all, each of 25 rows or more.
        held_out: names of the held-out runs.
        sizes: whether every fourth of the other blocks is for the choice of an ensemble size.

    Raises:
        ValueError: if a log is too short, or there are too few training or held-out blocks.
    """
    lead = at_least("lead", lead, 0)
    counts = _counts(logs, lead, blocks)
    all_blocks = [block for run, log in enumerate(logs) for block in _cut(run, log, lead, counts[run])]
    held = _held(logs, all_blocks, held_out)
    held_blocks = [block for block, out in zip(all_blocks, held, strict=True) if out]
    left = [block for block, out in zip(all_blocks, held, strict=True) if not out]
    choosing = left[EVERY_FOURTH - 1 :: EVERY_FOURTH] if sizes else []
    if len(choosing) < FEWEST:
        choosing = []
    training = [block for block in left if block not in choosing]
    for some, what in ((training, "to learn from"), (held_blocks, "held out")):
        if len(some) < FEWEST:
            raise ValueError(
                f"there must be at least {FEWEST} blocks {what}, but {', '.join(log.name for log in logs)} give "
                f"{len(some)}: give more logs, longer ones or more blocks"
            )
    ends = np.cumsum([len(training), len(choosing), len(held_blocks)]).tolist()
    ranges = range(0, ends[0]), range(ends[0], ends[1]), range(ends[1], ends[2])
    return Parts((*training, *choosing, *held_blocks), *ranges)


def _counts(logs: Sequence[Log], lead: int, blocks: int | None) -> list[int]:
    """The number of blocks of each run."""
    scored = [log.steps + 1 - lead for log in logs]
    count = 1 if blocks is None else at_least("blocks", blocks, 1)
    for log, rows in zip(logs, scored, strict=True):
        if rows < SHORTEST * count:
            raise ValueError(
                f"a log must have at least {lead + SHORTEST * count} rows, {lead} of a lead-in and {SHORTEST} of "
                f"each block, but {log.name} has {log.steps + 1}"
            )
    if blocks is not None:
        return [count] * len(logs)
    length = max(SHORTEST, sum(scored) / WANTED)
    return [max(1, min(round(rows / length), rows // SHORTEST)) for rows in scored]


def _cut(run: int, log: Log, lead: int, count: int) -> list[Block]:
    ends = np.linspace(lead, log.steps + 1, count + 1).round().astype(int).tolist()
    return [Block(run, start - lead, end - start + lead) for start, end in zip(ends, ends[1:], strict=False)]


def _held(logs: Sequence[Log], blocks: Sequence[Block], held_out: Collection[str] | None) -> list[bool]:
    """Whether each block is held out."""
    names = [log.name for log in logs]
    if held_out is not None:
        unknown = [name for name in held_out if name not in names]
        if unknown:
            raise ValueError(
                f"runs that are held out must be among {', '.join(names)}, but got {shown(unknown[0])}"
            )
        return [names[block.run] in held_out for block in blocks]
    if len(logs) >= EVERY_THIRD:
        return [block.run % EVERY_THIRD == EVERY_THIRD - 1 for block in blocks]
    return [place % EVERY_THIRD == EVERY_THIRD - 1 for place in range(len(blocks))]
