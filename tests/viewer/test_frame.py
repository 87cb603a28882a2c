"""What a browser sees, without a browser: views, the square on the canvas, light, and messages that nobody meant."""

import dataclasses
import re

import numpy as np
import pytest
from support.laws import close
from support.tiny_viewer import canvas, opened, state, surfels, view

from spnr_jax.formats import clouds
from spnr_jax.formats.images import NAMES, read_light
from spnr_jax.kernels.records import Light, Rendering
from spnr_jax.method.model import Model
from spnr_jax.tools import frame
from spnr_jax.tools.commands import Lighting

QUIET = {"choice": "room", "yaw": 0, "exposure": 0}


def reddish(image):
    return (image[..., 0] > image[..., 2] + 60) & (image[..., 1] < 150)


def bluish(image):
    return reddish(image[..., ::-1])


def lopsided(brightness=1.0):
    """A map with light from one side."""
    tables = np.zeros((7, 32, 64, 3), np.float32)
    tables[:, :, :20] = brightness
    return Light(tables=tables)


# views


@pytest.mark.parametrize(
    "changed",
    [
        {"position": [np.nan, 0, 0]}, {"position": [1e9, 0, 0]}, {"position": [0, 0]}, {"wxyz": [0, 0, 0, 0]},
        {"wxyz": [np.inf, 0, 0, 1]}, {"wxyz": "abcd"}, {"field_of_view": 0.0}, {"field_of_view": 3.2},
        {"field_of_view": 10**400}, {"width": 0}, {"height": -5}, {"height": None}, {"width": 1e9},
    ],
)  # fmt: skip
def test_a_camera_from_which_nothing_can_be_drawn_is_no_view(changed):
    good = {"wxyz": np.eye(4)[0], "position": 3 * np.eye(3)[2], "field_of_view": 0.7, "width": 100, "height": 50}
    assert frame.read_view(**good) is not None
    assert frame.read_view(**good | changed) is None


def test_the_browsers_cameras_look_ahead_with_y_down():
    seen = frame.read_view([1, 0, 0, 0], [0, 0, -3], 0.7, 60, 40)
    np.testing.assert_allclose(seen.rotation[:, 1:], [[0, 0], [-1, 0], [0, -1]], atol=1e-12)
    assert canvas(view=seen)[20, 30].min() < 200, "the object lies ahead"


# the square on the canvas


