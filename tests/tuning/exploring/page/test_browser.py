"""The page in a real browser: drag, click the map, run a study, export, many tabs, a server that is gone."""

import json
import re
import shutil

import numpy as np
import pytest

pytest.importorskip("bokeh")
pytest.importorskip("playwright")

from playwright.sync_api import sync_playwright

from tuning.exploring.bench import Bench
from tuning.exploring.page.session import Server, page_of
from tuning.problems.find import find_problem

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
with_chromium = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium, Debian's package of that name")
pytestmark = [pytest.mark.slow, with_chromium]
WIDE, PHONE = {"width": 1400, "height": 1000}, {"width": 390, "height": 844}
PATIENCE = 120_000  # [ms]
R = "#knob-R"


@pytest.fixture(scope="module")
def served():
    server = Server(page_of(Bench(find_problem("outliers"), "ekf")), ends_when_left=False).start()
    yield server
    server.stop()


@pytest.fixture(scope="module")
def chromium():
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def page(served, chromium):
    made = opened(chromium, served.url, viewport=WIDE)
    yield made
    assert made.errors == []
    made.context.close()


def opened(chromium, url, **options):
    """A tab that has its first pictures; errors of its scripts are kept."""
    page = chromium.new_context(accept_downloads=True, **options).new_page()
    page.set_default_timeout(PATIENCE)
    page.errors = []
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    page.goto(url)
    page.wait_for_selector("#figures dd")
    return page


def figures(page):
    """The figures by name, each its number."""
    rows = page.locator("#figures div").all_inner_texts()
    found = [re.match(r"(.+?)\s+([-\u2212\d.e+]+)", row.replace("\n", " ")) for row in rows]
    return {one[1]: float(one[2].replace("\u2212", "-")) for one in found if one}


def settled(page, was):
    """The figures as soon as they differ from those that were."""
    page.wait_for_function("was => document.querySelector('#figures').innerText !== was", arg=was)
    page.wait_for_timeout(500)
    return figures(page)


def seen(page):
    return page.locator("#figures").inner_text()


def map_drawn(page):
    page.wait_for_function("!document.body.classList.contains('busy')")
    source = "Bokeh.documents[0].get_model_by_name('map').renderers[0].data_source"
    page.wait_for_function(f"{source}.data.image.length > 0")


def test_a_newcomer_halves_the_error_of_the_rule_of_thumb_by_dragging_r(page):
    before, was = figures(page), seen(page)
    box = page.locator(R).bounding_box()
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.4 * box["width"], middle)
    page.mouse.down()
    for part in range(40, 76):
        page.mouse.move(box["x"] + part / 100 * box["width"], middle)
    page.mouse.up()
    after = settled(page, was)
    assert after["score"] < 0.5 * before["score"]
    assert "better" in page.locator("#figures dd").nth(0).get_attribute("class")
    assert page.evaluate("performance.getEntriesByName('move to picture').length") > 0


def test_pictures_show_the_numbers_of_what_is_set_and_stand_still(page):
    was, place = seen(page), page.locator(R).bounding_box()
    number = page.locator(f".knob:has({R}) input[type=text]")
    number.fill("40")
    number.press("Tab")
    settled(page, was)
    view = Bench(find_problem("outliers"), "ekf").view({"R": 40.0})
    drawn = page.evaluate("Object.fromEntries(['time', 'line'].map(x => [x, [...model('state1 lines').data[x]]]))")
    at = np.rint(np.array(drawn["time"]) / 0.01).astype(int)
    assert len(at) > 200 and at[0] == 0 and at[-1] == 500
    np.testing.assert_allclose(drawn["line"], view.estimate[0, at, 1], rtol=1e-6)
    assert page.locator(R).bounding_box() == place  # though numbers became longer


def test_keys_and_typed_numbers_set_a_value_and_a_wrong_one_is_said(page):
    was = seen(page)
    page.focus(R)
    page.keyboard.press("PageUp")
    settled(page, was)
    number = page.locator(f".knob:has({R}) input[type=text]")
    number.fill("NaN")
    number.press("Tab")
    assert "must be a number" in page.locator("#error").inner_text()
    was = seen(page)
    number.fill("3")
    number.press("Tab")
    settled(page, was)
    assert page.locator("#error").is_hidden() and number.input_value() == "3"


def test_a_click_into_the_map_takes_its_values(page):
    map_drawn(page)
    was, slider = seen(page), page.locator("#knob-Q11").input_value()
    box = page.locator('.picture[data-name="map"] [role=img]').bounding_box()
    page.mouse.click(box["x"] + 0.3 * box["width"], box["y"] + 0.4 * box["height"])
    settled(page, was)
    assert page.locator("#knob-Q11").input_value() != slider


def test_a_study_shows_its_trials_and_its_best_is_taken(page):
    map_drawn(page)
    before, was = figures(page), seen(page)
    page.fill("#trials", "12")
    page.click("#run")
    page.wait_for_function("document.querySelector('#best').innerText.includes('12 of 12')")
    points = "Bokeh.documents[0].get_model_by_name('map').renderers[2].data_source.data.x.length"
    assert page.evaluate(points) == 12
    page.click("#take")
    assert settled(page, was)["score"] < before["score"]


def test_a_study_is_stopped(page):
    page.fill("#trials", "5000")
    page.click("#run")
    page.wait_for_function("document.querySelector('#best').innerText.includes('of 5000')")
    page.click("#run")
    page.wait_for_function("document.querySelector('#run').innerText === 'Run'")


@pytest.mark.parametrize(
    "kind, name", [("tuned", "tuned.json"), ("python", "explored.py"), ("png", "explored.png")]
)
def test_what_is_seen_is_kept_as_a_file(page, kind, name, tmp_path):
    page.select_option("#kind", kind)
    with page.expect_download(timeout=5 * PATIENCE) as download:
        page.click("#export")
    assert download.value.suggested_filename == name
    download.value.save_as(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    if kind == "tuned":
        assert json.loads(content)["filter"]
    assert content.startswith({"tuned": b"{", "python": b"from filters", "png": b"\x89PNG"}[kind])


def test_ten_tabs_go_on_beside_each_other(served, chromium):
    pages = [opened(chromium, served.url, viewport=WIDE) for _ in range(10)]
    was = [seen(page) for page in pages]
    for place, page in enumerate(pages):
        page.focus(R)
        for _ in range(place + 1):
            page.keyboard.press("PageUp")
    scores = [settled(page, before)["score"] for page, before in zip(pages, was, strict=True)]
    assert len(set(scores)) == 10 and not any(page.errors for page in pages)
    for page in pages:
        page.context.close()


def test_a_page_says_when_its_server_has_ended(chromium):
    server = Server(page_of(Bench(find_problem("outliers"), "ekf")), ends_when_left=False).start()
    page = opened(chromium, server.url, viewport=WIDE)
    server.stop()
    page.wait_for_selector("#error:not([hidden])")
    assert "The server has ended" in page.locator("#error").inner_text() and page.errors == []
    page.context.close()
