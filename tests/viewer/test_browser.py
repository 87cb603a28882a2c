"""The viewer in a real browser: a headless Chromium turns, lights, opens files, saves.

Chromium is found on PATH, or named by SPNR_CHROMIUM; without one these tests are skipped.
"""

import io
import time

import numpy as np
import pytest
from PIL import Image
from support import chromium as chromium_of
from support.tiny_viewer import viewer

pytest.importorskip("viser", reason="the viewer's extra is not installed: pip install 'spnr-jax[viewer]'")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")

from spnr_jax.method.model import Model  # noqa: E402

pytestmark = [pytest.mark.ci, chromium_of.needed]  # it opens a browser

WAIT = 180  # seconds, for a machine that does much else
EXPOSURE = 1  # second slider
SAME = 4.0  # difference of a picture while things move from the same at rest


@pytest.fixture(scope="module")
def running():
    opened = viewer()
    yield opened
    opened.stop()


@pytest.fixture(scope="module")
def chromium():
    with chromium_of.launched(playwright) as browser:
        yield browser


class Page:
    """A page that shows the viewer, and what its console said."""

    def __init__(self, chromium, url):
        self.tab = chromium.new_page(viewport={"width": 900, "height": 420})
        self.tab.set_default_timeout(1000 * WAIT)
        self.said = []
        self.tab.on("console", lambda line: self.said.append(line.text) if line.type == "error" else None)
        self.tab.on("pageerror", lambda error: self.said.append(str(error)))
        self.tab.goto(f"{url}?fixedDpr=1")  # else a slow machine's canvas gets fewer pixels, at any moment

    def canvas(self):
        """The canvas without the browser's notes, (height, width, 3) int."""
        content = self.tab.screenshot(clip={"x": 0, "y": 100, "width": 560, "height": 300})
        return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)

    def settled(self, accept):
        """The canvas once it stands still and is acceptable."""
        end, before = time.monotonic() + WAIT, None
        while time.monotonic() < end:
            now = self.canvas()
            if before is not None and difference(now, before) < 0.01 and accept(now):
                return now
            before = now
            time.sleep(0.4)
        raise AssertionError("the canvas did not come to the expected rest")

    def until(self, holds):
        end = time.monotonic() + WAIT
        while not holds() and time.monotonic() < end:
            self.tab.wait_for_timeout(200)
        assert holds()

    def choose(self, label, option):
        self.tab.get_by_label(label, exact=True).first.click()
        self.tab.get_by_role("option", name=option, exact=True).click()

    def enter(self, slider, number):
        field = self.tab.locator("input.mantine-NumberInput-input").nth(slider)
        field.fill(number)
        field.press("Enter")

    def orbit(self):
        self.tab.mouse.move(240, 300)
        self.tab.mouse.down()
        self.tab.mouse.move(340, 320, steps=6)
        self.tab.mouse.up()


@pytest.fixture
def page(chromium, running):
    opened = Page(chromium, running.url)
    yield opened
    opened.tab.close()
    assert not opened.said


def difference(one, other):
    """Mean difference of two canvases, 0 to 255."""
    return np.abs(one - other).mean() if one.shape == other.shape else np.inf


def drawn(canvas):
    return (canvas < 200).any(axis=-1).mean() > 0.05


def test_an_orbit_turns_the_object_and_another_browser_keeps_its_own_camera(page, chromium, running):
    first = page.settled(drawn)
    page.orbit()
    page.settled(lambda now: drawn(now) and difference(now, first) > SAME)
    other = Page(chromium, running.url)
    other.settled(lambda now: drawn(now) and difference(now, first) < SAME)
    other.tab.close()


def test_light_exposure_and_quality_reach_the_picture(page, running, monkeypatch):
    first, asked, render = page.settled(drawn), [], Model.render
    loop = list(running._browsers.values())[-1].loop
    monkeypatch.setattr(Model, "render", lambda *of: asked.append(of[3]) or render(*of[:3], "draft", *of[4:]))
    page.choose("Light", "night")
    page.until(lambda: loop.state.lighting.light == "night")
    page.enter(EXPOSURE, "-4")
    page.settled(lambda now: difference(now, first) > 2 * SAME)
    assert "best" not in asked
    page.choose("Quality", "best")
    page.until(lambda: "best" in asked)


CLOUD = "\n".join(f"{x / 30} {(x % 30) / 30} 0 20 220 20" for x in range(900)).encode()
DROP = """([name, text]) => {
  const files = new DataTransfer();
  files.items.add(new File([text], name));
  document.querySelector('canvas').dispatchEvent(
    new DragEvent('drop', {dataTransfer: files, bubbles: true, cancelable: true}));
}"""


@pytest.mark.parametrize("way", ["button", "drop"])
def test_a_file_is_opened_by_button_and_by_drop_and_a_bad_one_leaves_the_old(page, way):
    first = page.settled(drawn)

    def give(name, content):
        if way == "button":
            file = {"name": name, "mimeType": "text/plain", "buffer": content}
            page.tab.locator("input[type=file]").set_input_files(file)
        else:
            page.tab.evaluate(DROP, [name, content.decode()])

    give("bad.xyz", b"1 2\n3\n")
    page.tab.get_by_text("That did not work").wait_for(timeout=1000 * WAIT)
    assert page.tab.get_by_text("ball.xyz: 400 points").is_visible()
    give("plane.xyz", CLOUD)
    page.tab.get_by_text("plane.xyz: 100 points").wait_for(timeout=1000 * WAIT)
    page.settled(lambda now: difference(now, first) > SAME)


def test_a_snapshot_is_the_picture(page, tmp_path):
    shown = page.settled(drawn)
    with page.tab.expect_download(timeout=1000 * WAIT) as download:
        page.tab.get_by_role("button", name="Snapshot").click()
    assert download.value.suggested_filename == "ball.png"
    download.value.save_as(tmp_path / "ball.png")
    saved = np.asarray(Image.open(tmp_path / "ball.png").convert("RGB")).astype(int)
    assert difference(saved[100:400, :560], shown) < SAME
