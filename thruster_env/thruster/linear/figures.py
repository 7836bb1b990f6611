"""Pictures of a thruster's responses, each saved as one PNG file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from thruster_env.core.plots import BLUE, DARK, RUST, new_figure, save_figure, tidy
from thruster_env.thruster.linear.analysis import (
    LinearModel,
    dc_gain,
    frequency_response,
    response_grids,
    step_response,
)

STATES = (("motor speed $\\omega_m$", "rad/s"), ("flow velocity $U_a$", "m/s"))


def response_figure(path: str | Path, model: LinearModel, dt: float, title: str) -> Path:
    """Bode plot of the thrust over the voltage, and the response to a step of 1 V.

    Marked are the frequencies of the eigenvalues and the Nyquist frequency pi/dt, and the values that the
    step settles to.

    Args:
        path: PNG file to write.
        model: the thruster near an operating point.
        dt: sample time [s].
        title: said above the picture.

    Raises:
        ValueError: if the voltage does not move the thrust to first order, as at rest, or nothing can be written.
    """
    frequencies, times = response_grids(model)
    gain = frequency_response(model, frequencies)
    if not gain.all():
        rule = "the thrust must move with the voltage for its Bode plot to be drawn (at rest it does not)"
        raise ValueError(f"{rule}, but got C = {model.c[0].tolist()}")
    figure = new_figure((9.6, 6.0))
    left, right = figure.subfigures(1, 2)
    _draw_bode(left.subplots(2, 1, sharex=True), frequencies, gain, np.linalg.eigvals(model.a), dt)
    _draw_step(right.subplots(3, 1, sharex=True), times, step_response(model, times), model)
    for part in (left, right):
        part.align_ylabels()
    figure.suptitle(title, fontsize=11)
    return save_figure(figure, path)


def _draw_bode(axes, frequencies, gain, eigenvalues, dt) -> None:
    from matplotlib.ticker import MaxNLocator

    tidy(axes)
    magnitude, phase = axes
    magnitude.loglog(frequencies, np.abs(gain), color=BLUE)
    phase.semilogx(frequencies, np.rad2deg(np.unwrap(np.angle(gain))), color=BLUE)
    for axis in axes:
        for place, value in enumerate(np.abs(eigenvalues)):
            axis.axvline(value, color=DARK, linestyle=":", linewidth=1, label="" if place else "eigenvalues")
        axis.axvline(np.pi / dt, color=RUST, linestyle="--", linewidth=1, label=f"Nyquist, dt = {dt:g} s")
    magnitude.set_title("thrust over voltage", fontsize=10)
    magnitude.set_ylabel("magnitude [N/V]")
    magnitude.legend(loc="lower left", fontsize=9, framealpha=1, edgecolor="none")
    phase.yaxis.set_major_locator(MaxNLocator(6, steps=[1.5, 3, 4.5, 9, 10]))
    phase.set_ylabel("phase [deg]")
    phase.set_xlabel("frequency [rad/s]")


def _draw_step(axes, times, response, model) -> None:
    tidy(axes)
    labels = (*STATES, ("thrust $T$", "N"))
    for axis, (label, unit), values, settled in zip(axes, labels, response.T, dc_gain(model)[:, 0], strict=True):
        axis.axhline(settled, color=DARK, linestyle=":", linewidth=1, label="settled")
        axis.plot(times, values, color=BLUE)
        axis.set_ylabel(f"{label}\n[{unit}]")
    axes[0].set_title("deviation after a step of 1 V", fontsize=10)
    axes[0].legend(frameon=False, fontsize=9)
    axes[-1].set_xlabel("time [s]")
