"""Which points a picture sees, against rays that the tests cast themselves, one triangle after the other."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.handmade import WHITE_LIGHT, ball, box

from data_gen.render import views
from data_gen.render.variant import LLVM, choose_variant
from spnr_jax.formats import surface_points
from spnr_jax.formats.assets import Asset

CONFIG = views.ViewConfig(resolution=64, views=1)
WALL_AND_BOX = Asset(parts=(box((0, 0, -0.3), (0.8, 0.5, 0.05)), box((0.2, 0, 0.3), (0.25, 0.2, 0.1))))
CROWD = Asset(parts=(*WALL_AND_BOX.parts, ball((-0.4, 0.1, 0.2), 0.3, rows=5)))
# none lies in the plane of a box's side: a side seen edge-on is neither hidden nor seen
EYES = np.array([[0.33, 0.27, 2.9], [1.9, 1.3, 1.8], [-2.2, -1.1, 1.4], [0.9, 2.1, -2.0]])


def hidden(asset, positions, eye):
    """(points,) bool: whether a triangle crosses the segment from a point to the eye (Möller and Trumbore 1997)."""
    result = np.zeros(len(positions), bool)
    towards = eye - positions
    for part in asset.parts:
        for a, b, c in part.positions[part.faces]:
            across = np.cross(towards, c - a)
            determinant = across @ (b - a)
            with np.errstate(divide="ignore", invalid="ignore"):
                u = ((positions - a) * across).sum(1) / determinant
                along = np.cross(positions - a, b - a)
                v = (towards * along).sum(1) / determinant
                t = along @ (c - a) / determinant
            result |= (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-5) & (t < 1)
    return result


@pytest.mark.parametrize("eye", EYES)
def test_the_faces_that_primary_rays_hit_are_those_with_a_point_that_sees_the_camera(eye):
    surface = surface_points.sample_surface(CROWD, 20_000, 1)
    hit = views.visible_faces(views.build_scene(CROWD, WHITE_LIGHT), views.look_at(eye), CONFIG, 0)
    sees = ~hidden(CROWD, surface.positions.astype(np.float64), eye)
    seeing, count = np.unique(surface.face[sees], return_counts=True)
    assert set(seeing[count > 2]) <= set(hit)
    sampled, samples = np.unique(surface.face, return_counts=True)
    assert set(hit) & set(sampled[samples > 200]) <= set(seeing)  # no face is reported that nowhere sees the camera
    assert 10 < len(hit) < sum(len(part.faces) for part in CROWD.parts)


# Run in a process of its own: one process has one variant, and its numbers of shapes go on from scene to scene.
COMPILED = f"""
import sys
sys.path[:0] = {[str(Path(__file__).parent), str(Path(__file__).parents[2])]!r}
import numpy as np
from data_gen.render import views
from data_gen.render.variant import mitsuba_module
mitsuba_module(sys.argv[1])
from test_visibility import CONFIG, CROWD, EYES, WALL_AND_BOX, WHITE_LIGHT
kept = [views.build_scene(WALL_AND_BOX, WHITE_LIGHT), views.build_scene(CROWD, WHITE_LIGHT)]
scene = views.build_scene(CROWD, WHITE_LIGHT)
for eye in EYES:
    print(*views.visible_faces(scene, views.look_at(eye), CONFIG, 0))
image = views.render_view(scene, views.look_at(EYES[0]), CONFIG, 0)
print(*image.mean(axis=(0, 1)))
"""


@pytest.mark.ci
def test_the_compiled_variant_sees_and_draws_what_the_scalar_one_does_with_other_scenes_alive():
    if choose_variant()[0] != LLVM:
        pytest.skip("needs an LLVM library that Mitsuba's compiled variant works with")
    outputs = []
    for variant in ("scalar_rgb", LLVM):
        command = [sys.executable, "-c", COMPILED, variant]
        outputs.append(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines())
    scalar, compiled = ([np.array(line.split(), float) for line in lines] for lines in outputs)
    for expected, got in zip(scalar[:-1], compiled[:-1], strict=True):
        assert len(expected) > 10
        assert len(np.setxor1d(expected, got)) <= 2
    np.testing.assert_allclose(compiled[-1], scalar[-1], rtol=0.01)
