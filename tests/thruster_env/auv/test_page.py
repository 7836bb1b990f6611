"""docs/auv.md names what there is."""

import inspect
import re
from pathlib import Path

from thruster_env.auv.model import MODELS
from thruster_env.auv.parameters import PRESETS, VehicleParameters
from thruster_env.auv.plant import CHANNELS, INSTRUMENTS, SUITES, make_plant

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = "\n".join((DOCS / name).read_text(encoding="utf-8") for name in ("auv.md", "appendix/auv.md"))


def test_the_page_names_every_preset_argument_suite_and_model():
    for name in [*PRESETS, *inspect.signature(make_plant).parameters, *MODELS]:
        assert f"| `{name}` |" in PAGE
    assert all(f"`{name}`" in PAGE for name in SUITES)


def test_the_page_has_every_instrument_with_its_channels_noise_and_rate():
    for name, instrument in INSTRUMENTS.items():
        channels = ", ".join(f"`{channel}`" for channel in instrument.channels)
        row = re.search(rf"^\| `{name}` \| {channels} \| ([\d.]+) .*? \| (.*?) \|", PAGE, flags=re.MULTILINE)
        assert float(row[1]) == instrument.deviation
        assert row[2] == ("every step" if instrument.rate is None else f"{instrument.rate:g} Hz")
        assert {CHANNELS[channel].quantity.unit for channel in instrument.channels} <= set(
            re.findall(r"[\w/]+", row[0])
        )


def test_the_equations_on_the_page_have_every_coefficient():
    equations = PAGE[PAGE.index("## Equations") : PAGE.index("**Misprints**")]
    missing = {name for name in VehicleParameters._fields if not re.search(rf"\b{name}\b", equations)}
    assert not missing
