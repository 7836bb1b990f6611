"""`thruster inspect`: a thruster at an operating point, beside its published linear model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np

from thruster_env.core.checks import within
from thruster_env.core.text_tables import Table
from thruster_env.logs.write import check_picture
from thruster_env.thruster.analysis import (
    INPUTS,
    Analysis,
    LinearModel,
    SteadyState,
    analyse,
    frequency_response,
    linear_model,
    response_figure,
    response_grids,
    state_range,
    steady_state,
    step_response,
)
from thruster_env.thruster.linear import NO_LINEARISATION, PUBLISHED, SAMPLE_TIME, PublishedLinearModel
from thruster_env.thruster.plant import DEFAULT_DT, DEFAULT_MAX_VOLTAGE, Plant, make_plant
from tuning.api.markers import INPUT, OUTPUT, WRITTEN, Option, PresetOption
from tuning.api.result import Printed
from tuning.cli.output import warn_beyond

GAIN_UNITS = {"V_s": "N/V", "U_0": "N s/m"}  # of thrust over each input
OUTPUTS = ("omega_m [rad/s]", "U_a [m/s]", "T [N]")


def command(
    preset: Annotated[str, PresetOption] = "tunnel",
    voltage: Annotated[float, Option(INPUT)] = 12.0,
    ambient_velocity: Annotated[float, Option(INPUT)] = 0.0,
    dt: Annotated[float, Option(INPUT)] = DEFAULT_DT,
    max_voltage: Annotated[float, Option(INPUT)] = DEFAULT_MAX_VOLTAGE,
    out: Annotated[Path | None, Option(OUTPUT, metavar="FILE", file=WRITTEN)] = None,
) -> Printed:
    """Print, and draw, a thruster's linear model at a voltage: steady state, stiffness, control, responses.

    Example: thruster inspect --preset tunnel --voltage 12 --out tunnel.png

    Args:
        preset: the thruster:
        voltage: operating voltage [V].
        ambient_velocity: ambient flow along the axis U_0 [m/s].
        dt: sample time [s].
        max_voltage: voltage range the integration must follow [V].
        out: also draw a Bode plot and the step response: .png, .svg or .pdf.
    """
    if out is not None:
        check_picture(out, "--out")
    plant = make_plant(preset, dt, max_voltage, ambient_velocity)
    voltage = within("voltage", voltage, max_voltage)
    warn_beyond(preset, voltage)
    point = steady_state(plant.parameters, voltage, ambient_velocity)
    spread = state_range(plant.parameters, max_voltage)
    ours = analyse(linear_model(plant.parameters, point[:2], voltage, ambient_velocity), dt, spread)
    title = f"Preset {preset} at {voltage:g} V, U_0 = {ambient_velocity:g} m/s, dt = {dt:g} s"
    columns, words, published = {"this thruster": ours}, [], None
    for name, model in PUBLISHED.items():
        if preset in model.presets:
            theirs = analyse(LinearModel(*map(np.array, (model.a, model.b, model.c))), dt, spread)
            columns[f"published: {name}"] = theirs
            words = ["", f"{NO_LINEARISATION} {model.remark} Source: {model.source}."]
            published = _plain_published(name, model, theirs)
    if out is not None:
        response_figure(out, ours.model, dt, title.replace("U_0", "$U_0$"))
        words += ["", f"Bode plot and step response: {out}"]
    data = {
        "preset": preset,
        "voltage": voltage,
        "ambient_velocity": ambient_velocity,
        "dt": dt,
        "steady_state": dict(zip(("omega_m [rad/s]", "U_a [m/s]", "thrust [N]"), point, strict=True)),
        "range": spread,
        "substeps": plant.substeps,
        **_plain_analysis(ours),
        **_plain_responses(ours.model),
        "published": published,
        "picture": None if out is None else str(out),
    }
    return Printed([title, _point_table(point, spread, ours, plant), _model_table(columns), *words], data)


def _point_table(point: SteadyState, spread: np.ndarray, analysis: Analysis, plant: Plant):
    rows = [
        ["steady motor speed omega_m [rad/s]", f"{point.omega_m:.4g}"],
        ["steady flow velocity U_a [m/s]", f"{point.U_a:.4g}"],
        ["steady thrust T [N]", f"{point.thrust:.4g}"],
        ["range of omega_m over the voltages [rad/s]", f"{spread[0]:.4g}"],
        ["range of U_a over the voltages [m/s]", f"{spread[1]:.4g}"],
        ["stiffness: largest |eigenvalue| dt", f"{np.abs(analysis.eigenvalues).max() * plant.dt:.3g}"],
        ["Runge-Kutta substeps a sample time", str(plant.substeps)],
    ]
    return Table("", ["quantity", "value"], rows)


def _model_table(columns: dict[str, Analysis]):
    labels = [
        "A = d rates/d(omega_m, U_a)",
        "B = d rates/d(V_s, U_0)",
        "C = dT/d(omega_m, U_a)",
        "A_d, zero-order hold over dt",
        "B_d",
        "eigenvalues of A [1/s]",
        "controllability from V_s *",
        "observability from T *",
        "characteristic polynomial",
        *(f"... times T/{name} [{GAIN_UNITS[name]}]" for name in INPUTS),
        *(f"settled T/{name} [{GAIN_UNITS[name]}]" for name in INPUTS),
    ]
    rows = [list(row) for row in zip(labels, *map(_model_cells, columns.values()), strict=True)]
    caption = "* rank, condition number of the sampled pair, each state scaled by its range"
    return Table("Linear model in rad/s, m/s, V, N, s", ["quantity", *columns], rows, caption=caption)


def _model_cells(analysis: Analysis) -> list[str]:
    return [
        *(_matrix(matrix) for matrix in (*analysis.model, analysis.a_d, analysis.b_d)),
        _eigenvalues(*analysis.eigenvalues),
        *(f"{rank}, {condition:.3g}" for rank, condition in (analysis.controllability, analysis.observability)),
        _polynomial(analysis.denominator),
        *(_polynomial(analysis.numerators[name]) for name in INPUTS),
        *(f"{gain:.5g}" if np.isfinite(gain) else "none: not stable" for gain in analysis.dc_gain[2]),
    ]


def _matrix(matrix: np.ndarray) -> str:
    # 0.0 is added because "-0" would puzzle
    return "\n".join(" ".join(f"{value + 0.0:11.5g}" for value in row) for row in matrix)


def _eigenvalues(first: complex, second: complex) -> str:
    if first.imag:  # a conjugate pair
        return f"{first.real:.5g} ± {abs(first.imag):.5g}j"
    return _matrix(np.array([[first.real, second.real]]))


def _polynomial(coefficients: np.ndarray) -> str:
    """Falling powers of s as text, without the terms that are zero."""
    text = ""
    for value, power in zip(coefficients, (" s^2", " s", ""), strict=True):
        if value:
            size = f"{abs(value):.5g}{power}".removeprefix("1 ")
            sign = ("- " if text else "-") if value < 0 else ("+ " if text else "")
            text += f" {sign}{size}"
    return text.strip() or "0"


def _plain_analysis(analysis: Analysis) -> dict:
    model = analysis.model
    pairs = {"controllability": analysis.controllability, "observability": analysis.observability}
    return {
        "inputs": ["V_s [V]", "U_0 [m/s]"],
        "A": model.a,
        "B": model.b,
        "C": model.c,
        "A_d": analysis.a_d,
        "B_d": analysis.b_d,
        "eigenvalues": [[value.real, value.imag] for value in analysis.eigenvalues],
        **{name: {"rank": rank, "condition_number": number} for name, (rank, number) in pairs.items()},
        "transfer_functions": {
            f"T/{name} [{GAIN_UNITS[name]}]": {
                "numerator": analysis.numerators[name],
                "denominator": analysis.denominator,
            }
            for name in INPUTS
        },
        "dc_gain": dict(zip(OUTPUTS, analysis.dc_gain, strict=True)),
    }


def _plain_responses(model: LinearModel) -> dict:
    frequencies, times = response_grids(model)
    bode: dict[str, Any] = {"frequency [rad/s]": frequencies}
    step: dict[str, Any] = {"time [s]": times}
    for name in INPUTS:
        gain = frequency_response(model, frequencies, name)
        bode[f"T/{name}"] = {
            f"magnitude [{GAIN_UNITS[name]}]": np.abs(gain),
            "phase [deg]": np.rad2deg(np.unwrap(np.angle(gain))),
        }
        step[name] = dict(zip(OUTPUTS, step_response(model, times, name).T, strict=True))
    return {"bode": bode, "step": step}


def _plain_published(name: str, published: PublishedLinearModel, analysis: Analysis) -> dict:
    printed = {"dt": SAMPLE_TIME, "A_d": published.printed_a_d, "B_d": published.printed_b_d}
    words = {"source": published.source, "remark": published.remark, "statement": NO_LINEARISATION}
    return {"name": name, **_plain_analysis(analysis), "printed": printed, **words}
