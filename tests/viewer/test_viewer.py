"""The viewer without a browser: one camera for all panes, edits that the network sees, and pictures in time."""

import dataclasses
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_viewer
from support.tiny_viewer import canvas, drawn, model, scene, state, view

from spnr_jax import cli
from spnr_jax.kernels import cameras
from spnr_jax.viewer import picture, session, viewpoint
from spnr_jax.viewer import scene as scenes
from spnr_jax.viewer.loop import Loop

ROOT = Path(__file__).parents[2]


def pane(image, number, count=2):
    width = image.shape[1] // count
    return image[:, number * width + 2 : (number + 1) * width - 2]


def reddish(image):
    return (image[..., 0] > 150) & (image[..., 1:].max(axis=-1) < 120)


def bluish(image):
    return (image[..., 2] > 150) & (image[..., :2].max(axis=-1) < 120)


# views


def test_the_browsers_convention_and_ours_are_each_others_inverse():
    rotation = view(0.7).rotation
    again = viewpoint.from_browser(viewpoint.to_browser(rotation), np.ones(3), 0.5, 10, 10)
    np.testing.assert_allclose(again.rotation, rotation, atol=1e-12)


@pytest.mark.parametrize(
    "changed",
    [
        {"position": [np.nan, 0, 0]}, {"position": [1e9, 0, 0]}, {"position": [0, 0]}, {"wxyz": [0, 0, 0, 0]},
        {"wxyz": [np.inf, 0, 0, 1]}, {"field_of_view": 0.0}, {"field_of_view": 3.2}, {"field_of_view": np.nan},
        {"width": 0}, {"height": -5},
    ],
)  # fmt: skip
def test_a_camera_from_which_nothing_can_be_drawn_is_no_view(changed):
    changed = {name: np.array(value) if isinstance(value, list) else value for name, value in changed.items()}
    good = {"wxyz": np.eye(4)[0], "position": 3 * np.eye(3)[2], "field_of_view": 0.7, "width": 100, "height": 50}
    assert viewpoint.from_browser(**good) is not None
    assert viewpoint.from_browser(**good | changed) is None


@pytest.mark.parametrize(("width", "height"), [(60, 60), (90, 30), (30, 90)])
def test_a_place_of_the_square_that_the_network_draws_is_cut_to_its_place_in_the_pane(width, height):
    volume, size = scene().volume, 96
    square = viewpoint.square_camera(view(), volume, width, height, size)
    small = viewpoint.pane_camera(view(), volume, width, height)
    positions = np.asarray(scene().cloud.positions, np.float64)
    in_square, _ = viewpoint.project(square, positions)
    in_pane, _ = viewpoint.project(small, positions)
    shift = size / 2 - np.array([width, height]) * size / max(width, height) / 2
    np.testing.assert_allclose((in_square - shift) * max(width, height) / size, in_pane, atol=1e-3)
    marked = np.zeros((size, size, 3), np.uint8)
    middle, _ = viewpoint.project(square, np.asarray(scene().volume.centre, np.float64)[None])
    column, row = middle[0].astype(int)
    marked[row - 2 : row + 2, column - 2 : column + 2] = 255
    rows, columns = np.nonzero(viewpoint.cut(marked, width, height)[..., 0] > 100)
    assert abs(rows.mean() + 0.5 - height / 2) < 1
    assert abs(columns.mean() + 0.5 - width / 2) < 1


def test_points_are_projected_where_cameras_project_puts_them():
    camera = viewpoint.pane_camera(view(0.4), scene().volume, 80, 60)
    expected, _ = cameras.project(jax.tree.map(jnp.asarray, camera), jnp.asarray(scene().cloud.positions))
    pixels, depth = viewpoint.project(camera, scene().cloud.positions)
    np.testing.assert_allclose(pixels, expected, atol=1e-3)
    assert (depth > 0).all()
    pixels, depth = viewpoint.project(camera, (camera.cam_to_world[:, 3] + camera.cam_to_world[:, 2])[None])
    assert np.isnan(pixels).all()
    assert depth < 0


