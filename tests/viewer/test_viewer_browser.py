"""The viewer in a real browser: a headless Chromium looks, orbits, edits, opens files and saves, and finds no error.

Chromium is found on PATH, or named by SPNR_CHROMIUM; without one these tests are skipped.
"""

import io
import socket
import time

import numpy as np
import pytest
from PIL import Image
from support import chromium as chromium_of
from support.tiny_viewer import viewer

pytest.importorskip("viser", reason="the viewer's extra is not installed: pip install 'spnr-jax[viewer]'")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")

from spnr_jax import cli  # noqa: E402
from spnr_jax.formats.cut import Cut  # noqa: E402
from spnr_jax.tools.light_options import Lighting  # noqa: E402
from spnr_jax.viewer import server  # noqa: E402

pytestmark = pytest.mark.ci  # it opens a browser

WAIT = 40  # seconds, for a machine that does much else


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
        self.said = []
        self.tab.on("console", lambda line: self.said.append((line.type, line.text)))
        self.tab.on("pageerror", lambda error: self.said.append(("error", str(error))))
        self.tab.goto(f"{url}?fixedDpr=1")  # else a slow machine's canvas gets fewer pixels, at any moment

    def canvas(self):
        """The two panes without the browser's notes, (height, width, 3) int."""
        content = self.tab.screenshot(clip={"x": 0, "y": 160, "width": 560, "height": 240})
        return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)

    def settled(self, accept=lambda canvas: True):
        """The canvas once it stands still and is acceptable."""
        end, before = time.monotonic() + WAIT, None
        while time.monotonic() < end:
            now = self.canvas()
            if before is not None and difference(now, before) < 0.01 and accept(now):
                return now
            before = now
            time.sleep(0.4)
        raise AssertionError("the canvas did not come to the expected rest")

    def choose(self, label, option):
        self.tab.get_by_label(label, exact=True).first.click()
        self.tab.get_by_role("option", name=option, exact=True).click()

    def orbit(self):
        self.tab.mouse.move(140, 300)
        self.tab.mouse.down()
        self.tab.mouse.move(240, 320, steps=6)
        self.tab.mouse.up()

    def close(self):
        self.tab.close()


@pytest.fixture
def page(chromium, running):
    opened = Page(chromium, running.url)
    yield opened
    errors = [line for line in opened.said if line[0] == "error"]
    opened.close()
    assert not errors


def difference(one, other):
    """Mean difference of two canvases, 0 to 255."""
    return np.abs(one - other).mean() if one.shape == other.shape else np.inf


def half(canvas, number):
    middle = canvas.shape[1] // 2
    return canvas[:, : middle - 3] if number == 0 else canvas[:, middle + 3 :]


def drawn(canvas):
    return all((half(canvas, number) < 200).any(axis=-1).mean() > 0.01 for number in (0, 1))


@chromium_of.needed
def test_points_and_picture_stand_side_by_side_and_an_orbit_turns_both(page):
    first = page.settled(drawn)
    page.orbit()
    second = page.settled(lambda now: difference(now, first) > 1)
    for number in (0, 1):
        assert difference(half(first, number), half(second, number)) > 1
    assert page.tab.get_by_text("ms here").is_visible()
    assert page.tab.get_by_text("(48²)").first.is_visible()


@chromium_of.needed
@pytest.mark.slow
def test_layers_differ_and_the_left_pane_stays(page):
    seen = {"picture": page.settled(drawn)}
    for layer in ("depth", "opacity", "points"):
        page.choose("Right", layer)
        seen[layer] = page.settled(lambda now: all(difference(now, old) > 1 for old in seen.values()))
    lefts = [half(canvas, 0)[:-60] for canvas in seen.values()]
    assert max(difference(left, lefts[0]) for left in lefts) < 2


@chromium_of.needed
@pytest.mark.slow
def test_an_edit_of_the_points_inside_a_rectangle_recolours_them_and_changes_the_picture(page):
    first = page.settled(drawn)
    page.tab.keyboard.down("Shift")
    page.tab.mouse.move(5, 20)
    page.tab.mouse.down()
    page.tab.mouse.move(130, 410, steps=5)
    page.tab.mouse.up()
    page.tab.keyboard.up("Shift")
    page.tab.get_by_text("selected of 200 points").wait_for(timeout=1000 * WAIT)
    page.settled(lambda now: difference(half(now, 0), half(first, 0)) > 0.5)  # rings
    color = page.tab.locator("input[value^='rgb(']").first
    color.fill("rgb(0, 255, 0)")
    color.press("Enter")

    def green(canvas):
        left = half(canvas, 0)
        return ((left[..., 1] > 200) & (left[..., 0] < 90) & (left[..., 2] < 90)).mean() > 0.02

    edited = page.settled(green)
    assert difference(half(edited, 1), half(first, 1)) > 0.2
    page.tab.get_by_role("button", name="restore").click()
    page.tab.get_by_role("button", name="select all").click()
    again = page.settled(lambda now: difference(half(now, 1), half(first, 1)) < 0.1)
    assert difference(again, first) < 0.5


