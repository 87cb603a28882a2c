"""Flicker: 0 of what is painted on the object, and what one computes by hand where a light goes on and off."""

import dataclasses
import json

import numpy as np
import pytest
from support import tiny_dataset, tiny_untrained
from support.handmade import box

from data_gen.render.variant import choose_variant, mitsuba_module
from experiments.comparison.trained_networks import Sources
from experiments.studies import flicker
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera

FRAMES, SIZE = 12, 48


@pytest.fixture(scope="module")
def camera() -> Camera:
    intrinsics = np.float32([[1.4 * SIZE, 0, SIZE / 2], [0, 1.4 * SIZE, SIZE / 2], [0, 0, 1]])
    pose = np.float32([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3]])
    like = Camera(cam_to_world=pose[None], intrinsics=intrinsics[None], height=SIZE, width=SIZE)
    return flicker.turntable(like, FRAMES, 20.0)


@pytest.fixture(scope="module")
def ball(camera):
    """Distances (frames, h, w) to a ball of radius 0.7, and the places that are seen there."""
    rays = cameras.camera_rays(camera)
    origins, directions = np.float64(rays.origins), np.float64(rays.directions)
    along = -np.sum(origins * directions, axis=-1)
    inside = 0.7**2 - np.sum(origins**2, axis=-1) + along**2
    distances = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.inf)
    return distances, origins + np.where(inside > 0, distances, 0)[..., None] * directions


def test_a_whole_turn_in_equal_steps_at_one_distance_and_height(camera):
    eyes = np.asarray(camera.cam_to_world)[:, :, 3]
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), 3, rtol=1e-5)
    np.testing.assert_allclose(eyes[:, 1], 3 * np.sin(np.radians(20)), rtol=1e-5)
    steps = np.linalg.norm(eyes - np.roll(eyes, 1, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-4)


def test_paint_that_turns_with_the_object_does_not_flicker_and_paint_on_the_lens_does(camera, ball):
    distances, places = ball
    paint = 0.5 + 0.4 * np.sin(4 * places)
    still = flicker.flicker(paint, distances, camera)
    lens = np.broadcast_to(paint[:1], paint.shape)
    assert np.nanmax(still) < 0.01, "but for resampling"
    assert np.nanmin(flicker.flicker(lens, distances, camera)) > 0.1


def test_a_light_that_goes_on_and_off_flickers_by_as_much(camera, ball):
    distances, _ = ball
    frames = np.full((FRAMES, SIZE, SIZE, 3), 0.5) + 0.1 * (np.arange(FRAMES) % 2)[:, None, None, None]
    np.testing.assert_allclose(flicker.flicker(frames, distances, camera), 0.1, atol=1e-6)


def test_what_the_frame_before_does_not_see_does_not_count(camera, ball):
    """The colour of half the ball changes where it comes into sight."""
    distances, places = ball
    frames = np.full((FRAMES, SIZE, SIZE, 3), 0.5)
    blocked = distances.copy()
    blocked[4] = 1.0  # something stands before the whole of frame 4
    found = flicker.flicker(frames + (np.arange(FRAMES) == 4)[:, None, None, None], blocked, camera)
    assert np.isnan(found[4]), "frame 5 sees no place that frame 4 saw"
    np.testing.assert_allclose(np.delete(found, [3, 4]), 0, atol=1e-6)


def test_the_ratio_is_by_object_and_the_references_are_their_own():
    curves = {"references": [np.array([0.1, 0.1]), np.array([0.2, np.nan])], "ours": [np.array([0.2, 0.2])] * 2}
    rows = flicker.summarise(curves, ("a", "b"))["methods"]
    assert rows["references"]["ratio"] == 1
    assert rows["ours"]["ratio"] == pytest.approx((2 + 1) / 2)


@pytest.mark.ci
def test_the_whole_way(tmp_path, monkeypatch):
    pytest.importorskip("mitsuba")
    options = flicker.Flicker(
        data=tiny_dataset.dataset().folder, out=tmp_path, sources=Sources(runs=(tiny_untrained.run(),)), objects=1,
        frames=20, spp=1,
    )  # fmt: skip
    mitsuba_module(choose_variant("scalar_rgb")[0])
    monkeypatch.setattr(flicker, "mesh_of", lambda *_: Asset(parts=(box(),)))
    monkeypatch.setattr(flicker, "view_config", lambda _: flicker.views.ViewConfig(resolution=tiny_dataset.SIZE))
    monkeypatch.setattr(flicker, "light_of", lambda *_: np.ones((4, 8, 3), np.float32))
    flicker.main(options)
    results = json.loads((tmp_path / "results.json").read_text())
    assert len(results["methods"]) == 2
    assert all(row["flicker"] >= 0 for row in results["methods"].values())
    assert {path.suffix for path in tmp_path.iterdir()} >= {".png", ".gif", ".md"}
    with pytest.raises(ValueError, match="another frames"):
        flicker.main(dataclasses.replace(options, frames=4))
    with pytest.raises(
        ValueError, match="--frames 3: neighbouring ones see no place of ball_000004 in common; take more"
    ):
        flicker.main(dataclasses.replace(options, frames=3, out=tmp_path / "few"))
