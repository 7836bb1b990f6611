"""Which column of a file is which quantity of a model: by its header, or as the caller says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import NamedTuple

from thruster_env.core.checks import FEW, listed, short_repr
from thruster_env.logs.units import parted
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel

INPUT, MEASUREMENT, STATE, OUTPUT = "input", "measurement", "state", "output"
TIME = "time"
TIME_NAMES = ("t", "time", "Time", "TIME", "timestamp", "stamp")
DATE_NAMES = ("timestamp", "datetime", "date_time", "date time")


class Wanted(NamedTuple):
    """A quantity that a column may hold."""

    kind: str  # one of the four above
    quantity: Quantity

    @property
    def key(self) -> str:
        """Its unique name: "input:V_s"."""
        return f"{self.kind}:{self.quantity.symbol}"


class Column(NamedTuple):
    """A column of a file, and its unit; None where the header gives none."""

    header: str
    unit: str | None


def quantities_of(model: StateSpaceModel) -> list[Wanted]:
    """All quantities of a model that a log may hold: inputs and measurements, then the references."""
    states = [*model.states]
    outputs = [one.quantity._replace(symbol=symbol) for symbol, one in model.outputs.items()]
    kinds = (INPUT, model.input_quantities), (MEASUREMENT, model.measurements), (STATE, states), (OUTPUT, outputs)
    return [Wanted(kind, quantity) for kind, some in kinds for quantity in some]


def plain(name: str) -> str:
    """A name as used in headers: "measured_speed" for "measured speed"."""
    return name.replace(" ", "_").replace("-", "_")


def find_wanted(name: str, wanted: Sequence[Wanted]) -> Wanted | None:
    """The quantity of a symbol or name, inputs before measurements before references; or "kind:symbol"."""
    for one in wanted:
        symbol = one.quantity.symbol
        if name in (symbol, one.key) or plain(name).lower() == plain(one.quantity.name).lower():
            return one
    return next((one for one in wanted if plain(name) == plain(one.quantity.symbol)), None)


def column_of(text: str, headers: Sequence[str], units: Mapping[str, str], what: str, file: str) -> Column:
    """The column that a text names, "HEADER" or "HEADER[UNIT]"; ValueError if the file has no such."""
    bare, unit = text, None
    if text not in headers and text.endswith("]"):
        bare, _, unit = text[:-1].rpartition("[")
        bare, unit = bare.strip(), unit.strip()
    if bare not in headers:  # the header without its unit will do
        same = [header for header in headers if parted(header)[0] == bare]
        bare = same[0] if len(same) == 1 else bare
    if bare not in headers:
        near = get_close_matches(text, headers, n=3) if len(headers) > FEW else []
        told = f"; near it are {', '.join(near)}" if near else ""
        rule = f"the column for {what} must be one of {listed(headers)}"
        raise ValueError(f"{rule}, but got {short_repr(text)} ({file}){told}")
    return Column(bare, unit or _unit(bare, units))


def _unit(header: str, units: Mapping[str, str]) -> str | None:
    """The unit that is said of a header, else that in it; None where it is said that there is none."""
    return units[header] or None if header in units else parted(header)[1]


def find_columns(
    wanted: Sequence[Wanted],
    headers: Sequence[str],
    given: Mapping[str, str],
    units: Mapping[str, str],
    file: str,
    needs_time: bool = False,
) -> dict[str, Column]:
    """Find the column of each quantity that the file has, and of "time", by key.

    Quantities that are not given are found by headers: a header without its unit is the quantity's name or symbol.
    A header that is a symbol as it stands, such as "V_s", has no unit. Inputs and measurements come before states
    and outputs, names before symbols; a column is used once.

    Args:
        wanted: from `quantities_of`.
        headers: of the file's columns.
        given: columns by quantity: "thrust" or "output:T", and "time", to "loadcell_N" or "loadcell[N]".
        units: by header, where the header gives none or another one.
        file: for messages.
        needs_time: whether a missing column of times is named with other missing ones.

    Raises:
        ValueError: for a quantity that the model has not, a column that the file has not, or one given twice.
    """
    found: dict[str, Column] = {}
    for name, text in given.items():
        one = None if name == TIME else find_wanted(name, wanted)
        if one is None and name != TIME:
            known = ", ".join([*(known.quantity.symbol for known in wanted), TIME])
            raise ValueError(
                f"columns must be given for some of {known}, but got {short_repr(name)}={text} ({file})"
            )
        if not isinstance(text, str):
            raise ValueError(f"the column for {name} must be a header, but got {short_repr(text)} ({file})")
        key = TIME if one is None else one.key
        if key in found:
            raise ValueError(
                f"a column must be given once for {name}, but got {found[key].header} and {text} ({file})"
            )
        found[key] = column_of(text, headers, units, name, file)
    known_headers = set(headers)
    for header in units:
        if header not in known_headers:
            raise ValueError(f"units must be of columns {listed(headers)}, but got {short_repr(header)} ({file})")
    _by_headers(found, wanted, headers, units)
    _check_found(found, wanted, headers, needs_time, file)
    return found


def _check_found(
    found: Mapping[str, Column], wanted: Sequence[Wanted], headers: Sequence[str], needs_time: bool, file: str
) -> None:
    """Raise ValueError, naming all that is missing, unless inputs, measurements and times are there."""
    missing = [one for one in wanted if one.kind in (INPUT, MEASUREMENT) and one.key not in found]
    if not missing:
        return
    said = [
        f"the {one.kind} {one.quantity.label} (use --column {one.quantity.symbol}=HEADER, or call it "
        f"{plain(one.quantity.name)})"
        for one in missing
    ]
    if needs_time and TIME not in found:
        said.append("times (use --column time=HEADER, or --dt)")
    python = f"in Python columns={{{missing[0].quantity.symbol!r}: 'HEADER'}}"
    raise ValueError(
        f"a log must have a column for {' and for '.join(said)}, but {file} has {listed(headers)}; {python}"
    )


def _by_headers(found: dict, wanted: Sequence[Wanted], headers: Sequence[str], units: Mapping[str, str]) -> None:
    """Add the columns whose headers tell what they are."""
    used = {column.header for column in found.values()}
    left = [header for header in headers if header not in used]
    bare = {header: parted(header) for header in left}
    whole: dict[str, list[str]] = {}
    bases: dict[str, list[str]] = {}
    for header in left:
        whole.setdefault(plain(header), []).append(header)
        base = plain(bare[header][0])
        for name in dict.fromkeys((base, base.lower())):
            bases.setdefault(name, []).append(header)

    def take(key: str, fitting: Sequence[str], without_unit: bool = True) -> None:
        header = None if key in found else next((one for one in fitting if one in bare), None)
        if header is not None:
            found[key] = Column(header, _unit(header, units) if without_unit or header in units else None)
            del bare[header]

    times = [header for header in left if bare[header][0] in TIME_NAMES]
    take(TIME, times or [header for header in left if bare[header][0].lower() in DATE_NAMES])
    for kinds in ((INPUT, MEASUREMENT), (STATE, OUTPUT)):
        some = [one for one in wanted if one.kind in kinds]
        for one in some:
            name = plain(one.quantity.name).lower()
            take(one.key, [header for header in bases.get(name, []) if plain(parted(header)[0]).lower() == name])
        for one in some:  # the whole header: what stands behind the line of "V_s" is no unit
            take(one.key, whole.get(plain(one.quantity.symbol), []), without_unit=False)
        for one in some:
            symbol = plain(one.quantity.symbol)
            take(one.key, [header for header in bases.get(symbol, []) if plain(parted(header)[0]) == symbol])