CLOUD = "\n".join(f"{x / 30} {(x % 30) / 30} 0 20 220 20" for x in range(900)).encode()
DROP = """([name, text]) => {
  const files = new DataTransfer();
  files.items.add(new File([text], name));
  document.querySelector('canvas').dispatchEvent(
    new DragEvent('drop', {dataTransfer: files, bubbles: true, cancelable: true}));
}"""


@chromium_of.needed
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
    assert page.tab.get_by_text("halves.xyz: edits change all 200 points").is_visible()
    give("plane.xyz", CLOUD)
    page.tab.get_by_text("plane.xyz: edits change all 100 points").wait_for(timeout=1000 * WAIT)
    page.settled(lambda now: difference(half(now, 0), half(first, 0)) > 3)


@chromium_of.needed
@pytest.mark.slow
def test_a_path_is_recorded_played_and_saved_and_the_canvas_is_kept(page, tmp_path):
    start = page.settled(drawn)
    add = page.tab.get_by_role("button", name="add", exact=True)
    add.click()
    page.tab.get_by_text("1 keyframes").wait_for()
    page.orbit()
    end = page.settled(lambda now: difference(now, start) > 1)
    add.click()
    page.tab.get_by_text("2 keyframes").wait_for()
    page.tab.get_by_role("button", name="Play").click()
    page.settled(lambda now: difference(now, end) < 0.5)
    page.choose("Film", "gif")
    for name, kind in (("Export film", "GIF"), ("Snapshot", "PNG")):
        with page.tab.expect_download(timeout=1000 * WAIT) as download:
            page.tab.get_by_role("button", name=name).click()
        download.value.save_as(tmp_path / kind)
        with Image.open(tmp_path / kind) as picture:
            assert picture.format == kind
            assert (picture.n_frames > 10) == (kind == "GIF")


@chromium_of.needed
@pytest.mark.slow
def test_two_browsers_have_their_own_camera_materials_and_file(chromium, running, page):
    first = page.settled(drawn)
    other = Page(chromium, running.url)
    same = other.settled(drawn)
    assert difference(first, same) < 1
    other.orbit()
    other.tab.locator("input[type=file]").set_input_files(
        {"name": "plane.xyz", "mimeType": "text/plain", "buffer": CLOUD}
    )
    other.tab.get_by_text("plane.xyz: edits change").wait_for(timeout=1000 * WAIT)
    other.settled(lambda now: difference(now, first) > 2)
    assert difference(page.settled(drawn), first) < 0.5
    other.close()
    page.orbit()
    page.settled(lambda now: difference(now, first) > 1)


def test_a_port_in_use_is_refused_in_one_line_before_anything_is_read(capsys, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        missing = {"cloud": tmp_path / "no.ply", "run": tmp_path, "num_points": 10, "up": "y"}
        missing |= {"clean": "auto", "cut": Cut(), "lighting": Lighting()}
        assert cli.guarded(lambda: server.open_viewer(host="127.0.0.1", port=port, **missing), "spnr") == 2
    assert capsys.readouterr().err == (
        f"spnr: --port {port} is in use on 127.0.0.1; choose another, or 0 for any free one\n"
    )


@pytest.mark.parametrize(
    ("host", "port", "words"),
    [("127.0.0.1", 70000, "0 (any free one) to 65535"), ("no.such.host.invalid", 0, "no such address"),
     ("192.0.2.1", 0, "--host 192.0.2.1")],
)  # fmt: skip
def test_an_address_that_cannot_be_listened_on_is_refused(host, port, words):
    with pytest.raises(ValueError, match="--") as refused:
        viewer(host, port)
    assert words in str(refused.value)


def test_it_listens_on_this_machine_alone_and_says_what_another_host_exposes(running):
    assert running.url.startswith("http://127.0.0.1:")
    assert len(running.lines) == 1
    everywhere = viewer("0.0.0.0")
    everywhere.stop()
    assert "whoever reaches this machine" in everywhere.lines[1]
    assert "no encryption" in everywhere.lines[1]


def test_no_browser_can_open_the_tunnel_to_a_public_address(running):
    assert running._server.request_share_url() is None
    assert running._server._share_tunnel is None
