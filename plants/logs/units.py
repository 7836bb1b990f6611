"""Units of columns: as headers have them, and converted to those of a model by the package pint."""

from __future__ import annotations

import re

import numpy as np

from numerics.extras import to_install

WORDS = (
    *("V", "mV", "kV", "A", "mA", "W", "kW", "Hz", "kHz", "rpm", "rad", "mrad", "deg", "turn"),
    *("N", "mN", "kN", "kgf", "lbf", "Nm", "kg", "g", "Pa", "kPa", "bar", "K", "degC"),
    *("m", "mm", "cm", "km", "s", "ms", "us", "ns", "min", "h"),
)
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


def converted(values: np.ndarray, unit: str | None, wanted: str, where: str) -> np.ndarray:
    """Convert values to another unit; unchanged where a column gives no unit, or the wanted one.

    Args:
        values: of a column.
        unit: its unit, None where it gives none.
        wanted: that of the model's quantity, empty for a pure number.
        where: the column, for messages.

    Raises:
        ValueError: if pint, which converts, does not know a unit or is not installed, or it is one of something
            else.
    """
    if unit is None or unit == wanted:
        return values
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
