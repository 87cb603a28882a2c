import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import surfel_clouds

from spnr_jax.kernels.cameras import look_at, pinhole
from spnr_jax.kernels.records import Camera, PointCloud
from spnr_jax.scoring import floors
from spnr_jax.scoring.floors import spacing, white

RADIUS = 0.12
splat, nearest = jax.jit(floors.splat), jax.jit(floors.nearest)


def make_cloud(positions, mask=None, **columns) -> PointCloud:
    made = surfel_clouds.cloud(positions, **columns)
    return jax.tree.map(jnp.asarray, made if mask is None else made.replace(mask=mask))


def random_cloud(seed: int, num_points: int = 60) -> PointCloud:
    """Points in a ball around the origin that reaches behind the camera of `skewed_camera`; a third is masked."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-1, 1, (num_points, 3)) * [1, 1, 2.5]
    color = rng.uniform(size=(num_points, 3))
    return make_cloud(positions, rng.uniform(size=num_points) < 0.67, base_color=color)


def skewed_camera() -> Camera:
    """Not square, focal lengths that differ, the principal point off the middle."""
    pose = look_at(jnp.array([0.4, 0.5, 2.0]), jnp.array([0.1, 0, 0]), jnp.array([0.0, 1, 0]))
    intrinsics = jnp.array([[26.0, 0, 13], [0, 31, 8], [0, 0, 1]])
    return Camera(cam_to_world=pose, intrinsics=intrinsics, height=18, width=23)


def encode(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def loop_rays(camera: Camera):
    """(row, column, eye, unit direction, plane coordinates) of every pixel, float64."""
    pose, k = np.asarray(camera.cam_to_world, np.float64), np.asarray(camera.intrinsics, np.float64)
    for row in range(camera.height):
        for column in range(camera.width):
            plane = np.array([(column + 0.5 - k[0, 2]) / k[0, 0], -(row + 0.5 - k[1, 2]) / k[1, 1]])
            direction = pose[:, :3] @ [*plane, -1]
            yield row, column, pose[:, 3], direction / np.linalg.norm(direction), plane


def loop_splat(cloud: PointCloud, camera: Camera, radius: float):
    """The disc's definition in camera coordinates: it lies in the plane z = depth of its point."""
    pose = np.asarray(camera.cam_to_world, np.float64)
    image, acc = np.ones((camera.height, camera.width, 3)), np.zeros((camera.height, camera.width))
    for row, column, eye, _, plane in loop_rays(camera):
        best = np.inf
        for position, color in zip(
            *(np.asarray(a)[cloud.mask] for a in (cloud.positions, cloud.base_color)), strict=True
        ):
            x, y, z = pose[:, :3].T @ (position - eye)
            if -z > 0 and np.hypot(*(plane * -z - [x, y])) <= radius and -z < best:
                best, acc[row, column], image[row, column] = -z, 1, encode(color)
    return image, acc


def loop_nearest(cloud: PointCloud, camera: Camera, radius: float):
    """Nearest-point shading to the letter: first find the intersection, then search the point nearest to it."""
    positions, colors = (np.asarray(a, np.float64)[cloud.mask] for a in (cloud.positions, cloud.base_color))
    image, acc = np.ones((camera.height, camera.width, 3)), np.zeros((camera.height, camera.width))
    for row, column, eye, direction, _ in loop_rays(camera):
        first = np.inf
        for offset in positions - eye:
            b = direction @ offset
            discriminant = b**2 - offset @ offset + radius**2
            if discriminant >= 0 and b + np.sqrt(discriminant) >= 0:
                first = min(first, max(b - np.sqrt(discriminant), 0))
        if np.isfinite(first):
            index = np.argmin(np.linalg.norm(positions - (eye + first * direction), axis=-1))
            acc[row, column], image[row, column] = 1, encode(colors[index])
    return image, acc


@pytest.mark.parametrize(("renderer", "twin"), [(splat, loop_splat), (nearest, loop_nearest)])
@pytest.mark.parametrize("seed", [0, 1])
def test_every_pixel_is_that_of_the_plain_loop(renderer, twin, seed):
    cloud, camera = random_cloud(seed), skewed_camera()
    image, acc = renderer(cloud, camera, RADIUS)
    expected_image, expected_acc = twin(cloud, camera, RADIUS)
    assert 0.1 < expected_acc.mean() < 0.95
    np.testing.assert_array_equal(acc, expected_acc)
    np.testing.assert_allclose(image, expected_image, atol=1e-5)


def test_an_eye_inside_balls_sees_only_the_nearest_of_their_points():
    cloud, camera = random_cloud(2), skewed_camera()
    eye = np.asarray(camera.cam_to_world[:, 3])
    inside = np.concatenate([[eye + [0.3, 0, 0], eye + [0, 0.1, 0.1], eye + [0, 0, -0.4]], cloud.positions[3:]])
    cloud = make_cloud(inside, base_color=cloud.base_color)
    image, acc = nearest(cloud, camera, 0.5)
    np.testing.assert_array_equal(acc, 1)
    np.testing.assert_allclose(image, loop_nearest(cloud, camera, 0.5)[0], atol=1e-5)


@pytest.mark.parametrize("renderer", [splat, nearest])
def test_the_order_of_points_and_padding_do_not_matter(renderer):
    cloud, camera = random_cloud(3), skewed_camera()
    order = np.random.default_rng(4).permutation(60)
    shuffled = jax.tree.map(lambda a: a[order], cloud)
    padded = jax.tree.map(lambda a: jnp.concatenate([a, jnp.zeros((7, *a.shape[1:]), a.dtype)]), cloud)
    for same in (shuffled, padded):
        np.testing.assert_array_equal(renderer(same, camera, RADIUS)[0], renderer(cloud, camera, RADIUS)[0])


@pytest.mark.parametrize("renderer", [splat, nearest])
def test_of_no_points_and_of_what_lies_behind_the_eye_nothing_is_seen(renderer):
    camera = pinhole(look_at(jnp.array([0, 0, 4.0]), jnp.zeros(3), jnp.array([0.0, 1, 0])), 0.6, 32, 32)
    behind = make_cloud([[0, 0, 6.0], [0.1, 0, 5.0]])
    for cloud, radius in ((make_cloud(np.zeros((2, 3)), mask=np.zeros(2, bool)), 1.0), (behind, 0.3)):
        image, acc = renderer(cloud, camera, radius)
        np.testing.assert_array_equal(image, white(camera))
        np.testing.assert_array_equal(acc, 0)


def test_blocks_of_rays_give_the_image_of_all_rays_at_once(monkeypatch):
    cloud, camera = random_cloud(7), skewed_camera()
    whole = splat(cloud, camera, RADIUS)[0]
    monkeypatch.setattr("spnr_jax.scoring.floors.BLOCK", 60 * 5)  # 414 rays: 82 blocks of 5 and a remainder
    np.testing.assert_allclose(floors.splat(cloud, camera, RADIUS)[0], whole, atol=1e-6)


def test_spacing_is_the_median_distance_to_the_nearest_other_real_point():
    cloud = random_cloud(8)
    real = np.asarray(cloud.positions, np.float64)[cloud.mask]
    distances = [min(np.linalg.norm(p - q) for j, q in enumerate(real) if j != i) for i, p in enumerate(real)]
    np.testing.assert_allclose(spacing(cloud), np.median(distances), rtol=1e-5)
    for real in (0, 1):
        assert spacing(make_cloud(np.zeros((4, 3)), mask=np.arange(4) < real)) == 0
