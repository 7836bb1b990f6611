"""docs/machine_code.md shows the code that the program makes, and its example runs."""

import re
from pathlib import Path

import numpy as np
import pytest

from pages.machine_code_figure import FIGURES, TABLES

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "machine_code.md").read_text()


@pytest.mark.parametrize("name", TABLES)
def test_a_piece_of_code_is_that_of_the_program(name):
    assert f"<!-- table {name} -->\n{TABLES[name]()}\n<!-- end -->" in PAGE


def test_what_is_written_out_for_two_states_is_the_prediction_of_an_extended_filter():
    written = PAGE.partition("<!-- table prediction -->")[2].partition("<!-- end -->")[0]
    multiply, transposed, add = re.findall(r"^def .*?(?=^#|^```)", written, flags=re.MULTILINE | re.DOTALL)
    names = {}
    for name, text in {"multiply": multiply, "transposed": transposed, "add": add}.items():
        exec(text.replace(text.split("(")[0], f"def {name}", 1), names)
    f, p, q = ((1.0, 0.5), (-0.25, 2.0)), ((3.0, 1.0), (1.0, 2.0)), ((0.1, 0.0), (0.0, 0.2))
    predicted = names["add"](names["transposed"](names["multiply"](f, p), f), q)
    np.testing.assert_allclose(predicted, ((4.6, 3.125), (3.125, 7.3875)), rtol=1e-15)  # by hand


def test_the_picture_is_there_and_light():
    assert set(FIGURES) == set(re.findall(r"!\[.*?\]\((.*?)\)", PAGE))
    assert all((DOCS / name).stat().st_size < 150_000 for name in FIGURES)


def test_its_example_tells_what_a_compiled_step_tells():
    (code,) = (block for block in re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL) if "import" in block)
    names = {}
    exec(compile(code, "docs/machine_code.md", "exec"), names)
    expected = names["ekf"].predict(names["ekf"].init(), [12.0])
    np.testing.assert_allclose(names["belief"].mean, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(names["belief"].cov, expected.cov, rtol=1e-12)