def test_a_ball_is_drawn_in_the_middle_red_on_its_left_whatever_the_shape_of_the_canvas():
    for width, height in ((120, 60), (60, 120), (90, 90)):
        image = canvas(view=view(width=width, height=height))
        assert image.shape == (height, width, 3)
        rows, columns = np.nonzero((image < 230).any(axis=-1))
        radius = 3**-0.5 / np.sqrt(16 - 1 / 3) / np.tan(0.35) * height / 2  # of its outline; it fills the box
        close([columns.mean() + 0.5, rows.mean() + 0.5], [width / 2, height / 2], atol=1.5)
        close(np.sqrt(len(rows) / np.pi), radius, rtol=0.15)
        assert reddish(image)[:, : width // 2].any()
        assert not reddish(image)[:, width // 2 + 2 :].any()
        assert bluish(image)[:, width // 2 :].any()


@pytest.mark.parametrize("whole", [False, True])
def test_the_square_holds_the_object_and_covers_the_canvas_where_that_is_asked_for(whole):
    seen = view(width=300, height=60)
    covering = 5 * np.tan(0.35)
    close(frame.square_reach(seen, whole), covering if whole else np.tan(np.arcsin(frame.OBJECT_RADIUS / 4)), rtol=1e-6)
    inside = dataclasses.replace(seen, position=0.1 * seen.position)
    aside = dataclasses.replace(seen, position=np.array([9.0, 0, 1]))
    assert frame.square_reach(inside, whole) == frame.square_reach(aside, whole) == pytest.approx(covering)
    for size in ((2**16, 2), (2, 2**16)):
        wide = view(width=size[0], height=size[1])
        filled = frame.place_square(np.zeros((8, 8, 3), np.uint8), wide, frame.square_reach(wide, whole=True), 96)
        assert max(filled.shape) == 96, "no canvas is drawn larger than asked for"
        assert (filled == 0).all()


def test_while_things_move_the_draft_is_drawn_and_at_rest_what_was_chosen(monkeypatch):
    asked, blank = [], np.ones((24, 24, 3), np.float32)
    drawn = Rendering(image=blank, image_lr=None, depth=blank[..., 0], acc=blank[..., 0])
    monkeypatch.setattr(Model, "render", lambda *of: asked.append((of[3], of[2].height)) or drawn)
    for name in frame.qualities(surfels()):
        canvas(moving=True, quality=name)
        canvas(quality=name)
    assert set(asked[::2]) == {("draft", 24)}
    assert asked[1::2] == [("draft", 48), ("balanced", 48), ("best", 48), ("best", 96)]


def test_nothing_is_drawn_before_the_browser_said_where_it_looks_from():
    assert frame.draw(surfels(), state(view=None), moving=False) is None


# light


def test_a_change_of_the_light_changes_the_picture():
    before = canvas()
    seen = [before]
    for asked in (Lighting(light="night"), Lighting(light_yaw=90.0), Lighting(sun=(0.0, 20.0)), Lighting(exposure=1.0)):
        now = canvas(lighting=asked)
        assert all(np.abs(now - old).max() > 8 for old in seen), asked
        seen.append(now)
    np.testing.assert_array_equal(canvas(), before)


@pytest.mark.ci
def test_the_map_stands_behind_the_object_on_the_whole_canvas_where_it_is_asked_for():
    white, lit = (canvas(lighting=Lighting(light="sunset"), background=b) for b in ("white", "light"))
    assert (white[:4, :4] == 255).all()
    assert lit[:4, :4].mean() < 240
    assert lit[:, -4:].mean() < 240


@pytest.mark.parametrize(
    ("control", "value", "field", "expected"),
    [("choice", "studio", "light", "studio"), ("yaw", 90, "light_yaw", 90.0), ("exposure", -1.5, "exposure", -1.5)],
)
def test_every_control_reaches_the_options_and_leaves_the_sun(control, value, field, expected):
    sunny = state(lighting=Lighting(sun=(1.0, 2.0)))
    asked = frame.read_lighting(sunny, **QUIET | {control: value})
    assert getattr(asked, field) == expected != getattr(frame.read_lighting(sunny, **QUIET), field)
    assert asked.sun == (1.0, 2.0)
    assert frame.read_lighting(sunny, **QUIET | {"choice": sunny.light_name}).light is None
    assert frame.read_lighting(sunny, **QUIET | {"choice": sunny.light_name, "yaw": 30}).light_yaw == 0


@pytest.mark.parametrize(
    ("control", "value"),
    [("yaw", float("nan")), ("exposure", 1e9), ("yaw", None), ("yaw", {}), ("choice", 3), ("exposure", [1, 2]),
     ("choice", "/etc/passwd"), ("choice", "absent.hdr"), ("choice", ""), ("choice", "sun alone")],
)  # fmt: skip
def test_controls_that_say_what_they_do_not_offer_are_refused_in_one_line(control, value):
    with pytest.raises(ValueError, match="light|exposure") as refused:
        frame.read_lighting(state(), **QUIET | {control: value})
    assert "\n" not in str(refused.value)


def test_a_new_map_is_chosen_and_replaces_one_of_its_name():
    assert opened().light() is None
    one = frame.add_map(state(lighting=Lighting(exposure=1.0)), "a.hdr", lopsided())
    assert (one.light_name, one.lights) == ("a.hdr", (*NAMES, "a.hdr"))
    close(one.light().tables, 2 * lopsided().tables)
    close(frame.add_map(one, "a.hdr", lopsided(3.0)).light().tables, 6 * lopsided().tables)


# files


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("chair.ply", "chair.ply"), ("../../etc/passwd", "passwd"), ("C:\\x\\..\\a b.xyz", "a b.xyz"), ("", "file"),
        ("..", ".."), ("a\x00[b](http://c).ply", "c_.ply"), ("x" * 500 + ".ply", "x" * 56 + ".ply"),
    ],
)  # fmt: skip
def test_of_a_browsers_file_name_only_its_last_part_is_shown(name, shown):
    assert frame.display_name(name) == shown


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.ply", b"", "a.ply: the file is empty"), ("a.exe", b"MZ", "a.exe: unknown kind"),
        ("ply", b"", "ply: the file is empty"),
        ("../evil/.ply", b"x", "unknown kind"), ("n.xyz", b"0 0 nan\n", "n.xyz"), ("p.npz", b"\x80\x04N.", "p.npz"),
        ("../b.exr", b"#?RADIANCE\n", "b.exr: not a readable"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_read_is_refused_under_the_browsers_name(name, content, words, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(ValueError, match=re.escape(words)) as refused:
        frame.read_upload(name, content, read_light if name.endswith("exr") else clouds.read_cloud)
    assert str(tmp_path) not in str(refused.value)
    assert "\n" not in str(refused.value)
    assert list(tmp_path.iterdir()) == []
