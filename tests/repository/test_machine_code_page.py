"""docs/machine_code.md shows the code that the program makes, and says of the example what is so."""

import re
from pathlib import Path

import numpy as np
import pytest

from docs.scripts.machine_code import TABLES, body
from filters import ExtendedKalmanFilter
from filters.differentiated import Memory, Wanted, stages_of
from filters.pages.kernels import as_programs
from filters.pages.page import Equations
from thruster_env.model.traced import MOST

PAGE = (Path(__file__).parents[2] / "docs" / "machine_code.md").read_text()


@pytest.mark.parametrize("name", TABLES)
def test_a_piece_of_code_is_that_of_the_program(name):
    assert f"<!-- table {name} -->\n{TABLES[name]()}\n<!-- end -->" in PAGE


def test_the_program_on_the_page_is_the_prediction():
    rows, names = np.zeros((60, 1)), {"abs": abs, "where": np.where}
    numbers, rows[:2, 0] = np.zeros(40), (2.0, 0.5)
    numbers[9] = 0.5  # the drag
    text = TABLES["program"]().strip("`\n").removeprefix("python")
    exec(text, names | {"rows": rows, "numbers": numbers, "given": [1.0]})
    f = 1 - 0.1 * 2 * 0.5 * 2.0  # by hand, for x > 0
    np.testing.assert_allclose(rows[:2, 0], (2.0 - 0.1 * (0.5 * 4.0 - 1.0), f * f * 0.5), rtol=1e-14)


def test_the_programs_of_its_derivatives_are_the_prediction_s():
    model = body()
    memory = Memory(model.shape, ExtendedKalmanFilter.page)
    equations = Equations(model.functions, memory, constants_move=True, trace=True)
    wanted = Wanted(information=False, constants=True, tails=False)
    both = as_programs(stages_of(memory, equations, wanted)[0], memory.length, MOST)
    values, slopes = ("\n".join(program.text) for program in (both.values, both.slopes))
    rows, change = np.zeros((60, 1)), np.zeros((4, 1))
    numbers, move = np.zeros(40), np.zeros(10)
    names = {"rows": rows, "change": change, "numbers": numbers, "move": move, "abs": abs, "where": np.where}
    rows[:2, 0], rows[4, 0], change[:2, 0], move[2] = (2.0, 0.5), 1.0, (0.1, 0.2), 0.3
    numbers[9] = 0.5  # the drag
    exec(f"{values}\n{slopes}", names)
    f, df = 1 - 0.1 * 2 * 0.5 * 2.0, -0.1 * 2 * (0.3 * 2.0 + 0.5 * 0.1)  # by hand, for x > 0
    np.testing.assert_allclose(rows[2:4, 0], (2.0 - 0.1 * (0.5 * 4.0 - 1.0), f * f * 0.5), rtol=1e-14)
    expected = f * 0.1 - 0.1 * 0.3 * 4.0, f * f * 0.2 + 2 * f * df * 0.5
    np.testing.assert_allclose(change[:2, 0], expected, rtol=1e-14)


def test_its_example_tells_what_a_compiled_step_tells():
    (code,) = (part for part in re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL) if "import" in part)
    names = {}
    exec(compile(code, "docs/machine_code.md", "exec"), names)
    expected = names["ekf"].predict(names["ekf"].init(), [12.0])
    np.testing.assert_allclose(names["belief"].mean, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(names["belief"].cov, expected.cov, rtol=1e-12)
