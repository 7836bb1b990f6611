"""Names of a user's that are formulas, markup or very long: figures, tables, pages and the terminal show them."""

import io

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

import tuning
from thruster_env.core.text_tables import verbatim
from thruster_env.model.affine import affine_model
from thruster_env.model.quantities import Quantity
from tuning.api.progress import working
from tuning.reporting.page import Table, markdown_page

ODD = [
    r"$\frac$",
    "[/]",
    "[bold]x[/bold]",
    "a|b",
    "<b>x</b>",
    "[x](http://y)",
    r"$\alpha$ and $",
    "&lt;",
    "n" * 400,
]


def model(name, unit="N"):
    return affine_model(
        A=[[0.9]],
        B=[[0.5]],
        C=[[1.0]],
        Q=[0.01],
        R=[0.04],
        P0=[1.0],
        states=[(name, "x", unit)],
        input_quantities=[(name, "u", unit)],
        measurements=[(f"{name} read", "z", unit)],
    )


@pytest.mark.parametrize("name", ODD)
def test_labels_of_figures_show_a_name_as_it_is(name):
    figure = Figure()
    axis = figure.subplots()
    axis.set_title(verbatim(name, most=90))
    axis.set_ylabel(Quantity(name, "omega_m", name[:20]).plot_label)
    figure.savefig(io.BytesIO(), format="svg")
    assert verbatim(name).replace(r"\$", "$") == name and len(verbatim(name, most=90)) < 100
    assert verbatim("log L of the\ninnovations\a") == "log L of the\ninnovations?"


@pytest.mark.parametrize("name", [r"$\frac$", "[/]", "n" * 400])
def test_a_log_of_odd_names_is_drawn(name):
    rng = np.random.default_rng(0)
    table = {"t": 0.1 * np.arange(200), "u": rng.normal(size=200), "z": rng.normal(size=200), "x": np.zeros(200)}
    found = tuning.estimate((model(name, unit=r"$\frac"), table))
    for figure in (found.plot_states(), found.plot_innovations()):
        figure.savefig(io.BytesIO(), format="png")


@pytest.mark.parametrize("name", ODD)
def test_names_are_no_markup_where_work_is_shown(name):
    stream = io.StringIO()
    with working(name, Console(file=stream, force_terminal=True, width=500)):
        pass
    assert name.split()[0] in stream.getvalue()


def test_names_are_text_in_markdown_and_html():
    for name in ODD:
        page = markdown_page(name, [name, Table(name, ["", name], [[name, name]])])
        for raw in ("[x](http", "<b>", "| a|b", "$"):
            at = page.find(raw)
            assert at < 0 or page[at - 1] == "\\" or raw == "| a|b"
        assert "a|b" not in page and "&lt;" not in page and "\n$" not in page
        assert "<b>" not in Table(name, ["", name], [[name, name]]).html()
