"""The light of the viewer: every control reaches it, maps come from files, and only the picture is drawn again."""

import dataclasses
import functools
import re

import jax
import numpy as np
import pytest
from support import tiny_viewer
from support.laws import close

from spnr_jax.config import SurfelConfig
from spnr_jax.formats import light_files
from spnr_jax.formats.light_files import NAMES
from spnr_jax.kernels.records import Light
from spnr_jax.method import surfel_renderer
from spnr_jax.method.model import Model
from spnr_jax.tools.light_options import Lighting
from spnr_jax.viewer import lights, session, uploads
from spnr_jax.viewer import scene as scenes
from spnr_jax.viewer.lights import SUN_ALONE, Lights

CONFIG = SurfelConfig(image_resolution=48, widths=(4, 6), top=4)
QUIET = {
    "choice": "room", "yaw": 0, "shines": False, "azimuth": 30, "elevation": 40, "exposure": 0, "background": "white"
}  # fmt: skip


@functools.cache
def model():
    return Model(config=CONFIG, variables=jax.jit(surfel_renderer.init, static_argnums=1)(jax.random.key(0), CONFIG))


@functools.cache
def scene():
    return scenes.open_scene(model(), tiny_viewer.cloud(), "halves.xyz")


def state(asked=None, **changes):
    """A state drawn without the CNN, in the light that the options ask for."""
    lit = Lights() if asked is None else lights.changed(Lights(), asked)
    common = {"view": tiny_viewer.view(), "panes": ("picture",), "quality": "draft", "lights": lit}
    return session.State(scene=scene(), size=48, **common | changes)


def canvas(asked=None, **changes):
    return session.draw(model(), state(asked, **changes), moving=False)[1].image.astype(int)


def light_of(asked):
    return lights.made(lights.changed(Lights(), asked)).light


def lopsided(brightness=1.0):
    """A map with light from one side."""
    tables = np.zeros((7, 32, 64, 3), np.float32)
    tables[:, :, :20] = brightness
    return Light(tables=tables)


def test_a_change_of_the_light_changes_the_picture_and_encodes_nothing(monkeypatch):
    before = canvas()
    monkeypatch.setattr(Model, "encode", lambda self, cloud: pytest.fail("the cloud was encoded again"))
    seen = [before]
    for asked in (Lighting(light="night"), Lighting(light_yaw=90.0), Lighting(sun=(0.0, 20.0)), Lighting(exposure=1.0)):
        now = canvas(asked)
        assert all(np.abs(now - old).max() > 8 for old in seen), asked
        seen.append(now)
    assert canvas(Lighting(exposure=1.0)).mean() > before.mean()
    np.testing.assert_array_equal(canvas(), before)


def test_the_map_stands_behind_the_object_where_it_is_asked_for():
    white, lit = (canvas(Lighting(light="sunset", background=behind)) for behind in ("white", "light"))
    assert (white[:4, :4] == 255).all()
    assert lit[:4, :4].mean() < 240
    changed = np.abs(white - lit)
    assert np.median(changed[20:40, 50:70].mean(axis=-1)) < changed[:4, :4].mean() / 2, "the object itself stays"


def test_snapshots_and_films_have_the_light_of_the_canvas():
    asked = Lighting(light="night", background="light")
    path = tuple(session.keyframe(tiny_viewer.view(azimuth), np.zeros(3)) for azimuth in (0.0, 0.1))
    shown = {}
    for name, now in (("dark", state(asked, keyframes=path)), ("white", state(keyframes=path))):
        film = session.film(model(), now, 0.0625, "gif", "picture")[1]
        shown[name] = session.snapshot(model(), now), film
    assert all(dark != white for dark, white in zip(shown["dark"], shown["white"], strict=True))


@pytest.mark.parametrize(
    ("control", "value", "field", "expected"),
    [
        ("choice", "studio", "light", "studio"), ("yaw", 90, "light_yaw", 90.0), ("shines", True, "sun", (30.0, 40.0)),
        ("choice", SUN_ALONE, "sun", (30.0, 40.0)), ("exposure", -1.5, "exposure", -1.5),
        ("background", "light", "background", "light"),
    ],
)  # fmt: skip
def test_every_control_reaches_the_options(control, value, field, expected):
    quiet = lights.options_of(**QUIET)
    asked = lights.options_of(**QUIET | {control: value})
    assert getattr(asked, field) == expected != getattr(quiet, field)


