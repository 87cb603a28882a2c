"""Splats in the viewer: made while other pictures are drawn, given to the browser in its terms, shown and hidden."""

import dataclasses
import functools
import io
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from support import chromium as chromium_of
from support import splat_balls, surfel_clouds, tiny_viewer

from spnr_jax.gaussians import placing
from spnr_jax.method.model import DISTANCE, FIELD_OF_VIEW
from spnr_jax.training.weights import load

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed: pip install 'spnr-jax[viewer]'")

from spnr_jax.viewer import scene as scenes  # noqa: E402
from spnr_jax.viewer import server, session, splats  # noqa: E402
from spnr_jax.viewer.gui import Reading  # noqa: E402
from spnr_jax.viewer.loop import Loop  # noqa: E402

pytestmark = pytest.mark.ci  # it opens a browser


@functools.cache
def model():
    """The package's network: an untrained one draws fog, which has no surface."""
    return load("surfels")


@functools.cache
def ball():
    positions, normals, _ = surfel_clouds.shape("sphere", 400)
    return scenes.open_scene(model(), surfel_clouds.cloud(10 * positions, normals=normals), "ball.ply")


def state(**changes):
    return tiny_viewer.state(**{"scene": ball(), "size": 64} | changes)


@pytest.fixture
def few(monkeypatch):
    for name, value in (("VIEWS", 6), ("RESOLUTION", 48), ("MOST", 400)):
        monkeypatch.setattr(splats, name, value)


def test_splats_are_made_in_the_box_and_the_network_is_free_for_other_pictures_meanwhile(few):
    network, shares = threading.Lock(), []

    def progress(share):
        assert not network.locked()
        shares.append(share)

    made = splats.make(model(), state(), network, 0.05, progress)
    assert len(made.opacity) > 100
    pixel = 2 * DISTANCE * np.tan(FIELD_OF_VIEW / 2) / splats.RESOLUTION
    radius = 3**-0.5 - placing.INSET * pixel  # a ball in the box
    np.testing.assert_allclose(np.linalg.norm(made.position, axis=1), radius, atol=0.03)
    assert shares[:6] == [splats.DRAWING * i / 6 for i in range(6)]
    assert shares == sorted(shares)
    assert shares[6] == splats.DRAWING


def test_a_browser_that_has_gone_ends_the_making(few):
    def gone(share):
        if share > 0.1:
            raise splats.StoppedError

    with pytest.raises(splats.StoppedError):
        splats.make(model(), state(), threading.Lock(), 60, gone)


@pytest.mark.parametrize("seconds", [-1, float("nan"), 1e9, "a", None])
def test_seconds_that_are_not_offered_are_refused(few, seconds):
    with pytest.raises(ValueError, match="refined for 0 to 60 seconds"):
        splats.make(model(), state(), threading.Lock(), seconds, lambda share: None)


def test_the_browser_gets_the_shape_and_the_mean_colour_of_each_splat():
    ball = splat_balls.ball(50)
    given = splats.for_browser(ball)
    covariance = given["scale"] ** 2 * given["covariances"]
    lengths = np.sqrt(np.linalg.eigvalsh(covariance.astype(np.float64)))
    np.testing.assert_allclose(lengths, np.sort(ball.scale, axis=1), rtol=1e-3)
    np.testing.assert_allclose(given["scale"] * given["centers"], ball.position, rtol=1e-5)
    normal = ball.position / np.linalg.norm(ball.position, axis=1, keepdims=True)
    along = np.einsum("ni,nij,nj->n", normal, covariance, normal)
    np.testing.assert_allclose(np.sqrt(along), ball.scale[:, 2], rtol=1e-2)
    assert covariance.astype(np.float16).any(axis=(1, 2)).all()
    np.testing.assert_allclose(given["rgbs"], 0.5 + 0.3 * normal, atol=1e-5)


