"""Plain-loop float64 twins of the kernels, for one ray or one volume: slow, and simple enough to be checked by eye."""

import itertools
import math

import numpy as np


def camera_ray(cam_to_world, focal, centre, row, column):
    """Unit direction through a pixel centre; OpenGL axes, row 0 at the top."""
    right, down = (np.array([column, row]) + 0.5 - centre) / focal
    local = np.array([right, -down, -1.0])
    direction = np.asarray(cam_to_world, np.float64)[:, :3] @ local
    return direction / math.sqrt(direction @ direction)


def box_interval(origin, direction):
    """(near, far) of the part of the ray at positive distance inside [-1, 1]^3, None where it misses."""
    near, far = 0.0, math.inf
    for o, d in zip(np.float64(origin), np.float64(direction), strict=True):
        if d == 0:
            if abs(o) > 1:
                return None
            continue
        first, second = sorted(((-1 - o) / d, (1 - o) / d))
        near, far = max(near, first), min(far, second)
    return (near, far) if far > near else None


def volume_weights(density, delta):
    """(weights, residual transmittance): what is left of one unit of light after each interval in turn."""
    light, weights = 1.0, []
    for tau in np.float64(density) * np.float64(delta):
        passed = light * math.exp(-tau)
        weights.append(light * -math.expm1(-tau))
        light = passed
    return np.array(weights), light


def composite(weights, values, background):
    """Sum of what each interval sends, and the background through the rest."""
    total = np.zeros(np.shape(values)[-1])
    for weight, value in zip(np.float64(weights), np.float64(values), strict=True):
        total += weight * value
    return total + (1 - np.float64(weights).sum()) * np.float64(background)


def voxel_of(position, resolution):
    """(z, y, x) of the voxel that holds the position, None outside the box."""
    if any(abs(p) > 1 for p in position):
        return None
    return tuple(min(int(math.floor((p + 1) * 0.5 * resolution)), resolution - 1) for p in np.float64(position)[::-1])


def scatter_mean(positions, features, mask, resolution):
    """(mean of the features in each voxel, occupancy), a list of points per voxel."""
    inside = {}
    for position, feature, valid in zip(positions, np.float64(features), mask, strict=True):
        voxel = voxel_of(position, resolution)
        if valid and voxel is not None:
            inside.setdefault(voxel, []).append(feature)
    volume = np.zeros((*[resolution] * 3, features.shape[-1]))
    occupancy = np.zeros([resolution] * 3)
    for voxel, members in inside.items():
        volume[voxel] = np.mean(members, axis=0)
        occupancy[voxel] = 1
    return volume, occupancy


def trilinear_taps(position, resolution):
    """[(voxel, weight)] of the eight centres around a position; empty outside the box."""
    if any(abs(p) > 1 for p in position):
        return []
    axes = []
    for p in np.float64(position)[::-1]:
        g = min(max((p + 1) * 0.5 * resolution - 0.5, 0.0), resolution - 1.0)
        low = min(int(math.floor(g)), max(resolution - 2, 0))
        axes.append([(low, 1 - (g - low)), (min(low + 1, resolution - 1), g - low)])
    return [(tuple(i for i, _ in corner), math.prod(w for _, w in corner)) for corner in itertools.product(*axes)]


def trilinear(volume, position):
    """Weighted mean of the eight nearest voxel centres."""
    volume = np.float64(volume)
    return sum((w * volume[voxel] for voxel, w in trilinear_taps(position, len(volume))), np.zeros(volume.shape[-1]))


def bilinear(x, height, width):
    """One image resized with half-pixel centres, clamped at the border."""
    out = np.zeros((height, width, x.shape[-1]))
    for place in np.ndindex(height, width):
        axes = []
        for i, new, old in zip(place, (height, width), x.shape[:2], strict=True):
            g = min(max((i + 0.5) * old / new - 0.5, 0.0), old - 1.0)
            axes.append([(int(g), 1 - g % 1), (min(int(g) + 1, old - 1), g % 1)])
        for (i, a), (j, b) in itertools.product(*axes):
            out[place] += a * b * np.float64(x[i, j])
    return out


def area_downsample(image, size):
    """Mean of one image over size x size equal cells, each pixel weighted by its overlap with the cell."""
    image = np.float64(image)
    height, width = image.shape[0] / size, image.shape[1] / size
    out = np.zeros((size, size, image.shape[-1]))
    for (i, j), (y, x) in itertools.product(np.ndindex(size, size), np.ndindex(*image.shape[:2])):
        rows = min((i + 1) * height, y + 1) - max(i * height, y)
        columns = min((j + 1) * width, x + 1) - max(j * width, x)
        if rows > 0 and columns > 0:
            out[i, j] += rows * columns / (height * width) * image[y, x]
    return out


def group_norm(x, groups):
    """One array (*space, features), each group of consecutive channels to zero mean and unit variance."""
    x, width = np.float64(x), x.shape[-1] // groups
    out = np.empty_like(x)
    for g in range(groups):
        part = x[..., g * width : (g + 1) * width]
        out[..., g * width : (g + 1) * width] = (part - part.mean()) / math.sqrt(part.var() + 1e-5)
    return out


def softplus(x):
    """log(1 + exp(x)) without overflow."""
    return np.maximum(x, 0) + np.log1p(np.exp(-np.abs(np.float64(x))))


def batch_norm(x):
    """(normalised rows, mean, variance) of real points (n, features); a mean of 0 and no variance without points."""
    x = np.float64(x)
    mean, variance = (x.mean(axis=0), x.var(axis=0)) if len(x) else (np.zeros(x.shape[1]), np.zeros(x.shape[1]))
    return (x - mean) / np.sqrt(variance + 1e-5), mean, variance


def shares(tau, narrow, depth, spacing, near):
    """Twin of blending.compute_blend_weights: blend and color weights of lists (entries, slots), transmittances.

    Entries less than a spacing apart in depth blend; those more than `near` places before another hide it.
    """
    tau, narrow, depth, spacing = map(np.float64, (tau, narrow, depth, spacing))
    share, colored, left = (np.zeros_like(tau) for _ in range(3))
    for i in range(len(tau)):
        band, narrow_band, hidden = tau[i].copy(), narrow[i].copy(), np.zeros_like(tau[i])
        for j in range(len(tau)):
            x = np.clip(np.abs(depth[i] - depth[j]) / (0.5 * (spacing[i] + spacing[j])) - 1, 0, 1)
            apart = x * x * (3 - 2 * x) if abs(i - j) <= near else 1.0
            band += tau[j] * (1 - apart) if i != j else 0
            narrow_band += narrow[j] * (1 - apart) if i != j else 0
            hidden += tau[j] * apart if j < i else 0
        left[i] = np.exp(-hidden)
        share[i] = tau[i] * left[i] * np.where(band > 0, -np.expm1(-band) / np.where(band > 0, band, 1), 1)
        colored[i] = narrow[i] / np.maximum(narrow_band, 1e-34) * left[i] * -np.expm1(-band)
    return share, colored, left
