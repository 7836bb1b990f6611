"""A recorder's file as a table of a log: fields with times of their own, put into rows at all of their times."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from thruster_env.core.checks import listed
from thruster_env.logs.columns import INPUT, MEASUREMENT, TIME, Column, Wanted, find_columns, parted
from thruster_env.logs.findings import CLOCK, OUTSIDE, Remark
from thruster_env.logs.grid import SECOND, follows, time_text
from thruster_env.logs.recorders.one_clock import HEADER, RECEIPT, Choice, chosen_clock
from thruster_env.logs.recorders.registry import Format, Samples, check_stamps, read
from thruster_env.logs.table import Table

STAMP = "times"  # header of the rows' times


class Recorded:
    """The fields of a recorder's file that may be columns of a log.

    Attributes:
        path: of the file.
        samples: by name; of a format with stamps, those that are asked for, as one file may have hundreds.
    """

    def __init__(self, path: str | Path, form: Format, asked: Collection[str], stamps: str | None = None):
        """Read the fields that are asked for, "HEADER" or "HEADER[UNIT]"; all of arrays, found by their names.

        `stamps` of a bag is "header" or "receipt", None for what `one_clock` chooses.
        """
        check_stamps(stamps, form, path)
        self.path, self.form, self.stamps = Path(path), form, stamps
        names = {name for text in asked for name in (text, text.rpartition("[")[0].strip()) if name}
        self.is_whole, self.is_timed = not form.has_stamps, False
        self._asked = names
        self.samples = read(path, None if self.is_whole else names)

    def columns(
        self, wanted: list[Wanted], given: Mapping[str, str], units: Mapping[str, str], needs_time: bool
    ) -> dict[str, Column]:
        """The columns of quantities, as `find_columns` finds them; ValueError names all fields."""
        if self.form.has_stamps and TIME in given:
            rule = f"times of a {self.form.kind} must be the stamps of its messages"
            raise ValueError(f"{rule}, but got time={given[TIME]} ({self.path})")
        self.is_timed = TIME in given  # by a vector for all fields, in place of those beside them
        while True:
            said = {name: unit for name, one in self.samples.items() if (unit := _unit(name, one)) is not None}
            own = {name: one.unit for name, one in self.samples.items() if one.unit}
            said |= units
            try:
                found = find_columns(wanted, [*self.samples], given, said, str(self.path), needs_time)
                return found if self.form.has_units else _without_units(found, wanted, own)
            except ValueError:
                if self.is_whole:
                    read(self.path, self._asked)  # which says of an array why it is not read
                    raise
            self.samples, self.is_whole = read(self.path, None), True

    def has_times(self, found: Mapping[str, Column]) -> bool:
        """Whether all columns but that of times have times of their own."""
        return all(self.samples[one.header].times is not None for key, one in found.items() if key != TIME)

    def table(self, found: Mapping[str, Column]) -> tuple[Table, dict[str, Column]]:
        """The rows of a log and their columns: at the times of all samples, from when all inputs are known.

        The measurement with most samples gives the grid: the log begins and ends with it. Before it, an input's
        last sample counts. Of two samples of a field at one time, the last is used. All fields have the times of
        one clock.

        Args:
            found: columns by quantity.

        Raises:
            ValueError: if a field has no times, or they run backwards, or inputs and measurements do not overlap.
        """
        found = {
            key: one for key, one in found.items() if key != TIME or self.is_timed or not self.has_times(found)
        }
        some = {column.header: self.samples[column.header] for column in found.values()}
        choice = chosen_clock({name: one.clocked for name, one in some.items()}, self.stamps, self.path)
        some = {name: one.by(choice.clock) for name, one in some.items()}
        for name, one in some.items():
            _check(name, one, self.path)
        if TIME in found or all(one.times is None for one in some.values()):
            return _plain(some, self.path), found
        for name, one in some.items():
            if one.times is None:
                raise ValueError(
                    f"all fields of a log must have times, but there are none beside {name!r} in {self.path} "
                    f"(use --column time=NAME)"
                )
        of = {kind: [some[found[key].header] for key in found if key.startswith(f"{kind}:")] for kind in KINDS}
        clock = _clock(of[INPUT], of[MEASUREMENT], self.path)
        apart = np.unique(np.concatenate([_times(one) for one in some.values()]))
        apart = apart[(apart > clock[0]) & (apart < clock[-1])]
        stamps = np.sort(np.concatenate([clock, np.setdiff1d(apart, clock)]), kind="stable")
        cells = {name: _rows(one, stamps) for name, one in some.items()}
        for name in (found[key].header for key in found if key.startswith(f"{INPUT}:")):
            cells[name][0] = some[name].values[_times(some[name]) <= stamps[0]][-1]
        rows = range(1, len(stamps) + 1)
        taken = [Remark(CLOCK, "", one) for one in dict.fromkeys(one.taken for one in some.values()) if one]
        is_clock = np.isin(stamps, clock)
        remarks = [*taken, *_of_choice(choice), *_not_used(found, some, clock, self.path)]
        table = Table(str(self.path), {STAMP: stamps, **cells}, rows, "row", is_clock, _damage(some), remarks)
        return table, {**found, TIME: Column(STAMP, SECOND)}


KINDS = (INPUT, MEASUREMENT)
MANY = 0.1  # of the samples of a channel outside the log: worth a word


def _of_choice(choice: Choice) -> list[Remark]:
    """Why a bag's topics have the times of reception, where some have others."""
    if not choice.why:
        return []
    said = f"all topics have the times at which messages were received, because {choice.why}"
    return [Remark(CLOCK, "", f"{said} (stamps, --stamps {HEADER}|{RECEIPT})")]