# pictures


def test_both_panes_show_the_same_camera_and_the_right_layers():
    image = canvas(panes=("points", "opacity"))
    assert image.shape == (60, 120, 3)
    points = pane(image, 0)
    left, right = points[:, : points.shape[1] // 2], points[:, points.shape[1] // 2 :]
    assert reddish(left).mean() > 0.1 > 0.02 > reddish(right).mean()
    assert bluish(right).mean() > 0.1 > 0.02 > bluish(left).mean()


def test_every_layer_is_another_picture_and_one_pane_takes_the_whole_canvas():
    images = {layer: canvas(panes=(layer,)) for layer in picture.LAYERS}
    assert all(image.shape == (60, 120, 3) for image in images.values())
    for first in images:
        for second in images:
            if first < second:
                assert np.abs(images[first].astype(int) - images[second]).mean() > 2, (first, second)


def test_points_need_no_network_and_say_so_by_no_time():
    assert drawn(panes=("points",)).milliseconds is None
    outline = session.outline(model(), state())
    assert reddish(pane(outline, 0)).any()
    assert (pane(outline, 1)[:30] == 255).all()


def test_points_are_drawn_once_for_a_scene_and_view_and_anew_for_an_edited_scene(monkeypatch):
    asked, draw_points = [], picture.draw_points
    monkeypatch.setattr(picture, "draw_points", lambda *scene: asked.append(scene) or draw_points(*scene))
    known = state()
    first, again = (picture.draw(model(), known.scene, known.view, ("points",), None, 8, 60).image for _ in range(2))
    assert len(asked) == 1
    np.testing.assert_array_equal(first, again)
    blue = scenes.edited(known.scene, "base_color", (0.0, 0.0, 1.0))
    assert bluish(picture.draw(model(), blue, known.view, ("points",), None, 8, 60).image).any()
    assert len(asked) == 2


def test_nearer_points_hide_farther_ones():
    two = dataclasses.replace(
        tiny_viewer.cloud(),
        **{name: np.asarray(getattr(tiny_viewer.cloud(), name))[:2] for name in ("roughness", "metallic", "mask")},
        positions=np.float32([[0, 0, -1], [0, 0, 1]]),
        base_color=np.float32([tiny_viewer.RED, tiny_viewer.BLUE]),
    )
    opened = scenes.open_scene(model(), two, "two")
    assert bluish(picture.draw_points(opened, viewpoint.pane_camera(view(), opened.volume, 60, 60))).any()
    assert not reddish(picture.draw_points(opened, viewpoint.pane_camera(view(), opened.volume, 60, 60)))[
        28:32, 28:32
    ].any()


def test_while_things_move_the_draft_is_drawn_and_at_rest_what_was_chosen():
    for moving, expected in ((True, ("draft", 24)), (False, ("balanced", 48))):
        picture_of_it = drawn(moving=moving, quality="balanced")
        assert (picture_of_it.quality, picture_of_it.size) == expected
        assert picture_of_it.milliseconds > 0


def test_nothing_is_drawn_before_the_browser_said_where_it_looks_from():
    assert drawn(view=None) is None
    assert session.outline(model(), state(view=None)) is None


# materials


def test_an_edit_changes_the_selected_points_alone_and_what_the_network_draws():
    before = canvas(panes=("picture",))
    chosen = session.select(state(), (0.0, 0.0), (0.25, 1.0), add=False)
    red = np.asarray(scene().cloud.positions)[:, 0] < 4
    assert chosen.scene.selected[red].mean() > 0.9
    assert not chosen.scene.selected[np.asarray(scene().cloud.positions)[:, 0] > 6].any()
    green = scenes.edited(chosen.scene, "base_color", (0.0, 1.0, 0.0))
    np.testing.assert_allclose(green.cloud.base_color[green.selected], [[0, 1, 0]] * green.selected.sum(), atol=1e-6)
    kept = ~green.selected
    np.testing.assert_array_equal(green.cloud.base_color[kept], scene().cloud.base_color[kept])
    assert green.stale
    after, now = session.draw(model(), state(panes=("picture",), scene=green), moving=False)
    assert not after.scene.stale
    assert np.abs(now.image.astype(int) - before).max() > 3
    assert scene().cloud.base_color[:, 1].max() < 0.1, "the file's cloud is as it was"


@pytest.mark.parametrize("material", ["roughness", "metallic"])
def test_without_a_selection_an_edit_changes_all_points_and_restoring_gives_the_files_materials(material):
    changed = scenes.edited(scene(), material, 1.5)
    assert (getattr(changed.cloud, material) == 1).all()
    assert scenes.mean_materials(changed)[1 if material == "roughness" else 2] == 1
    assert scenes.restored(changed).cloud is scene().cloud
    before, after = (canvas(panes=("picture",), scene=s) for s in (scene(), changed))
    assert np.abs(before.astype(int) - after).max() > 0


def test_a_rectangle_in_either_pane_selects_the_same_points_and_can_be_added_to():
    in_left = session.select(state(), (0.05, 0.2), (0.2, 0.7), add=False)
    in_right = session.select(state(), (0.7, 0.7), (0.55, 0.2), add=False)
    assert 0 < in_left.scene.selected.sum() < 200
    np.testing.assert_array_equal(in_left.scene.selected, in_right.scene.selected)
    both = session.select(in_left, (0.3, 0.2), (0.45, 0.7), add=True)
    assert both.scene.selected.sum() > in_left.scene.selected.sum()
    assert both.scene.selected[in_left.scene.selected].all()
    assert not scenes.select_all(both.scene).selected.any()


def test_the_controls_show_the_means_of_what_an_edit_would_change():
    half = session.select(state(), (0.0, 0.0), (0.2, 1.0), add=False).scene
    (red, green, blue), roughness, metallic = scenes.mean_materials(half)
    assert red > 200 > 100 > max(green, blue)
    assert (roughness, metallic) == (0.5, 0)


def test_selected_points_are_ringed():
    chosen = session.select(state(), (0.0, 0.0), (0.25, 1.0), add=False)
    image = canvas(panes=("points",), scene=chosen.scene)
    rings = (image == picture.SELECTED).all(axis=-1)
    assert rings[:, :60].any()
    assert not (canvas(panes=("points",)) == picture.SELECTED).all(axis=-1).any()


# the loop


def test_changes_are_applied_in_order_drawn_at_once_and_once_more_at_rest():
    drawn, rested = [], threading.Event()

    def show(numbers, moving):
        drawn.append((tuple(numbers), moving))
        if numbers and not moving:
            rested.set()
        return numbers

    loop = Loop([], show, rest=0.05)
    for number in range(5):
        loop.submit(lambda numbers, number=number: [*numbers, number])
    loop.start()
    assert rested.wait(10)
    loop.stop()
    loop.join(10.0)
    assert drawn[0] == ((), True)
    assert drawn[1:] == [((0, 1, 2, 3, 4), True), ((0, 1, 2, 3, 4), False)]
    assert loop.stopped


def test_changes_that_come_while_a_picture_is_drawn_wait_together_and_supersede_it():
    drawn, begun, go, seen = [], threading.Event(), threading.Event(), []

    def show(number, moving):
        if number == 0:
            begun.set()
            go.wait(10)
            seen.append(loop.superseded)
        drawn.append(number)
        if number == 3:
            loop.stop()
        return number

    loop = Loop(0, show, rest=10.0)
    loop.start()
    assert begun.wait(10)
    for _ in range(3):
        loop.submit(lambda number: number + 1)
    go.set()
    loop.join(10.0)
    assert drawn == [0, 3]
    assert seen == [True]


def test_without_viser_the_command_says_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'spnr-jax\[viewer\]'"):
        cli.run_view(cli.View(cloud=Path("a.ply"), run=Path("run")))
