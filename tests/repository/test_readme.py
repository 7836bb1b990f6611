import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[2] / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.parametrize("code", EXAMPLES, ids=["env", "values", "number"])
def test_readme_code_runs(code, capsys):
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    if "belief" in names:
        assert names["belief"].cov.shape == (2, 2)
    elif "envs" in names:
        assert names["observations"].shape == (1000, *names["env"].observation_space.shape)
    else:
        assert "estimate" in names["info"]
        assert len(code.strip().splitlines()) <= 11
        assert "nan" not in capsys.readouterr().out


def test_every_picture_and_page_that_readme_names_is_there():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (Path(__file__).parents[2] / target).exists(), target
