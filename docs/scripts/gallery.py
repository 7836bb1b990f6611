"""The picture of docs/gallery.md: what the page's ten programs find."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from PIL import Image

from docs.scripts import DOCS, subplots
from thruster_env.core.files import BLUE, GREY, save_figure
from tuning.api.fit import SeriesFit

COLOURS = 32
QUANTITIES = {  # by the beginning of a title: the axis of values, and the unit of time where it is not a second
    "An encoder": ("angle [rad]", ""),
    "A barometer": ("altitude [m]", ""),
    "A kitchen": ("mass [g]", ""),
    "A share": ("log price", "day"),
    "The Nile": ("flow [10⁸ m³]", "year"),
    "A battery": ("voltage [V]", ""),
    "The heave": ("heave [m]", ""),
    "A room": ("temperature [°C]", "day"),
    "A tide": ("level [m]", "day"),
}
SECONDS = {"": 1.0, "year": 1.0, "day": 86400.0}  # of the fit's time: the Nile's has a step of 1
PAGE = DOCS / "gallery.md"
BLOCK = re.compile(r"\*\*\d+\. (.*?)\.\*\*.*?```python\n(.*?)```", flags=re.DOTALL)


def fits() -> dict[str, SeriesFit]:
    """What each program of the page finds, by its title."""
    text = PAGE.read_text(encoding="utf-8")
    names: dict[str, object] = {}
    exec(text.partition("```python\n")[2].partition("```")[0], names)
    results = {}
    for title, code in BLOCK.findall(text):
        exec(code, names)
        results[title] = names["fit"]
    return results


def gallery(path: Path) -> None:
    """Data, estimate and its 95 % band of each column; of the track the way."""
    figure, axes = subplots((9.0, 9.0), 5, 2)
    for axis, (title, fit) in zip(axes.T.ravel(), fits().items(), strict=True):
        _, _, _, c, d = fit.model.matrices()
        values, means = fit.column.table, fit.estimates.means[0] @ c.T + d
        axis.set_title(f"{title}: {fit.name.partition(':')[0]}", fontsize=9)
        if values.shape[1] == 2:
            axis.plot(*values.T, ".", markersize=2, color=GREY)
            axis.plot(*means.T, color=BLUE, linewidth=1.2)
            axis.set_xlabel("east [m]")
            axis.set_ylabel("north [m]")
            continue
        label, unit = next(pair for begin, pair in QUANTITIES.items() if title.startswith(begin))
        times = fit.column.dt * np.arange(len(values)) / SECONDS[unit]
        band = 1.96 * np.sqrt(np.einsum("i,kij,j->k", c[0], fit.estimates.covs[0], c[0]))
        axis.plot(times, values[:, 0], ".", markersize=2, color=GREY)
        axis.plot(times, means[:, 0], color=BLUE, linewidth=1.2)
        axis.fill_between(times, means[:, 0] - band, means[:, 0] + band, color=BLUE, alpha=0.3, linewidth=0)
        axis.set_ylim(np.nanmin(values), np.nanmax(values))  # the band begins wide
        axis.set_xlabel(f"time [{unit or 's'}]")
        axis.set_ylabel(label)
    save_figure(figure, path)
    with Image.open(path) as picture:
        few = picture.convert("RGB").quantize(COLOURS)
    few.save(path, optimize=True)


FIGURES = {"gallery.png": gallery}
