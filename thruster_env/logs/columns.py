"""The column of a file for each quantity of a model, by its header or the caller's choice, and its unit."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import FEW, listed, short_repr
from thruster_env.core.modules import to_install
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel

WORDS = (
    *("V", "mV", "kV", "A", "mA", "W", "kW", "Hz", "kHz", "rpm", "rps", "rad", "mrad", "deg", "turn", "rev"),
    *("N", "mN", "kN", "kgf", "lbf", "Nm", "kg", "g", "Pa", "kPa", "bar", "K", "degC", "degF"),
    *("m", "mm", "cm", "km", "s", "ms", "us", "ns", "min", "h", "sec", "minutes", "hours", "days"),
    *("uV", "nV", "uA", "nA", "mW", "MW", "MHz", "uN", "MN", "mNm", "kNm", "mPa", "hPa", "MPa", "mbar", "mK"),
    *("um", "nm", "urad", "mg", "ug"),
    # Units that pint converts, or nobody: a header that ends with one is never read as another unit.
    *("inch", "inches", "ft", "feet", "yd", "yard", "mile", "miles", "nmi", "fathom", "parsec", "lightyear"),
    *("knot", "knots", "mph", "kph", "kmh", "kWh", "Wh", "kJ", "MJ", "cal", "kcal", "eV", "Ah", "mAh", "ohm"),
    *("kohm", "Mohm", "uF", "nF", "pF", "mH", "uH", "mT", "uT", "gauss", "lb", "lbs", "oz", "slug", "tonne"),
    *("psi", "ksi", "torr", "mmHg", "atm", "mol", "arcmin", "arcsec", "dB", "dBm", "liter", "litre", "gallon"),
)
PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
PREFIXED = ("V", "A", "W", "N", "N*m", "Pa", "Hz", "g", "m", "s", "rad", "K", "T")
GRAVITY = "g_0"  # standard gravity; also "g" of accelerometers, where the other unit is an acceleration
GRAMS = {"g": "g_0", "mg": "mg_0", "ug": "ug_0", "G": "g_0"}
# Units as multiples of others. What turns or swings so often a second has an angle of 2 pi each time.
MULTIPLES = {
    "rpm": ("rad/s", 2.0 * math.pi / 60.0),
    "rps": ("rad/s", 2.0 * math.pi),
    "Hz": ("rad/s", 2.0 * math.pi),
    "min": ("s", 60.0),
    "h": ("s", 3600.0),
    "deg": ("rad", math.pi / 180.0),
    **dict.fromkeys(("turn", "rev", "cycle"), ("rad", 2.0 * math.pi)),
    **dict.fromkeys(("sec", "second", "seconds"), ("s", 1.0)),
    **dict.fromkeys(("minute", "minutes"), ("s", 60.0)),
    **dict.fromkeys(("hour", "hours"), ("s", 3600.0)),
    **dict.fromkeys(("d", "day", "days"), ("s", 86400.0)),
    **{f"{prefix}{GRAVITY}": ("m/s^2", size * 9.80665) for prefix, size in (("", 1.0), ("m", 1e-3), ("u", 1e-6))},
    "degC": ("K", 1.0),  # a difference, as in K/min; a temperature itself is among OFFSET
    "degF": ("K", 5.0 / 9.0),
}
OFFSET = {"K": (1.0, 0.0), "degC": (1.0, 273.15), "degF": (5.0 / 9.0, 459.67 * 5.0 / 9.0)}  # factor, and K of 0
OFFSET |= {f"{prefix}K": (factor, 0.0) for prefix, factor in PREFIXES.items()}
TURNING = ("1/s", "1/min", "1/h", "s^-1", "min^-1", "h^-1")  # of turns, or of radians: nobody knows
WRITTEN = {"Nm": "N*m", "°C": "degC", "°F": "degF", "°": "deg"}  # as pint reads them
WRITTEN |= {**dict.fromkeys(("m/s/s", "m/s2", "m/s²", "m/s**2"), "m/s^2"), **dict.fromkeys(("g0", "gn"), "g_0")}
PURE = {"", "-", "1"}  # of a number without a unit
LENGTHS = ("rad", "deg", "m", "mm", "cm", "km")  # over a time even without "_per_"
# Names of an inertial sensor's vectors in other programs, in lower case without other signs, best first.
SENSORS = {
    "gyr": ("gyr", "gyro", "gyroscope", "angularvelocity", "rotationrate"),
    "acc": ("acc", "accel", "totalacceleration", "accelerometer"),
    "mag": ("mag", "magn", "magnetometer", "magneticfield"),
}
OF_ROS = {
    "angular_velocity": ("gyr", "rad/s"),
    "linear_acceleration": ("acc", "m/s^2"),
    "magnetic_field": ("mag", "T"),
}
_RATE = re.compile(r"^(?P<base>.*?)_(?P<over>[A-Za-z]+)(?P<per>_per)?_(?P<under>s|min|h)(?P<power>[23]?)$")
_BRACKETS = re.compile(r"^(?P<base>.*?\S)\s*[\[(](?P<unit>[^\[\]()]*)[\])]$")

# Kinds of quantities, and names of times.
INPUT, MEASUREMENT, STATE, OUTPUT = "input", "measurement", "state", "output"
NO_COLUMN = "a log must have a column"  # with which the message on missing columns begins
MANY_MISSING = 3  # columns, of which more are named by their symbols alone
TIME = "time"
TIME_NAMES = ("t", "time", "Time", "TIME", "timestamp", "stamp", "Zeit", "zeit")
DATE_NAMES = ("timestamp", "datetime", "date_time", "date time", "date", "datum", "zeitstempel")
COUNTERS = {"micros": "us", "millis": "ms"}  # columns of times whose name is the unit, as Arduino's functions


def parted(header: str) -> tuple[str, str | None]:
    """The header of a column without its unit, and the unit, None if it has none.

    Units stand in brackets ("speed [rad/s]"), or at the end as `thruster simulate` writes them
    ("omega_m_rad_per_s", also "omega_m_rad_s"); these are of WORDS.
    """
    if match := _BRACKETS.match(header):
        return match["base"], match["unit"].strip() or None
    match = _RATE.match(header)
    if match and match["base"] and match["over"] in (WORDS if match["per"] else LENGTHS):
        power = f"^{match['power']}" if match["power"] else ""
        return match["base"], f"{match['over']}/{match['under']}{power}"
    base, underscore, last = header.rpartition("_")
    if underscore and base and last in WORDS:
        return base, last
    return header, None


def suffix(unit: str) -> str:
    """A unit at the end of a header: "rad_per_s" of "rad/s"; empty for a pure number."""
    return unit.replace("/", "_per_").replace("^", "").replace("*", "").replace(" ", "")


def simple(unit: str) -> tuple[str, float]:
    """A unit without prefix and the factor to it: ("V", 0.001) for "mV"; an unknown unit is returned unchanged.

    Known are SI prefixes, minutes, hours, days, degrees, turns, rpm, rps and Hz (a turn a second, 2 pi rad/s), and
    differences of degC and degF, also as parts of a quotient.
    """
    unit = WRITTEN.get(unit, unit)
    if unit in MULTIPLES:
        return MULTIPLES[unit]
    over, slash, under = unit.partition("/")
    if slash:
        (above, factor), (below, divisor) = simple(over), simple(under)
        return f"{above}/{below}", factor / divisor
    prefix, base = unit[:1], WRITTEN.get(unit[1:], unit[1:])
    if prefix in PREFIXES and base in PREFIXED:
        target, factor = MULTIPLES.get(base, (base, 1.0))
        return target, PREFIXES[prefix] * factor
    return unit, 1.0


def converted(values: np.ndarray, unit: str | None, wanted: str, where: str) -> np.ndarray:
    """Convert values to another unit; unchanged where a column gives no unit, or the wanted one.

    Args:
        values: of a column.
        unit: its unit, None where it gives none.
        wanted: that of the model's quantity, empty for a pure number.
        where: the column, for messages.

    Raises:
        ValueError: if pint, which converts the units that `simple` does not, does not know a unit or is not
            installed, or if the unit is of another dimension.
    """
    if unit is None or unit == wanted or {unit, wanted} <= PURE:
        return values
    known = conversion(unit, wanted)
    if known is not None:
        factor, divisor, zero = known
        return (values * factor + zero) / divisor if zero else values * (factor / divisor)
    (source, _), (target, _) = simple(unit), simple(wanted)
    for first, other, base in ((unit, wanted, target), (wanted, unit, source)):
        if first.replace(" ", "") in TURNING and base == "rad/s" and "Hz" not in other:
            rule = f"the unit of {where} must say whether it counts turns or radians (rpm, Hz, rad/min)"
            raise ValueError(f"{rule}, but {unit!r} is to be {wanted!r}")
    try:
        import pint
    except ImportError:
        rule = f"units must be converted by pint, which is not installed ({to_install('units')})"
        raise ValueError(f"{rule}, but {where} is in {unit!r} in place of {wanted!r}") from None
    registry = pint.application_registry.get()
    try:
        source, target = (WRITTEN.get(text, text) for text in (unit, wanted))
        return np.asarray(registry.Quantity(values, source).to(target).magnitude, dtype=np.float64)
    except pint.DimensionalityError:
        rule = f"the unit of {where} must be one that converts to {wanted or 'a pure number'}"
        raise ValueError(f"{rule}, but got {unit!r} (name another in brackets: {_example(wanted)})") from None
    except Exception as error:  # pint raises many kinds for text that is no unit
        why = " ".join(str(error).split())
        rule = f"the unit of {where} must be one that pint knows, but got {unit!r}: {why}"
        raise ValueError(f"{rule} (name another in brackets: {_example(wanted)})") from None


def conversion(unit: str, wanted: str) -> tuple[float, float, float] | None:
    """Factor, divisor and zero of values in a unit: (value factor + zero)/divisor; None if `simple` knows none.

    A "g" is a gram, and the standard gravity where the other unit is an acceleration.
    """
    ends = [WRITTEN.get(text, text) for text in (unit, wanted)]
    if all(end in OFFSET for end in ends):
        (factor, zero), (of_wanted, of_zero) = (OFFSET[end] for end in ends)
        return factor, of_wanted, zero - of_zero
    if sum(simple(end)[0] == "m/s^2" for end in ends) == 1:
        ends = [GRAMS.get(end, end) for end in ends]
    (source, factor), (target, of_wanted) = map(simple, ends)
    return (factor, of_wanted, 0.0) if source == target else None


def _example(wanted: str) -> str:
    return f"--column NAME=HEADER[{wanted or 'UNIT'}]"


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
    outputs = [output.quantity._replace(symbol=symbol) for symbol, output in model.outputs.items()]
    kinds = (INPUT, model.input_quantities), (MEASUREMENT, model.measurements), (STATE, states), (OUTPUT, outputs)
    return [Wanted(kind, quantity) for kind, quantities in kinds for quantity in quantities]


def plain(name: str) -> str:
    """A name as used in headers: "measured_speed" for "measured speed"."""
    return name.replace(" ", "_").replace("-", "_")


def find_wanted(name: str, wanted: Sequence[Wanted]) -> Wanted | None:
    """The quantity of a symbol or name, inputs before measurements before references; or "kind:symbol"."""
    for channel in wanted:
        symbol = channel.quantity.symbol
        if name in (symbol, channel.key) or plain(name).lower() == plain(channel.quantity.name).lower():
            return channel
    return next((channel for channel in wanted if plain(name) == plain(channel.quantity.symbol)), None)


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
        near_text = f"; near it are {', '.join(near)}" if near else ""
        rule = f"the column for {what} must be one of {listed(headers)}"
        raise ValueError(f"{rule}, but got {short_repr(text)} ({file}){near_text}")
    return Column(bare, unit or _unit(bare, units))


def _unit(header: str, units: Mapping[str, str]) -> str | None:
    """The unit set for a header, else the one in the header; None if it is set to none."""
    return units[header] or None if header in units else parted(header)[1]


def find_columns(
    wanted: Sequence[Wanted],
    headers: Sequence[str],
    named: Mapping[str, str],
    units: Mapping[str, str],
    file: str,
    needs_time: bool = False,
) -> dict[str, Column]:
    """Find the column of each quantity that the file has, and of "time", by key.

    Other quantities are found by headers: a header without its unit is the quantity's name or symbol.
    A header that is a symbol as it stands, such as "V_s", has no unit. Inputs and measurements come before states
    and outputs, names before symbols; a column is used once.

    Args:
        wanted: from `quantities_of`.
        headers: of the file's columns.
        named: columns by quantity: "thrust" or "output:T", and "time", to "loadcell_N" or "loadcell[N]".
        units: by header, where the header gives none or another one.
        file: for messages.
        needs_time: whether a missing column of times is named with other missing ones.

    Raises:
        ValueError: for a quantity that the model has not, a column that the file has not, or one given twice.
    """
    columns: dict[str, Column] = {}
    for name, text in named.items():
        channel = None if name == TIME else find_wanted(name, wanted)
        if channel is None and name != TIME:
            known = ", ".join([*(known.quantity.symbol for known in wanted), TIME])
            rule = f"columns must be given for some of {known}"
            raise ValueError(f"{rule}, but got {short_repr(name)}={text} ({file})")
        if not isinstance(text, str):
            raise ValueError(f"the column for {name} must be a header, but got {short_repr(text)} ({file})")
        key = TIME if channel is None else channel.key
        if key in columns:
            rule = f"a column must be given once for {name}"
            raise ValueError(f"{rule}, but got {columns[key].header} and {text} ({file})")
        columns[key] = column_of(text, headers, units, name, file)
    known_headers = set(headers)
    for header in units:
        if header not in known_headers:
            raise ValueError(f"units must be of columns {listed(headers)}, but got {short_repr(header)} ({file})")
    _by_headers(columns, wanted, headers, units)
    _check_columns(columns, wanted, headers, needs_time, file)
    return columns


def _check_columns(
    columns: Mapping[str, Column], wanted: Sequence[Wanted], headers: Sequence[str], needs_time: bool, file: str
) -> None:
    """Raise ValueError, naming all that is missing, unless inputs, measurements and times are there."""
    needed = [channel for channel in wanted if channel.kind in (INPUT, MEASUREMENT)]
    missing = [channel for channel in needed if channel.key not in columns]
    if not missing:
        return
    if len(missing) > MANY_MISSING:
        by_unit: dict[str, list[str]] = {}
        for channel in missing:
            by_unit.setdefault(channel.quantity.unit, []).append(channel.quantity.symbol)
        symbols = ", ".join(f"{', '.join(part)}{f' [{unit}]' * bool(unit)}" for unit, part in by_unit.items())
        texts = [f"each of {symbols} (use --column {missing[0].quantity.symbol}=HEADER)"]
    else:
        texts = [
            f"the {channel.kind} {channel.quantity.label} (use --column {channel.quantity.symbol}=HEADER, or call "
            f"it {plain(channel.quantity.name)})"
            for channel in missing
        ]
    if needs_time and TIME not in columns:
        texts.append("times (use --column time=HEADER, or --dt)")
    if all(channel.quantity.symbol.startswith("mag_") for channel in missing):
        texts[-1] += " or --model attitude-imu"
    python = f"in Python columns={{{missing[0].quantity.symbol!r}: 'HEADER'}}"
    rule = f"{NO_COLUMN} for {' and for '.join(texts)}"
    raise ValueError(f"{rule}, but {file} has {listed(headers)}; {python}")


def sensor_of(header: str) -> tuple[str, int, str | None] | None:
    """The symbol that an axis of an inertial sensor has in models, the rank of its name, and the unit in ROS.

    The name is the last part of a header, with the one before it if it is an axis alone: "ACCELEROMETER X",
    "Gyroscope.x", "/imu/mag.magnetic_field.x". A phone's linear acceleration lacks gravity, not so ROS's.
    """
    parts = parted(header)[0].split(".")
    text = "".join(re.findall("[a-z0-9]", (parts[-1] if len(parts[-1]) > 1 else "".join(parts[-2:])).lower()))
    name, axis = text[:-1], text[-1:]
    if not axis or axis not in "xyz":
        return None
    if parts[-1] == axis and parts[-2:-1] and parts[-2] in OF_ROS:
        sensor, unit = OF_ROS[parts[-2]]
        return f"{sensor}_{axis}", 0, unit
    for sensor, names in SENSORS.items():
        if name in names:
            return f"{sensor}_{axis}", names.index(name), None
    return None


def _by_headers(columns: dict, wanted: Sequence[Wanted], headers: Sequence[str], units: Mapping[str, str]) -> None:
    used = {column.header for column in columns.values()}
    left = [header for header in headers if header not in used]
    bare = {header: parted(header) for header in left}
    by_header: dict[str, list[str]] = {}
    bases: dict[str, list[str]] = {}
    for header in left:
        by_header.setdefault(plain(header), []).append(header)
        base = plain(bare[header][0])
        for name in dict.fromkeys((base, base.lower())):
            bases.setdefault(name, []).append(header)

    def take(key: str, fitting: Sequence[str], without_unit: bool = True) -> None:
        header = None if key in columns else next((name for name in fitting if name in bare), None)
        if header is not None:
            columns[key] = Column(header, _unit(header, units) if without_unit or header in units else None)
            del bare[header]

    times = [header for header in left if bare[header][0] in TIME_NAMES]
    take(TIME, times or [header for header in left if bare[header][0].lower() in DATE_NAMES])
    counters = [header for header in left if header.lower() in COUNTERS]
    if TIME not in columns and counters:
        columns[TIME] = Column(counters[0], _unit(counters[0], units) or COUNTERS[counters[0].lower()])
        del bare[counters[0]]
    for kinds in ((INPUT, MEASUREMENT), (STATE, OUTPUT)):
        remaining = [channel for channel in wanted if channel.kind in kinds]
        for channel in remaining:
            name = plain(channel.quantity.name).lower()
            take(channel.key, [text for text in bases.get(name, []) if plain(parted(text)[0]).lower() == name])
        for channel in remaining:  # the whole header: what stands behind the line of "V_s" is no unit
            take(channel.key, by_header.get(plain(channel.quantity.symbol), []), without_unit=False)
        for channel in remaining:
            symbol = plain(channel.quantity.symbol)
            take(channel.key, [header for header in bases.get(symbol, []) if plain(parted(header)[0]) == symbol])
        sensors: dict[str, list[tuple[int, str, str | None]]] = {}
        for header in bare:
            if sensor := sensor_of(header):
                sensors.setdefault(sensor[0], []).append((sensor[1], header, sensor[2]))
        for channel in remaining:
            ranked = sorted(sensors.get(channel.quantity.symbol, []), key=lambda entry: entry[0])
            if channel.key not in columns and ranked and [rank for rank, *_ in ranked].count(ranked[0][0]) == 1:
                _, header, unit = ranked[0]
                columns[channel.key] = Column(header, _unit(header, units) or unit)
                del bare[header]
