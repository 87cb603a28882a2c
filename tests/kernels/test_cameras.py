"""Views, and special rays through the box; the rest is in the tables of laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.laws import close, numbers

from spnr_jax.kernels import cameras
from spnr_jax.kernels.cameras import look_at, pinhole, resize

POSES = jax.jit(look_at)(3 * numbers(0, 2, 3, 3) + 0.1, jnp.zeros((2, 3, 3)), jnp.array([[[0.0, 1.0, 0.0]]]))
intersect_box = jax.jit(cameras.intersect_box)


@jax.jit
def camera():
    return pinhole(POSES, 0.8, 4, 6)


def test_a_pose_has_at_least_32_bits_and_its_centre_may_be_of_numpy():
    assert cameras.orbit(0.1, 0.2, 3.0, jnp.zeros(3, jnp.bfloat16)).dtype == jnp.float32
    assert cameras.orbit(np.zeros(2), 0.2, 3.0, np.zeros(3)).shape == (2, 3, 4)


def test_resizing_keeps_the_view():
    @jax.jit
    def corners(view):  # rays through the corners of the image: half a pixel outside the first and last centres
        local = jnp.array([[0.0, 0.0, 1.0], [view.width, 0.0, 1.0], [view.width, view.height, 1.0]])
        return jnp.linalg.solve(view.intrinsics, jnp.broadcast_to(local.T, view.intrinsics.shape))

    small = resize(camera(), 2, 12)
    assert (small.height, small.width) == (2, 12)
    close(corners(small), corners(camera()))
    close(resize(small, 4, 6).intrinsics, camera().intrinsics)


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0, 0, 3), (0, 0, -1), (2, 4)),  # parallel to two pairs of faces
        ((2, 0, 3), (0, 0, -1), None),  # parallel and beside the box
        ((0, 0, 0), (0, 1, 0), (0, 1)),  # from inside
        ((0, 0, 1), (0, 0, -1), (0, 2)),  # from a face inwards
        ((0, 0, 1), (0, 0, 1), None),  # from a face outwards
        ((1, 0, 3), (0, 0, -1), (2, 4)),  # along a face, in it
        ((-1, -1, 3), (0, 0, -1), (2, 4)),  # along an edge, in it
        ((0, 0, 3), (0, 0, 1), None),  # the box lies behind
        ((2, 2, 2), (-1, -1, -1), (1, 3)),  # through two corners
        ((2, 0, 0), (-1, 1, 0), None),  # touches an edge
        ((0, 0, 3e8), (0, 0, -1), (3e8, 3e8)),  # so far away that the box has no depth in float32
    ],
)
def test_special_rays_are_finite_and_right(origin, direction, expected):
    near, far, hit = intersect_box(jnp.array(origin, jnp.float32), jnp.array(direction, jnp.float32))
    if expected and expected[0] < expected[1]:
        assert bool(hit)
        close((near, far), (jnp.float32(expected[0]), jnp.float32(expected[1])))
    else:
        assert not hit
        assert near == far == 0
