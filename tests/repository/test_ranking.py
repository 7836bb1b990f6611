"""Where filters differ: each claim in a quick form whose paired interval leaves no doubt, and its page."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from docs.scripts import made_by, main
from docs.scripts.ranking import DISCUSSED, by_default, ratios_of, scenarios
from filters.registry import FILTERS
from thruster_env.core.text_tables import with_tables
from tuning.evaluation.compare import compare, contender
from tuning.problems.data import held_out_seeds
from tuning.problems.excitation import EXCITATIONS
from tuning.thruster.scenario import SCENARIOS, find_scenario


def ranked(name, contenders, seeds=24):
    """Rows of a leaderboard by label."""
    (board,), _ = compare(contenders, [find_scenario(name)], held_out_seeds(0, seeds))
    return {row.label: row for row in board.rows}


@pytest.mark.slow
def test_with_a_tachometer_without_a_sign_the_particle_filter_beats_the_ekf():
    rows = ranked("speed_magnitude", [contender("ekf"), contender("pf", ensemble_size=2000)], 12)
    assert rows["pf 2000"].ratios[0].high < 0.9  # omega_m, whose sign is in question
    assert rows["pf 2000"].evaluation.log_likelihood > rows["ekf"].evaluation.log_likelihood + 10


def test_a_robust_update_beats_the_ekf_among_outliers():
    rows = ranked("outliers", [contender("ekf"), contender("ekf-robust")])
    assert max(ratio.high for ratio in rows["ekf-robust"].ratios) < 0.8
    assert np.max(rows["ekf-robust"].above_bound) < 0.1
    assert rows["ekf-robust"].evaluation.nees.value < 3 < rows["ekf"].evaluation.nees.value


def test_estimating_an_unknown_flow_beats_the_ekf_that_believes_in_none():
    rows = ranked("ambient", [contender("ekf"), contender("ekf", unknown={"ambient_velocity": None})])
    joint = rows["ekf + U_0"]
    assert max(ratio.high for ratio in joint.ratios) < 0.97 and joint.score_ratio.high < 0.9
    assert joint.evaluation.nees.value < 3 < rows["ekf"].evaluation.nees.value


@pytest.fixture(scope="module")
def published_noise():
    contenders = [contender("ekf"), contender("iekf"), contender("enkf", ensemble_size=100), contender("gsf")]
    contenders += [contender("ienkf", ensemble_size=100), contender("pf")]
    return ranked("published_noise", contenders)


def test_with_the_published_noise_the_ekf_is_overconfident(published_noise):
    assert published_noise["ekf"].evaluation.nees.low > 15
    assert published_noise["ekf"].above_bound[1] > 5


def test_there_an_ensemble_of_100_has_at_most_seven_tenths_of_its_error(published_noise):
    assert published_noise["enkf 100"].ratios[1].high < 0.7
    assert 2 < published_noise["enkf 100"].evaluation.nees.value < 3


@pytest.mark.parametrize("label", ["pf 1000", "gsf", "ienkf 100"])
def test_there_a_filter_that_sees_two_modes_or_iterates_has_at_most_half_of_its_error(label, published_noise):
    assert published_noise[label].ratios[1].high < 0.5
    assert published_noise[label].ratios[1].high < published_noise["enkf 100"].ratios[1].low


def test_there_iteration_brings_the_ekf_to_half_and_an_honest_covariance(published_noise):
    assert published_noise["iekf"].ratios[1].high < 0.55
    assert published_noise["iekf"].evaluation.nees.value < 3


DOCS = Path(__file__).parents[2] / "docs"
PAGE = "\n".join((DOCS / name).read_text() for name in ("ranking.md", "appendix/ranking.md"))


def table(name):
    """Cells of a table of the page, by filter or scenario."""
    return cells_of(re.search(rf"<!-- table {name} -->\n(.*?)\n<!-- end -->", PAGE, flags=re.DOTALL)[1])


def cells_of(text):
    """Cells of a table, by the first one of a row."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:]]
    return {cells[0]: cells[1:] for cells in rows}


def upper(cell):
    """Upper end of "value ± half width"."""
    value, half_width = map(float, cell.split(" ± "))
    return value + half_width


def center(cell):
    """The value of "value ± half width"."""
    return float(cell.split(" ± ")[0])