def _not_used(
    found: Mapping[str, Column], some: Mapping[str, Samples], clock: np.ndarray, path: Path
) -> list[Remark]:
    """Channels of which many samples, or all, lie outside the log; ValueError for all of a measurement."""
    remarks = []
    for key, column in found.items():
        times = _times(some[column.header])
        outside = int(((times < clock[0]) | (times > clock[-1])).sum())
        if outside <= MANY * len(times):
            continue
        dt = float(np.median(np.diff(clock)))
        ends = [time_text(one, dt) for one in (times[0], times[-1], clock[0], clock[-1])]
        where = f"from {ends[0]} to {ends[1]} s, the log from {ends[2]} to {ends[3]} s"
        if outside == len(times) and key.startswith(f"{MEASUREMENT}:"):
            rule = "measurements must have samples in the log"
            raise ValueError(f"{rule}, but those of {column.header} are {where} ({path})")
        count = "all" if outside == len(times) else f"{outside} of {len(times)}"
        said = f"{count} samples of {column.header} lie outside the log: they are {where}"
        remarks.append(Remark(OUTSIDE, key, said))
    return remarks


def _without_units(
    found: Mapping[str, Column], wanted: Sequence[Wanted], known: Mapping[str, str]
) -> dict[str, Column]:
    """The columns, without a unit that is only known of a field for a quantity of a model that has none."""
    plain = {one.key for one in wanted if not one.quantity.unit}
    return {
        key: one._replace(unit=None) if key in plain and one.unit == known.get(one.header) else one
        for key, one in found.items()
    }


def _unit(name: str, one: Samples) -> str | None:
    """The unit that a file gives, None if its name may have one; the brackets of "speed_rpm[0]" hold none."""
    return one.unit or ((parted(name.rpartition("[")[0])[1] or "") if name.endswith("]") else None)


def _times(one: Samples) -> np.ndarray:
    """Times of samples that have some."""
    return np.empty(0) if one.times is None else one.times


def _check(name: str, one: Samples, path: Path) -> None:
    """Raise ValueError for times that are missing or run backwards, and for infinite values; it names the time."""
    times = _times(one)
    if np.isnan(times).any():
        raise ValueError(f"every sample must have a time, but one of {name!r} in {path} has none")
    if (np.diff(times) < 0).any():
        row = int(np.argmax(np.diff(times) < 0)) + 1
        rule = "times must increase from sample to sample"
        raise ValueError(f"{rule}, but {follows(times[row - 1], times[row])} in {name!r} of {path}")
    if np.isinf(one.values).any():
        row = int(np.argmax(np.isinf(one.values)))
        where = f"at {times[row]:.15g} s" if len(times) else f"in row {row + 1}"
        raise ValueError(f"numbers must be finite, but got {one.values[row]} {where} in {name!r} of {path}")


def _plain(some: Mapping[str, Samples], path: Path) -> Table:
    """A table of fields of equal length, of which one may hold the times."""
    lengths = {name: len(one.values) for name, one in some.items()}
    if len(set(lengths.values())) > 1:
        told = listed(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"fields without times of their own must be of equal length, but {path} has {told}")
    rows = range(1, next(iter(lengths.values())) + 1)
    cells = {name: one.values for name, one in some.items()}
    return Table(str(path), cells, rows, "row", damage=_damage(some))


def _damage(some: Mapping[str, Samples]) -> tuple[str, ...]:
    """What of the files of some fields is damaged, each once."""
    return tuple(dict.fromkeys(one.damage for one in some.values() if one.damage))


def _clock(inputs: list[Samples], measured: list[Samples], path: Path) -> np.ndarray:
    """Times of the measurement with most samples, from when all inputs are known."""
    begin = max([-np.inf, *(_times(one)[0] for one in inputs if len(one.values))])
    within = [_times(one)[_times(one) >= begin] for one in measured]
    clock = max(within, key=len, default=np.empty(0))
    if len(clock) < 2:
        end = max((_times(one)[-1] for one in measured if len(one.values)), default=np.nan)
        raise ValueError(
            f"measurements must continue after all inputs have begun, at {begin:.15g} s, but {path} has "
            f"{len(clock)} from there on, and they end at {end:.15g} s"
        )
    return clock


def _rows(one: Samples, stamps: np.ndarray) -> np.ndarray:
    """Samples in the rows of their times, NaN elsewhere; of equal times the last sample, and the last row."""
    rows = np.full(len(stamps), np.nan)
    place = np.searchsorted(stamps, _times(one), side="right") - 1
    there = (place >= 0) & (stamps[np.maximum(place, 0)] == _times(one))
    rows[place[there]] = one.values[there]
    return rows
