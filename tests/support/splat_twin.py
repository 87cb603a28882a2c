"""A picture of Gaussian splats by plain loops in float64, from the formulas of the glTF extension and nothing else."""

import numpy as np

from spnr_jax.surfels.gaussians import degree_of, evaluate_harmonics

DILATION = 0.1  # square pixels, as the page of `spnr share` has it


def draw(splats, camera, dilation=DILATION):
    """Picture on white and opacity: every splat at every pixel, sorted by depth."""
    pose, k = np.asarray(camera.cam_to_world, np.float64), np.asarray(camera.intrinsics, np.float64)
    image, left = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    to_camera = np.array([pose[:, 0], -pose[:, 1], -pose[:, 2]])  # right, down, forward
    local = (np.asarray(splats.position, np.float64) - pose[:, 3]) @ to_camera.T
    for i in np.argsort(local[:, 2], kind="stable"):
        x, y, z = local[i]
        if z <= 0:
            continue
        covariance = _covariance(splats.rotation[i], splats.scale[i])
        jacobian = np.array([[k[0, 0] / z, 0, -k[0, 0] * x / z**2], [0, k[1, 1] / z, -k[1, 1] * y / z**2]])
        sharp = jacobian @ to_camera @ covariance @ to_camera.T @ jacobian.T
        flat = sharp + dilation * np.eye(2)
        share = np.sqrt(max(np.linalg.det(sharp) / np.linalg.det(flat), 1e-4))
        inverse = np.linalg.inv(flat)
        dx, dy = columns[None] - (k[0, 0] * x / z + k[0, 2]), rows[:, None] - (k[1, 1] * y / z + k[1, 2])
        distance = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
        alpha = np.minimum(share * splats.opacity[i] * np.exp(-0.5 * distance), 0.99)
        alpha = np.where(alpha < 1 / 255, 0, alpha)
        image += (left * alpha)[..., None] * color(splats, i, pose[:, 3])
        left = left * (1 - alpha)
    return image + left[..., None], 1 - left


def color(splats, number, eye):
    """sRGB of one splat as seen from a place."""
    towards = np.asarray(splats.position[number], np.float64) - eye
    harmonics = np.asarray(splats.harmonics[number], np.float64)
    return np.maximum(
        0.5 + evaluate_harmonics(towards / np.linalg.norm(towards), degree_of(len(harmonics))) @ harmonics, 0
    )


def _covariance(quaternion, scale):
    w, *vector = np.asarray(quaternion, np.float64)
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    return turn @ np.diag(np.asarray(scale, np.float64) ** 2) @ turn.T