def test_the_page_has_every_table_and_they_show_the_claims_on_200_seeds():
    assert set(re.findall(r"<!-- table (\w+) -->", PAGE)) == set(made_by("ranking", "TABLES"))
    published = table("published")
    assert float(published["ekf"][4]) > 20
    assert upper(published["enkf 100"][3]) < 0.7
    assert max(upper(published[name][3]) for name in ("pf 1000", "pf 5000", "gsf", "ienkf 100")) < 0.5
    assert upper(table("speed")["pf 5000"][1]) < 0.85
    assert max(upper(table("outliers")["ekf-robust"][i]) for i in (1, 3)) < 0.7
    assert max(upper(table("ambient")["ekf + U_0"][i]) for i in (1, 3)) < 1
    assert upper(table("reference")["pf 1000"][3]) < 1.02
    elsewhere = table("network_elsewhere")
    *networks, gain = map(float, elsewhere["`dropout`"])
    assert min(networks) > 5 > 1.05 > gain and "**" in elsewhere["`mismatch`"][0]
    conditional, accurate = table("conditional"), table("accurate")
    assert all(center(conditional["rbpf 100"][i]) < 1.01 * center(conditional["pf 1000"][i]) for i in range(2))
    assert all(center(accurate["pf 1000 optimal"][i]) <= center(accurate["pf 10000"][i]) for i in range(2))
    assert upper(table("constants")["pf 300 smoothed + U_0"][3]) < center(table("constants")["pf 300 + U_0"][3])
    assert len(table("scores")) == len(SCENARIOS) - len(DISCUSSED)
    rows = table("network_mismatch")
    assert upper(rows["gru"][1]) < upper(rows["recursive-kalmannet"][1]) < 0.5 < center(rows["ekf, tuned"][1])
    assert 1.9 < float(rows["recursive-kalmannet"][4]) < 2.2 and upper(rows["ekf + lift and K2, tuned"][1]) < 0.35
    rows = table("network_outliers")
    assert upper(rows["kalmannet"][1]) < center(rows["ekf, tuned"][1]) < center(rows["gru"][1]) < 1
    for oracle_of, network, *learned in (map(float, one) for one in table("network_papers").values()):
        assert network > oracle_of + 2 and max(learned) < oracle_of + 0.5
    batches = table("batch_reactor")
    assert float(batches["mhe, L = 30"][0]) < 0.1 * min(
        float(one[0]) for name, one in batches.items() if "kf" in name
    )
    assert batches["mhe, L = 30"][2:] == ["0", "0 of 200"] and float(batches["ekf"][2]) < 0


def test_the_table_of_all_filters_has_each_of_them_and_the_script_s_numbers():
    page, problems = table("every_filter"), ("nominal", "outliers")
    assert set(page) == {by_default(name).label for name in FILTERS}
    without_places = contender("letkf", radius=2.0, ensemble_size=4)  # of which the thruster has none
    filters = [*map(by_default, ("kf", "iekf", "ekf-robust", "inversion")), without_places]
    found = cells_of(ratios_of(filters, problems))
    assert found.pop(without_places.label)[:2] == ["-", "-"]
    for label, (*cells, _) in found.items():
        assert cells == [page[label][DISCUSSED.index(name)] for name in problems]


def test_only_the_tables_that_are_asked_for_are_made_anew(tmp_path):
    page = "<!-- table scenarios -->\n<!-- end --> <!-- table speed -->\nold\n<!-- end -->"
    made = f"<!-- table scenarios -->\n{scenarios()}\n<!-- end --> <!-- table speed -->\nold\n<!-- end -->"
    assert with_tables(page, {"scenarios": scenarios}) == made
    (tmp_path / "ranking.md").write_text(page)
    arguments = ["ranking", "--table", "scenarios", "--out", str(tmp_path)]
    assert main([*arguments, "--check"]) == 1 and (tmp_path / "ranking.md").read_text() == page
    assert main(arguments) == 0 and (tmp_path / "ranking.md").read_text() == made
    assert main([*arguments, "--check"]) == 0
    assert scenarios() in PAGE


def test_the_page_has_every_excitation_with_its_arguments():
    for name, kind in EXCITATIONS.effects.items():
        (line,) = [
            line for line in PAGE.splitlines() if line.startswith(f"| `{name}` | ") and line.count("|") == 4
        ]
        for field in dataclasses.fields(kind):
            assert f"`{field.name}` = `{field.default}`" in line


def test_the_page_s_scenario_file_can_be_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE, flags=re.DOTALL)
    (tmp_path / "my.toml").write_text(text)
    scenario = find_scenario("my.toml")
    assert scenario.excitation.name == "prbs" and scenario.scale[1] < find_scenario("nominal").scale[1]