@pytest.mark.parametrize(
    ("control", "value"), [("azimuth", 200), ("elevation", -10), ("yaw", 45), ("exposure", 2), ("choice", "overcast")]
)
def test_every_control_changes_the_light(control, value):
    shining = QUIET | {"shines": True}
    one, other = (light_of(lights.options_of(**controls)) for controls in (shining, shining | {control: value}))
    assert np.abs(np.asarray(one.tables) - other.tables).mean() > 0.01


def test_the_sun_alone_has_no_map_and_nothing_asked_is_the_light_of_spnr_render():
    alone = lights.options_of(**QUIET | {"choice": SUN_ALONE})
    assert alone.light is None
    assert np.asarray(light_of(alone).tables[1]).min() < 1e-6
    assert light_of(Lighting()) is not None
    assert lights.made(lights.given(Lighting())).light is None


@pytest.mark.parametrize(
    ("control", "value"),
    [
        ("yaw", float("nan")), ("exposure", 1e9), ("elevation", 91), ("azimuth", "a"), ("yaw", None), ("choice", 3),
        ("background", "secret"), ("exposure", [1, 2]), ("azimuth", float("inf")),
    ],
)  # fmt: skip
def test_controls_that_say_what_they_do_not_offer_are_refused_in_one_line(control, value):
    with pytest.raises(ValueError, match="light|sun|exposure") as refused:
        lights.options_of(**QUIET | {"shines": True, control: value})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["/etc/passwd", "absent.hdr", ""])
def test_a_name_that_is_not_in_the_list_changes_nothing_and_reads_no_file(name):
    before = Lights()
    assert lights.changed(before, Lighting(light=name)) is before


def test_a_change_is_made_once_and_then_kept(monkeypatch):
    after, _ = session.draw(model(), state(Lighting(light="studio")), moving=True)
    monkeypatch.setattr(lights, "light_of_options", lambda *_: pytest.fail("the light was made again"))
    again, _ = session.draw(model(), dataclasses.replace(after, view=tiny_viewer.view(0.5)), moving=True)
    assert again.lights.light is after.lights.light


def test_two_sessions_share_no_light():
    first = state()
    mine, yours = first, first
    mine = dataclasses.replace(mine, lights=lights.with_map(mine.lights, "mine.hdr", lopsided()))
    session.draw(model(), mine, moving=False)
    assert "mine.hdr" in mine.lights.choices
    assert "mine.hdr" not in yours.lights.choices
    np.testing.assert_array_equal(session.draw(model(), yours, moving=False)[1].image, canvas())


# maps


def test_a_new_map_is_chosen_stays_in_the_list_and_one_of_its_name_replaces_it():
    one = lights.with_map(Lights(options=Lighting(exposure=1.0)), "a.hdr", lopsided())
    assert (one.choice, one.choices) == ("a.hdr", (*NAMES, "a.hdr", SUN_ALONE))
    close(lights.made(one).light.tables, 2 * lopsided().tables)
    back = lights.changed(one, Lighting(light="night"))
    assert "a.hdr" in back.choices
    close(lights.made(lights.with_map(back, "a.hdr", lopsided(3.0))).light.tables, lopsided(3.0).tables)


@pytest.mark.parametrize(("name", "words"), [("a.hdr", "a.hdr: not a readable"), ("../b.exr", "b.exr: not a readable")])
def test_a_bad_map_is_refused_in_one_line_under_the_browsers_name(name, words, tmp_path, monkeypatch):
    pytest.importorskip("mitsuba", reason="maps are read by mitsuba")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(ValueError, match=re.escape(words)) as refused:
        uploads.read_uploaded_map(name, b"#?RADIANCE\n")
    assert str(tmp_path) not in str(refused.value)
    assert "\n" not in str(refused.value)
    assert list(tmp_path.iterdir()) == []


def test_a_map_of_the_command_line_is_in_the_list_under_its_name(tmp_path):
    mi = pytest.importorskip("mitsuba", reason="maps are read by mitsuba")
    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    with light_files.threads(2):
        mi.Bitmap(np.random.default_rng(0).random((8, 16, 3), np.float32)).write(str(tmp_path / "sky.hdr"))
    found = lights.given(Lighting(light=str(tmp_path / "sky.hdr"), light_yaw=45.0))
    assert (found.choice, found.options.light_yaw) == ("sky.hdr", 45.0)
    uploaded = uploads.read_uploaded_map("sky.HDR", (tmp_path / "sky.hdr").read_bytes())
    close(lights.made(found).light.tables, uploaded.turned(45).tables, rtol=1e-5)
    with pytest.raises(ValueError, match="no such file"):
        lights.given(Lighting(light=str(tmp_path / "absent.hdr")))
