"""The page of `spnr share` in a real browser, opened as a file: it draws what it should, turns, and finds no error.

Chromium is found on PATH, or named by SPNR_CHROMIUM; without one these tests are skipped.
"""

import base64
import contextlib
import io
import re

import numpy as np
import pytest
from PIL import Image
from support import chromium as chromium_of, splat_balls, splat_twin

from spnr_jax.tools import export, surfaces
from spnr_jax.tools.commands import Share, SplatOptions

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")

SIZE = 200
WAIT = 60_000  # milliseconds, for a machine that does much else
pytestmark = [chromium_of.needed, pytest.mark.ci]  # it opens a browser


@pytest.fixture(scope="module")
def chromium():
    with chromium_of.launched(playwright) as browser:
        yield browser


def until(tab, holds):
    """Waits until an expression holds; no wait_for_function, because the page allows no evaluated strings."""
    for _ in range(WAIT // 50):
        if tab.evaluate(holds):
            return
        tab.wait_for_timeout(50)
    raise AssertionError(f"{holds} does not hold after {WAIT} ms")


@contextlib.contextmanager
def opened(chromium, path):
    """The page in a tab, ready; its console says nothing, and it asks for nothing."""
    tab, said = chromium.new_page(viewport={"width": SIZE, "height": SIZE}), []
    tab.on("console", lambda line: said.append((line.type, line.text)))
    tab.on("pageerror", lambda error: said.append(("error", str(error))))
    tab.on("request", lambda request: said.append(("request", request.url)) if request.url[:4] == "http" else None)
    tab.goto(path.as_uri())
    until(tab, "window.viewer?.ready === true")
    yield tab
    assert not said
    tab.close()


def shown(tab):
    """What the canvas shows, without the words over it."""
    tab.evaluate("document.querySelectorAll('header, footer').forEach((part) => part.style.display = 'none')")
    tab.evaluate("viewer.draw()")
    content = tab.screenshot()
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(np.float32) / 255


def decibels(one, other):
    return -10 * np.log10(np.mean((one - other) ** 2))


def page(tmp_path, degree, title="A ball"):
    camera = splat_balls.camera(size=SIZE)
    splats = splat_balls.ball(degree=degree)
    poster, _ = splat_twin.draw(splats, camera)
    path = tmp_path / "page.html"
    path.write_bytes(export.page(splats, poster, camera, (30.0, 20.0), title, "a note"))
    return path, poster


@pytest.mark.parametrize("degree", [0, 3])
def test_the_page_draws_what_the_poster_shows_and_its_title_is_only_text(chromium, tmp_path, degree):
    title = '<b>"chair" & @DATA@</b>'
    path, poster = page(tmp_path, degree, title)
    with opened(chromium, path) as tab:
        assert tab.title() == tab.locator("h1").inner_text() == title
        assert decibels(shown(tab), poster) > 32
        assert tab.locator("#poster").count() == 0, "the poster makes place"


def test_the_page_of_a_cloud_shows_what_the_network_draws(chromium, tmp_path, monkeypatch):
    monkeypatch.setattr(surfaces, "RESOLUTION", SIZE)
    points = np.random.default_rng(0).normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    stripes = np.where(np.sin(6 * points[:, :1]) > 0, [200, 40, 30], [30, 60, 200])
    np.savetxt(tmp_path / "ball.txt", np.concatenate([points, stripes], axis=1), fmt="%.5f")
    making = SplatOptions(fitting_views=12, most_splats=8000)
    options = Share(cloud=tmp_path / "ball.txt", out=tmp_path / "page.html", up="y", making=making)
    assert export.share(options, lambda line: None).startswith(f"wrote {options.out} (")
    poster = re.search(r'src="data:image/jpeg;base64,([^"]+)"', options.out.read_text())
    network = np.asarray(Image.open(io.BytesIO(base64.b64decode(poster[1])))) / np.float32(255)
    with opened(chromium, options.out) as tab:
        assert decibels(shown(tab), network) > 24, "20 are asked for"
        assert decibels(np.ones_like(network), network) < 15


def test_the_page_draws_again_once_the_browser_took_the_graphics_away_and_gave_them_back(chromium, tmp_path):
    path, poster = page(tmp_path, 0)
    with opened(chromium, path) as tab:
        tab.evaluate("lender = canvas.getContext('webgl2').getExtension('WEBGL_lose_context'); lender.loseContext()")
        tab.wait_for_timeout(300)
        tab.evaluate("lender.restoreContext()")
        until(tab, "!canvas.getContext('webgl2').isContextLost()")
        assert decibels(shown(tab), poster) > 32


def test_dragging_turns_the_object_as_a_camera_would_go_around_it(chromium, tmp_path):
    path, poster = page(tmp_path, 1)
    with opened(chromium, path) as tab:
        tab.mouse.move(100, 100)
        tab.mouse.down()
        tab.mouse.move(150, 110, steps=3)
        tab.mouse.up()
        azimuth, elevation = tab.evaluate("[viewer.camera.azimuth, viewer.camera.elevation]")
        assert (azimuth, elevation) == pytest.approx((10, 24))
        turned, _ = splat_twin.draw(splat_balls.ball(), splat_balls.camera(azimuth, elevation, SIZE))
        now = shown(tab)
        assert decibels(now, turned) > 32
        assert decibels(now, poster) < 28
        tab.mouse.wheel(0, 200)
        until(tab, "viewer.camera.distance > 3.3")
