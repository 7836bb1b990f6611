"""docs/boat.md: every line is run, from ULogs to C code on the emulated controller that flags a stuck sensor."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyulog")
from tests.thruster_env.logs.recorders.files import write_ulog

PAGE = (Path(__file__).parents[2] / "docs" / "boat.md").read_text()
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
CONTROLLER = "arm-none-eabi-gcc", "qemu-system-arm"
FROZEN = 1000  # row of the fourth dive from which on the load cell repeats its reading


def dive(folder, number, command):
    """Record a dive as a ULog, by pyulog's own writer."""
    log = folder / f"truth{number}.csv"
    command("simulate", "--preset", "tunnel_physical", "--steps", 1500, "--seed", number, "--out", log)
    table = np.genfromtxt(log, delimiter=",", names=True)
    force, stamps = table["measured_thrust_N"].copy(), np.round(5e6 + 1e6 * table["time_s"]).astype(np.uint64)
    if number == 4:
        force[FROZEN:] = force[FROZEN]
    volts = {"output[0]": table["voltage_V"], "output[1]": np.zeros(1501)}
    topics = [
        ("actuator_outputs", 0, "float[2] output;", {"timestamp": stamps, **volts}),
        ("load_cell", 0, "float force;", {"timestamp": stamps + 2, "force": force}),
    ]
    write_ulog(folder / f"dive{number}.ulg", topics)


@pytest.mark.slow
def test_every_line_leads_to_the_alarm(tmp_path, thruster):
    def run(words):
        if words[0] == "thruster":
            done = thruster(*words[1:])
        else:
            done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode in (0, 3), (words, done.stdout, done.stderr)  # 3: no trial of so few was consistent
        return done.stdout

    for number in (1, 2, 3, 4):
        dive(tmp_path, number, thruster)
    printed = {}
    for language, code in BLOCKS:
        if language == "c":
            (tmp_path / "loop.c").write_text(code)
        elif language == "python":
            printed["python"] = run([sys.executable, "-c", code])
        else:
            for line in code.replace("\\\n", " ").splitlines():
                if line.startswith(CONTROLLER) and not all(map(shutil.which, CONTROLLER)):
                    continue
                assert line.split()[0] in ("thruster", "cc", "./bow_log", "tail", *CONTROLLER), line
                name = " ".join(line.split()[:2])
                words = shlex.split(line.replace("--trials 40", "--trials 3"))
                printed[name] = run(words if name.startswith("thruster") else ["sh", "-c", line])
    assert "load_cell.force" in printed["thruster log"] and "actuator_outputs.output[0]" in printed["thruster log"]
    said = " ".join(printed["thruster estimate"].split())
    assert "thrust: equal readings since 15 s, found at 15.09 s (stuck)" in said
    assert printed["tail -n"].startswith("step 1010: the load cell is stuck")
    lines = printed["python"].splitlines()
    assert len(lines) == 2 + all(map(shutil.which, CONTROLLER))
    assert all(line.endswith("first alarm at 15.090002 s") for line in lines), lines
    if not all(map(shutil.which, CONTROLLER)):
        pytest.skip(
            "all but the controller was run, for gcc-arm-none-eabi or qemu-system-arm of Debian is missing"
        )