@pytest.mark.parametrize(
    ("panes", "shown"),
    [(("points", "picture"), ("points", "splats", "picture")), (("depth",), ("splats",))],
)
def test_the_canvas_leaves_its_middle_to_the_splats_and_all_of_it_if_there_is_one_pane(panes, shown):
    assert state(panes=panes).shown == panes
    with_splats = state(panes=panes, splats=True)
    assert with_splats.shown == shown
    image = session.draw(model(), with_splats, moving=True)[1].image
    third = image.shape[1] // len(shown)
    middle = image[:-24, len(shown) // 2 * third + 2 : (len(shown) // 2 + 1) * third - 2]
    assert (middle == 255).all()
    assert len(shown) == 1 or (image[:, :third] < 200).any()


def test_a_rectangle_selects_the_same_points_in_a_pane_beside_the_splats():
    alone = session.select(state(), (0.05, 0.2), (0.2, 0.7), add=False).scene.selected
    beside = dataclasses.replace(state(), splats=True)
    width, narrow = 60, 40  # pixels of a pane: the same camera, cut narrower
    low, high = ((share * 120 - width / 2 + narrow / 2) / 120 for share in (0.05, 0.2))
    np.testing.assert_array_equal(session.select(beside, (low, 0.2), (high, 0.7), add=False).scene.selected, alone)


# the controls


class Control(SimpleNamespace):
    def on_click(self, callback):
        self.call = callback
        return callback

    on_update = on_click


class Browser(viser.ClientHandle):
    """What viser does for a browser: controls keep values, and the scene keeps splats."""

    def __init__(self):
        self.controls, self.drawn = {}, []
        self.gui = SimpleNamespace(
            add_slider=self.add, add_button=self.add, add_checkbox=self.add, add_markdown=lambda text: self.add("said")
        )
        self.scene = SimpleNamespace(add_gaussian_splats=self.splats)

    def add(self, label, *values, disabled=False):
        control = Control(label=label, value=values[-1] if values else None, disabled=disabled, content="")
        self.controls[label] = control
        return control

    def splats(self, name, **given):
        self.drawn = [SimpleNamespace(name=name, **given)]
        self.drawn[0].remove = self.drawn.clear
        return self.drawn[0]


class AtOnce(Loop):
    """A loop that draws nothing and changes its state at once."""

    def submit(self, change):
        self.state = change(self.state)


@pytest.fixture
def browser(few):
    shown = Browser()
    shown.loop = AtOnce(state(), lambda state, moving: state)
    shown.of = splats.SplatControls(shown, model(), shown.loop, threading.Lock(), lambda work: work())
    shown.controls["Refined, seconds"].value = 0
    return shown


def made(browser):
    browser.controls["Make splats"].call(None)
    return browser


def test_the_button_makes_splats_and_shows_them_and_the_box_hides_them(browser):
    assert browser.controls["Show splats"].disabled
    made(browser)
    assert browser.drawn[0].visible
    assert browser.loop.state.splats
    assert browser.controls["said"].content == f"{len(browser.drawn[0].centers):,} splats"
    button, box = browser.controls["Make splats"], browser.controls["Show splats"]
    assert (button.label, button.disabled, box.value, box.disabled) == ("Make splats", False, True, False)
    box.value = False
    with pytest.raises(StopIteration):
        box.call(None).send(None)
    assert not browser.drawn[0].visible
    assert not browser.loop.state.splats


def test_splats_of_an_object_that_was_changed_say_so_and_those_of_another_file_are_taken_away(browser):
    made(browser).of.follow(browser.loop.state)
    assert "before the last change" not in browser.controls["said"].content
    edited = scenes.edited(browser.loop.state.scene, "roughness", 0.1)
    browser.of.follow(state(scene=edited))
    assert "before the last change" in browser.controls["said"].content
    browser.of.drop()
    assert not browser.drawn
    assert not browser.loop.state.splats
    assert browser.controls["Show splats"].disabled


def test_splats_that_are_finished_when_another_file_is_shown_are_not_shown(browser, monkeypatch):
    opened = scenes.open_scene(model(), dataclasses.replace(ball().cloud), "other.xyz")
    make = splats.make

    def slow(*arguments):
        found = make(*arguments)
        browser.loop.state = state(scene=opened)
        return found

    monkeypatch.setattr(splats, "make", slow)
    assert not made(browser).drawn
    assert not browser.loop.state.splats


def test_a_browser_that_closes_meanwhile_leaves_no_error(browser):
    browser.loop.stop()
    assert not made(browser).drawn
    assert not browser.controls["Make splats"].disabled


# a browser

WAIT = 60  # seconds, for a machine that does much else


def canvas(tab):
    """The three panes without the browser's notes, (height, width, 3)."""
    content = tab.screenshot(clip={"x": 0, "y": 100, "width": 600, "height": 260})
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def until(tab, accept):
    """The canvas once it is acceptable."""
    end = time.monotonic() + WAIT
    while time.monotonic() < end:
        if accept(now := canvas(tab)):
            return now
        time.sleep(0.3)
    raise AssertionError("the canvas did not come to what was expected")


BETWEEN, RIGHT = np.s_[60:, 260:316], np.s_[60:, 400:560]  # where two panes meet, and in the last of both two and three


# viser gives the corners of a splat two coordinates, of which three.js computes bounds when a pointer passes
NO_BOUNDS = "computeBoundingSphere(): Computed radius is NaN"


def covered(image, part):
    return (image[part] < 220).any(axis=-1).mean()


@pytest.fixture
def viewer(few, monkeypatch):
    monkeypatch.setattr(splats, "SECONDS", 0.0)
    opened = server.Viewer(
        model(), state(view=None), Reading(num_points=100, up="y", clean="auto"), host="127.0.0.1", port=0
    )
    yield opened
    opened.stop()


@chromium_of.needed
def test_in_a_browser_the_splats_stand_between_points_and_picture_and_can_be_hidden(viewer):
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    with chromium_of.launched(playwright) as browser:
        tab, said = browser.new_page(viewport={"width": 900, "height": 420}), []
        tab.on("console", lambda line: said.append(line.text) if line.type == "error" else None)
        tab.on("pageerror", lambda error: said.append(str(error)))
        tab.goto(f"{viewer.url}?fixedDpr=1")
        tab.get_by_role("button", name="Make splats").click(timeout=1000 * WAIT)
        beside = until(tab, lambda image: min(covered(image, BETWEEN), covered(image, RIGHT)) > 0.3)
        middle, right = beside[80:180, 250:330].mean(axis=(0, 1)), beside[80:180, 440:520].mean(axis=(0, 1))
        assert np.abs(middle - right).max() < 60  # both grey
        tab.get_by_label("Show splats").click()
        until(tab, lambda image: covered(image, BETWEEN) < 0.1 and covered(image, RIGHT) > 0.3)
        assert not [line for line in said if NO_BOUNDS not in line]
