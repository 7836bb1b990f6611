"""docs/machine_code.md shows the code that the program makes, and says of the example what is so."""

import re
from pathlib import Path

import numpy as np
import pytest

from docs.scripts.machine_code import TABLES

PAGE = (Path(__file__).parents[2] / "docs" / "machine_code.md").read_text()


@pytest.mark.parametrize("name", TABLES)
def test_a_piece_of_code_is_that_of_the_program(name):
    assert f"<!-- table {name} -->\n{TABLES[name]()}\n<!-- end -->" in PAGE


def test_its_example_tells_what_a_compiled_step_tells():
    (code,) = (part for part in re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL) if "import" in part)
    names = {}
    exec(compile(code, "docs/machine_code.md", "exec"), names)
    expected = names["ekf"].predict(names["ekf"].init(), [12.0])
    np.testing.assert_allclose(names["belief"].mean, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(names["belief"].cov, expected.cov, rtol=1e-12)
