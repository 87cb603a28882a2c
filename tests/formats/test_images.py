import errno
import importlib.util
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib import colormaps
from PIL import Image

from spnr_jax.formats.images import depth_image, png, to_uint8, write_turntable, write_whole


def shaded_frames(count: int) -> list[np.ndarray]:
    """A smoothly shaded, tinted disc that moves over white, float in [0, 1]."""
    y, x = np.mgrid[:64, :64] / 64
    frames = []
    for center in np.linspace(0.3, 0.7, count):
        shade = 1 - 1.5 * np.hypot(x - center + 0.1, y - 0.4)
        disc = np.hypot(x - center, y - 0.5) < 0.3
        frames.append(np.where(disc[..., None], shade[..., None] * [1.0, 0.7, 0.3], 1.0))
    return frames


def test_eight_bit_values_round_to_the_nearest_level_and_a_png_holds_them(tmp_path):
    levels = to_uint8(np.array([-0.1, 0.0, 0.4999 / 255, 0.5, 1.0, 1.2]))
    np.testing.assert_array_equal(levels, [0, 0, 0, 128, 255, 255])
    np.testing.assert_array_equal(to_uint8(np.arange(256) / 255), np.arange(256))
    for shape in ((5, 7, 3), (5, 7)):
        image = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
        (tmp_path / "a.png").write_bytes(png(image))
        with Image.open(tmp_path / "a.png") as opened:
            np.testing.assert_array_equal(np.asarray(opened), image)


def test_depth_is_bright_where_near_in_viridis_and_spans_the_opaque_pixels_alone():
    rng = np.random.default_rng(1)
    depth, acc = rng.uniform(2, 3, (6, 6)), (rng.uniform(size=(6, 6)) < 0.7).astype(float)
    shown = depth_image(depth, acc)
    np.testing.assert_array_equal(depth_image(np.where(acc > 0, depth, 1e6), acc), shown)
    assert np.abs(depth_image(100 * depth, acc).astype(int) - shown).max() <= 1
    depth = np.linspace(3, 2, 500)[None]
    shown = depth_image(depth, np.ones_like(depth)).astype(int)
    assert np.abs(shown - colormaps["viridis"](3 - depth, bytes=True)[..., :3]).max() <= 4


def test_a_file_that_cannot_be_finished_leaves_the_old_one_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "new" / "a.bin"
    write_whole(path, b"old")

    def full(source, target):
        raise OSError(errno.ENOSPC, "disk full")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="disk full") as caught:
        write_whole(path, b"newer")
    assert caught.value.filename == str(path), "the disk's own errors of writing name no file"
    assert path.read_bytes() == b"old"
    assert [p.name for p in path.parent.iterdir()] == ["a.bin"]


def test_a_turntable_gif_loops_at_its_rate_and_shows_every_frame_with_a_pure_white_background(tmp_path):
    frames = shaded_frames(12)
    path, reason = write_turntable(tmp_path / "a.gif", frames, fps=20)
    assert (path, reason) == (tmp_path / "a.gif", "")
    with Image.open(path) as film:
        assert (film.info["loop"], film.info["duration"]) == (0, 50)
        shown = np.stack([np.asarray(film.convert("RGB")) for i in range(film.n_frames) if not film.seek(i)])
    wanted = np.stack([to_uint8(frame) for frame in frames])
    np.testing.assert_array_equal((shown == 255).all(axis=-1), (wanted == 255).all(axis=-1))
    error = np.abs(shown.astype(int) - wanted)[(wanted < 255).any(axis=-1)]
    assert error.mean() < 2
    assert error.max() <= 12


@pytest.mark.parametrize("background", [1.0, 0.4])
def test_the_background_of_a_gif_is_exact_beside_colours_that_are_nearly_its(tmp_path, background):
    frames = [frame * background for frame in shaded_frames(4)]
    for frame in frames:
        frame[20:] = np.where(
            frame[20:] == background, background * np.linspace(0.96, 1, frame.shape[1])[:, None], frame[20:]
        )
    path, _ = write_turntable(tmp_path / "a.gif", frames, fps=20)
    with Image.open(path) as film:
        shown = np.stack([np.asarray(film.convert("RGB")) for i in range(film.n_frames) if not film.seek(i)])
    np.testing.assert_array_equal(shown[:, 0, 0], to_uint8(np.full((4, 3), background)))


