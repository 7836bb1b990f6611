"""Units of columns: as headers have them, and converted to those of a model by the package pint."""

from __future__ import annotations

import math
import re

import numpy as np

from numerics.extras import to_install

WORDS = (
    *("V", "mV", "kV", "A", "mA", "W", "kW", "Hz", "kHz", "rpm", "rad", "mrad", "deg", "turn"),
    *("N", "mN", "kN", "kgf", "lbf", "Nm", "kg", "g", "Pa", "kPa", "bar", "K", "degC"),
    *("m", "mm", "cm", "km", "s", "ms", "us", "ns", "min", "h"),
)
PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
PREFIXED = ("V", "A", "W", "N", "N*m", "Pa", "Hz", "g", "m", "s", "rad", "K")
# Units as multiples of others; degrees Celsius are none.
MULTIPLES = {
    "rpm": ("rad/s", 2.0 * math.pi / 60.0),
    "min": ("s", 60.0),
    "h": ("s", 3600.0),
    "deg": ("rad", math.pi / 180.0),
    "turn": ("rad", 2.0 * math.pi),
}
WRITTEN = {"Nm": "N*m"}  # as pint reads them
LENGTHS = ("rad", "deg", "m", "mm", "cm", "km")  # over a time even without "_per_"
_RATE = re.compile(r"^(?P<base>.*?)_(?P<over>[A-Za-z]+)(?P<per>_per)?_(?P<under>s|min|h)(?P<power>[23]?)$")
_BRACKETS = re.compile(r"^(?P<base>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]$")


def parted(header: str) -> tuple[str, str | None]:
    """The header of a column without its unit, and the unit, None where it gives none.

    Units stand in brackets ("speed [rad/s]"), or at the end as `thruster simulate` writes them
    ("omega_m_rad_per_s", also "omega_m_rad_s"); these are of WORDS.
    """
    if found := _BRACKETS.match(header):
        return found["base"], found["unit"].strip()
    found = _RATE.match(header)
    if found and found["base"] and found["over"] in (WORDS if found["per"] else LENGTHS):
        power = f"^{found['power']}" if found["power"] else ""
        return found["base"], f"{found['over']}/{found['under']}{power}"
    base, underscore, last = header.rpartition("_")
    if underscore and base and last in WORDS:
        return base, last
    return header, None


def suffix(unit: str) -> str:
    """A unit at the end of a header: "rad_per_s" of "rad/s"; empty for a pure number."""
    return unit.replace("/", "_per_").replace("^", "").replace("*", "").replace(" ", "")


def simple(unit: str) -> tuple[str, float]:
    """A unit without prefix and the factor to it: ("V", 0.001) of "mV"; what is not known here is itself.

    Known are SI prefixes, minutes, hours, degrees, turns and rpm, also as parts of a quotient.
    """
    unit = WRITTEN.get(unit, unit)
    if unit in MULTIPLES:
        return MULTIPLES[unit]
    over, slash, under = unit.partition("/")
    if slash:
        (above, factor), (below, divisor) = simple(over), simple(under)
        return f"{above}/{below}", factor / divisor
    prefix, base = unit[:1], WRITTEN.get(unit[1:], unit[1:])
    return (base, PREFIXES[prefix]) if prefix in PREFIXES and base in PREFIXED else (unit, 1.0)


def converted(values: np.ndarray, unit: str | None, wanted: str, where: str) -> np.ndarray:
    """Convert values to another unit; unchanged where a column gives no unit, or the wanted one.

    Args:
        values: of a column.
        unit: its unit, None where it gives none.
        wanted: that of the model's quantity, empty for a pure number.
        where: the column, for messages.

    Raises:
        ValueError: if pint, which converts what `simple` does not, does not know a unit or is not installed, or it
            is one of something else.
    """
    if unit is None or unit == wanted:
        return values
    (given, factor), (target, of_wanted) = simple(unit), simple(wanted)
    if given == target:
        return values * (factor / of_wanted)
    try:
        import pint
    except ImportError:
        raise ValueError(
            f"units must be converted by pint, which is not installed ({to_install('units')}), but "
            f"{where} is in {unit!r} in place of {wanted!r}"
        ) from None
    registry = pint.application_registry.get()
    try:
        given, target = (WRITTEN.get(text, text) for text in (unit, wanted))
        return np.asarray(registry.Quantity(values, given).to(target).magnitude, dtype=np.float64)
    except pint.DimensionalityError:
        raise ValueError(
            f"the unit of {where} must be one that converts to {wanted or 'a pure number'}, but got {unit!r}"
        ) from None
    except Exception as error:  # pint raises many kinds for text that is no unit
        raise ValueError(f"the unit of {where} must be one that pint knows, but got {unit!r}: {error}") from None
