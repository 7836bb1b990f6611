"""How a vehicle env draws itself."""

from __future__ import annotations

from plants.rendered import RenderedEnv


class RenderedVehicle(RenderedEnv):
    """An env with a vehicle as `plant`."""
