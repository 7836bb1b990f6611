"""What each guided scene says is so."""

import pytest

from tuning.exploring.bench import SCENES

every_scene = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)


@every_scene
def test_one_sees_what_a_scene_says(scene):
    before, after = scene.view(0), scene.view(len(scene.steps) - 1)
    for one in scene.seen:
        ratio = after.figures[one.figure].value / before.figures[one.figure].value
        assert one.low <= ratio <= one.high, one.figure


@every_scene
def test_a_scene_moves_knobs_that_there_are(scene):
    knobs = {knob.name for knob in scene.bench().knobs}
    assert set(scene.knobs) <= knobs
    assert scene.state in {state.symbol for state in scene.bench().states}
    first, last = scene.steps[0], scene.steps[-1]
    moved = {name for name in last.values if last.values[name] != first.values.get(name)}
    assert moved <= set(scene.knobs)