def test_an_mp4_without_its_encoder_becomes_a_gif_and_one_line_says_why(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    path, reason = write_turntable(tmp_path / "a.mp4", shaded_frames(3), fps=10)
    assert path == tmp_path / "a.gif"
    assert path.is_file()
    assert "imageio-ffmpeg" in reason


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="needs imageio-ffmpeg")
def test_an_mp4_has_every_frame(tmp_path):
    import imageio_ffmpeg

    path, reason = write_turntable(tmp_path / "a.mp4", [frame[:63, :61] for frame in shaded_frames(10)], fps=10)
    assert (path, reason) == (tmp_path / "a.mp4", "")
    assert imageio_ffmpeg.count_frames_and_secs(str(path))[0] == 10


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="needs imageio-ffmpeg")
def test_an_mp4_names_the_colour_space_that_its_colours_are_right_in(tmp_path):
    import imageio_ffmpeg

    colors = np.array([[200, 40, 40], [40, 200, 40], [40, 40, 200]], np.uint8)
    path, _ = write_turntable(tmp_path / "a.mp4", [colors.repeat(16, axis=0)[:, None].repeat(32, axis=1)] * 2, fps=10)
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(decode, capture_output=True, check=True)
    shown = np.frombuffer(done.stdout, np.uint8).reshape(2, 48, 32, 3)[0, 8::16, 16]
    assert np.abs(shown.astype(int) - colors).max() <= 4
    said = done.stderr.decode()
    assert "yuv420p(tv, bt709/bt709/iec61966-2-1" in said, "Chromium takes the matrix of unnamed HD films as bt709"


@pytest.mark.parametrize("reads", ["", "cat > /dev/null; "])
@pytest.mark.parametrize(("says", "reason"), [("echo full >&2; ", "full"), ("", "no reason given")])
def test_an_mp4_that_ffmpeg_cannot_write_leaves_the_one_before(tmp_path, monkeypatch, reads, says, reason):
    broken, film = tmp_path / "ffmpeg", tmp_path / "a.mp4"
    broken.write_text(f'#!/bin/sh\n{reads}{says}for out; do :; done; echo half > "$out"; exit 1\n')
    broken.chmod(0o755)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", SimpleNamespace(get_ffmpeg_exe=lambda: str(broken)))
    film.write_text("whole")
    with pytest.raises(ValueError, match=rf"a.mp4: ffmpeg could not write it \({reason}\)"):
        write_turntable(film, shaded_frames(20), fps=10)
    assert (film.read_text(), {place.name for place in tmp_path.iterdir()}) == ("whole", {"ffmpeg", "a.mp4"})


@pytest.mark.parametrize(
    ("fps", "said"),
    [(16, ""), (24, ""), (30, "33.3 frames a second"), (45, "50 frames a second"), (240, "100 frames a second")],
)
def test_a_gif_says_the_rate_at_which_it_plays_where_it_is_another(tmp_path, fps, said):
    path, reason = write_turntable(tmp_path / "a.gif", shaded_frames(2), fps)
    assert reason == (said and f"{said}, as a .gif counts hundredths of a second")
    with Image.open(path) as film:
        assert 1000 / film.info["duration"] == pytest.approx(float(said.split()[0]) if said else fps, rel=0.05)


@pytest.mark.parametrize(
    ("name", "count", "fps", "reason"),
    [("a.avi", 2, 10, ".gif or .mp4 file, not '.avi'"), ("a.gif", 0, 10, "0 frames"), ("a.gif", 2, 0, "at 0 fps")],
)
def test_a_turntable_that_cannot_be_is_refused(tmp_path, name, count, fps, reason):
    with pytest.raises(ValueError, match=reason):
        write_turntable(tmp_path / name, shaded_frames(count), fps)
