"""Every picture that was asked for lies where it was said, and a cloud in any file comes out as pictures."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence
from support import tiny_untrained

from spnr_jax.formats.orientation import ROTATIONS
from spnr_jax.tools import pictures
from spnr_jax.tools.commands import Lighting, Render

OPTIONS = {"views": 2, "resolution": 24, "num_points": 30, "up": "y", "frames": 5}
KINDS = (".png", "_depth.png", "_depth.npy", "_opacity.png")
STILLS = {f"chair_{i:03d}{kind}" for i in range(2) for kind in KINDS} | {"chair_cameras.json"}


def cloud_file(folder, name="chair.xyz", count=40):
    points = np.random.default_rng(0).uniform(-1, 1, (count, 3))
    np.savetxt(folder / name, points)
    return folder / name


def rendered(cloud, out, **options):
    notes: list[str] = []
    command = Render(cloud=cloud, out=out, **{"run": tiny_untrained.run()} | OPTIONS | options)
    return [*pictures.render_file(command, notes.append), *notes]


def shown(path):
    with Image.open(path) as picture:
        return np.asarray(picture)


def names(out):
    return {path.name for path in out.iterdir()}


def test_stills_depth_opacity_and_a_turntable_of_the_asked_frames_are_written(tmp_path):
    out = tmp_path / "new" / "out"
    lines = rendered(cloud_file(tmp_path), out)
    assert names(out) == STILLS | {"chair_turntable.gif"}
    assert shown(out / "chair_000.png").shape[:2] == shown(out / "chair_001.png").shape[:2] == (24, 24)
    assert {shown(out / name).shape[:2] for name in STILLS if "depth.png" in name or "opacity" in name} == {(8, 8)}
    with Image.open(out / "chair_turntable.gif") as film:
        assert film.n_frames == 5
    assert any("30 of 40 points" in line for line in lines)
    pictures = ("chair_000.png", "chair_001.png", "chair_turntable.gif")
    assert [line for line in lines if line.startswith("wrote")] == [f"wrote {out / name}" for name in pictures]


def test_a_file_turned_and_moved_gives_the_same_pictures_and_cameras_that_moved_with_it(tmp_path):
    turn, shift = np.array(ROTATIONS["z"], float), np.array([16.0, -4.0, 2.0])
    points = np.round(np.random.default_rng(0).uniform(-1, 1, (30, 3)) * 64) / 64  # exact in float32, also moved
    for name, positions in (("a", points), ("b", points @ turn + shift)):
        np.save(tmp_path / f"{name}.npy", positions)
    for name, up in (("a", "y"), ("b", "z")):
        rendered(tmp_path / f"{name}.npy", tmp_path, up=up, views=1, turntable="none")
    for kind in KINDS[:2]:
        assert np.abs(shown(tmp_path / f"a_000{kind}").astype(int) - shown(tmp_path / f"b_000{kind}")).max() <= 1
    documents = [json.loads((tmp_path / f"{name}_cameras.json").read_text()) for name in "ab"]
    here, there = (np.array(d["frames"][0]["transform_matrix"]) for d in documents)
    np.testing.assert_allclose(there[:3, :3], turn.T @ here[:3, :3], atol=1e-6)
    np.testing.assert_allclose(there[:3, 3], turn.T @ here[:3, 3] + shift, atol=1e-5)
    for document, positions in zip(documents, (points, points @ turn + shift), strict=True):
        to_box = document["normalization"]
        inside = to_box["scale"] * (positions @ np.array(to_box["rotation"]).T - to_box["centre"])
        np.testing.assert_allclose(inside.min(axis=0), -inside.max(axis=0), atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(inside.max(axis=0)), 1, atol=1e-5)


def test_the_cameras_that_were_written_draw_the_same_stills_again(tmp_path):
    cloud = cloud_file(tmp_path)
    rendered(cloud, tmp_path / "a", up="z", turntable="none", elevation=40.0)
    written = tmp_path / "a" / "chair_cameras.json"
    again = Render(cloud=cloud, out=tmp_path / "b", run=tiny_untrained.run(), cameras=written, num_points=30, up="z")
    list(pictures.render_file(dataclasses.replace(again, frames=2), lambda line: None))
    assert names(tmp_path / "b") == STILLS | {"chair_turntable.gif"}
    for name in sorted(STILLS):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    own = json.loads(written.read_text()) | {"more": "of its owner"}
    written.write_text(json.dumps(own))
    list(pictures.render_file(dataclasses.replace(again, out=tmp_path / "a", turntable="none"), lambda line: None))
    assert json.loads(written.read_text()) == own, "the cameras that are read stay as they are"
    with pytest.raises(ValueError, match="--views: not together with --cameras"):
        dataclasses.replace(again, views=2)
    written.write_text("{}")
    with pytest.raises(ValueError, match=r"chair_cameras\.json: no frames"):
        list(pictures.render_file(dataclasses.replace(again, cloud=tmp_path / "none.ply"), lambda line: None))


def test_straight_alpha_laid_on_white_is_the_image_again():
    rng = np.random.default_rng(0)
    acc = rng.uniform(0.1, 1, size=(8, 8)).astype(np.float32)
    image = acc[..., None] * rng.uniform(size=(8, 8, 3)) + 1 - acc[..., None]
    rgba = pictures.straight_alpha(image, acc)
    np.testing.assert_allclose(rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:], image, atol=1e-5)
    nothing = pictures.straight_alpha(np.ones((4, 4, 3)), np.zeros((2, 2)))
    np.testing.assert_array_equal(nothing, np.broadcast_to([1.0, 1, 1, 0], (4, 4, 4)))


def test_a_transparent_still_has_an_alpha_channel_and_chosen_outputs_alone_are_written(tmp_path):
    out = tmp_path / "out"
    rendered(cloud_file(tmp_path), out, turntable="none", outputs=("image",), transparent=True)
    assert names(out) == {"chair_000.png", "chair_001.png", "chair_cameras.json"}
    assert shown(out / "chair_000.png").shape == (24, 24, 4)
    lines = rendered(cloud_file(tmp_path), tmp_path / "other", turntable="none", views=1, outputs=("opacity",))
    assert names(tmp_path / "other") == {"chair_000_opacity.png", "chair_cameras.json"}
    assert f"wrote {tmp_path / 'other' / 'chair_000_opacity.png'}" in lines


@pytest.mark.ci
def test_the_light_changes_still_and_background_and_not_the_opacity_and_one_that_turns_every_frame(tmp_path):
    cloud, common = cloud_file(tmp_path), {"run": Path("surfels"), "quality": "draft", "views": 1, "frames": 3}
    rendered(cloud, tmp_path / "plain", **common, turntable="none")
    lighting = Lighting(exposure=-1.0)
    rendered(cloud, tmp_path / "lit", **common, turn="light", lighting=lighting, background="light")
    plain, lit = (shown(tmp_path / name / "chair_000.png").astype(int) for name in ("plain", "lit"))
    opacities = [(tmp_path / name / "chair_000_opacity.png").read_bytes() for name in ("plain", "lit")]
    assert lit[0, 0].min() < 250 < plain[0, 0].min()
    assert lit.mean() < plain.mean() - 8
    assert opacities[0] == opacities[1]
    with Image.open(tmp_path / "lit" / "chair_turntable.gif") as film:
        frames = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(film)]
    assert len(frames) == 3
    assert all(np.abs(frames[0] - other).max() > 8 for other in frames[1:])
