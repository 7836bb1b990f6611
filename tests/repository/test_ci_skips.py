"""With CI set, a test skipped for a missing package fails the run; nothing else does."""

from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

MISSING = {
    "test_call": "import pytest\ndef test_one():\n    pytest.importorskip('no_such_package')\n",
    "test_module": "import pytest\npytest.importorskip('no_such_package')\ndef test_one(): pass\n",
    "test_mark": (
        "import pytest\n@pytest.mark.skipif(True, reason='torch is not installed')\ndef test_one(): pass\n"
    ),
}
HARMLESS = {
    "test_skip": "import pytest\ndef test_one():\n    pytest.skip('only on Windows')\n",
    "test_xfail": "import pytest\n@pytest.mark.xfail\ndef test_one():\n    import no_such_package\n",
}


@pytest.fixture
def run(pytester, monkeypatch):
    pytester.makeconftest((Path(__file__).parents[1] / "conftest.py").read_text())

    def run(files, ci, *args):
        monkeypatch.setenv("CI", ci)
        pytester.makepyfile(test_fine="def test_fine(): pass", **files)
        return pytester.runpytest(*args)

    return run


@pytest.mark.parametrize("args", [(), ("-n", "1")], ids=["one process", "xdist"])
def test_a_missing_package_fails_in_ci(run, args):
    result = run(MISSING, "true", *args)
    result.assert_outcomes(passed=1, skipped=3)
    for name in MISSING:
        result.stdout.re_match_lines_random(f"FAILED, a package is missing: {name}.py.*: .+")
    assert result.ret == pytest.ExitCode.TESTS_FAILED


def test_only_missing_packages_in_a_run_fail_it_too(run):
    result = run(MISSING, "true", "test_module.py")
    assert result.ret == pytest.ExitCode.TESTS_FAILED


@pytest.mark.parametrize(("files", "ci"), [(MISSING, ""), (HARMLESS, "true")], ids=["no CI", "other skips"])
def test_anything_else_passes(run, files, ci):
    result = run(files, ci)
    assert result.ret == pytest.ExitCode.OK
    result.stdout.no_fnmatch_line("FAILED, a package is missing*")
