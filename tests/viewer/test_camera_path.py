"""Paths of the camera through keyframes, and films along them."""

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image
from support.tiny_viewer import canvas, model, state, view

from spnr_jax.viewer import camera_path, session


def keyframes(*azimuths):
    frames = (session.keyframe(view(azimuth), np.zeros(3)) for azimuth in azimuths)
    return tuple(frames)


def test_a_path_passes_its_keyframes_and_goes_around_what_it_looks_at():
    poses = camera_path.poses(keyframes(0.0, 1.5, 3.0), 41)
    for at, azimuth in ((0, 0.0), (20, 1.5), (40, 3.0)):
        np.testing.assert_allclose(poses[at][0], view(azimuth).position, atol=1e-9)
        np.testing.assert_allclose(poses[at][1], view(azimuth).rotation, atol=1e-9)
    for position, rotation in poses:
        assert np.linalg.norm(position) == pytest.approx(4)
        np.testing.assert_allclose(position - 4 * rotation[:, 2], 0, atol=1e-9)
    steps = [np.linalg.norm(b[0] - a[0]) for a, b in zip(poses, poses[1:], strict=False)]
    assert max(steps) < 2 * np.mean(steps)


def test_a_camera_that_only_moves_keeps_its_rotation():
    near, far = keyframes(0.3, 0.3)
    far = dataclasses.replace(far, position=2 * far.position, distance=2 * far.distance)
    poses = camera_path.poses((near, far), 5)
    assert [np.linalg.norm(position) for position, _ in poses] == pytest.approx([4, 5, 6, 7, 8])
    for _, rotation in poses:
        np.testing.assert_allclose(rotation, near.rotation)


def test_one_keyframe_is_no_path_and_a_path_of_an_hour_is_refused():
    with pytest.raises(ValueError, match="at least 2 keyframes"):
        session.path_poses(state(keyframes=keyframes(0.0)), 1.0)
    with pytest.raises(ValueError, match="at most"):
        session.path_poses(state(keyframes=keyframes(*np.linspace(0, 6, 100))), 10.0)


def test_keyframes_are_recorded_where_the_browser_looks_and_cleared():
    after = session.record(np.zeros(3))(session.record(np.zeros(3))(state()))
    assert [frame.distance for frame in after.keyframes] == pytest.approx([4, 4])
    assert session.without_keyframes(after).keyframes == ()
    assert session.record(np.zeros(3))(state(view=None)).keyframes == ()


def test_a_film_shows_the_path_and_a_snapshot_the_canvas():
    moving = state(keyframes=keyframes(0.0, 1.0))
    shares = []
    name, content, reason = session.film(model(), moving, 0.25, "gif", "points", shares.append)
    assert (name, reason) == ("path.gif", "")
    assert shares[-1] == 1
    with Image.open(io.BytesIO(content)) as film:
        assert (film.n_frames, film.size) == (5, (48, 48))
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(4)
        assert np.abs(np.asarray(film.convert("RGB")) - first).mean() > 2
    still = np.asarray(Image.open(io.BytesIO(session.snapshot(model(), state()))))
    np.testing.assert_array_equal(still, canvas())
