"""Lights by name and from files, and turned."""

import numpy as np
import pytest
from PIL import Image
from support.laws import close

import spnr_jax
from spnr_jax.formats import images
from spnr_jax.formats.images import read_envmap, read_light, threads
from spnr_jax.surfels import skies
from spnr_jax.surfels.lighting import HEIGHT, room_light

mi = pytest.importorskip("mitsuba", reason="maps are read by mitsuba")


def write(path, envmap):
    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    with threads(2):
        mi.Bitmap(np.asarray(envmap, np.float32)).write(str(path))
    return path


def test_a_light_by_name_is_its_map_normalised_or_as_it_is():
    close(read_light("room").tables, room_light().tables, rtol=2e-3)
    for name in ("studio", "night"):
        bright = read_light(name, normalise=False).tables
        close(bright, spnr_jax.light_of(skies.NAMED[name](skies.HEIGHT)).tables, rtol=1e-5)


@pytest.mark.parametrize("ending", [".exr", ".hdr"])
def test_a_file_gives_the_light_of_its_map(tmp_path, ending):
    envmap = skies.studio(64)
    path = write(tmp_path / f"studio{ending}", envmap)
    close(read_envmap(path), envmap, rtol=0.01 if ending == ".hdr" else 1e-6, atol=1e-3)  # .hdr has 8 bits of mantissa
    close(read_light(path, normalise=False).tables, spnr_jax.light_of(envmap).tables, rtol=0.01, atol=1e-3)


def test_what_is_no_map_is_refused_in_a_line_that_names_it(tmp_path, monkeypatch):
    grey = Image.fromarray(np.full((4, 8, 3), 90, np.uint8))
    grey.save(tmp_path / "picture.png")
    (tmp_path / "picture.png").rename(tmp_path / "renamed.hdr")
    grey.save(tmp_path / "picture.png")
    (tmp_path / "broken.hdr").write_bytes(b"#?RADIANCE\n")
    for name, values in (("square", np.ones((8, 8, 3))), ("nan", np.full((4, 8, 3), np.nan))):
        write(tmp_path / f"{name}.exr", values)
    write(tmp_path / "negative.exr", np.full((4, 8, 3), -1.0))
    write(tmp_path / "black.exr", np.zeros((4, 8, 3)))
    reasons = {"absent.hdr": "no such file", "picture.png": "8-bit", "renamed.hdr": "8- or 16-bit", "nan.exr": "finite"}
    reasons |= {"broken.hdr": "not a readable", "square.exr": "twice as wide", "negative.exr": ">= 0"}
    for name, reason in (reasons | {"black.exr": "some light"}).items():
        with pytest.raises(ValueError, match=f"(?s){name}: .*{reason}") as caught:
            read_light(tmp_path / name)
        assert "\n" not in str(caught.value)
    monkeypatch.setattr(images, "MOST_BYTES", 10)
    with pytest.raises(ValueError, match=r"square\.exr: .* MB"):
        read_light(tmp_path / "square.exr")


def test_a_turn_is_that_of_the_azimuth_and_a_whole_one_changes_nothing():
    sun = spnr_jax.sun(30, 20, size=30)
    step = 360 / (2 * HEIGHT)
    close(sun.turned(360).tables, sun.tables, atol=1e-6)
    close(sun.turned(6 * step).tables, spnr_jax.sun(30 + 6 * step, 20, size=30).tables, atol=2e-3)
    close(sun.turned(10).turned(-10 + 8 * step).tables.sum(), sun.tables.sum(), rtol=1e-5)
