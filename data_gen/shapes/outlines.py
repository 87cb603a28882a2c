"""Lines to build from: closed outlines in the plane, and smooth curves through control points.

Outlines are (k, 2), counter-clockwise, without the first point repeated.
"""

import numpy as np


def circle(segments: int, radius=1.0) -> np.ndarray:
    """(segments, 2) points on a circle."""
    angle = 2 * np.pi * np.arange(segments) / segments
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def superellipse(segments: int, exponent: float, half=(1.0, 1.0)) -> np.ndarray:
    """(segments, 2) points with |x/a|^(2/e) + |y/b|^(2/e) = 1: e = 1 an ellipse, e < 1 squarer, e = 2 a diamond."""
    unit = np.round(circle(segments), 12)  # cos(90 degrees) is not quite 0, and small powers would show it
    return np.sign(unit) * np.abs(unit) ** exponent * np.asarray(half)


def rounded_rectangle(width: float, height: float, radius=0.0, steps=3) -> np.ndarray:
    """(4 steps + 4, 2) points of a rectangle about 0 with rounded corners; 4 points if radius is 0."""
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)], float)
    if radius <= 0:
        return corners * (width / 2, height / 2)
    angle = np.radians(90 * np.arange(4)[:, None] + np.linspace(0, 90, steps + 1))
    arcs = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return (corners[:, None] * (width / 2 - radius, height / 2 - radius) + arcs).reshape(-1, 2)


def curve(points, samples=16) -> np.ndarray:
    """(samples, 3 or 2) points of a Catmull-Rom curve through control points, ends included."""
    points = np.asarray(points, float)
    padded = np.concatenate([[2 * points[0] - points[1]], points, [2 * points[-1] - points[-2]]])
    place = np.linspace(0, len(points) - 1, samples)
    i = np.minimum(place.astype(int), len(points) - 2)
    t = (place - i)[:, None]
    a, b, c, d = padded[i], padded[i + 1], padded[i + 2], padded[i + 3]
    return 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)


def bent_line(points, radius: float, steps=6) -> np.ndarray:
    """(k, 3) straight runs through points (n, 3), each inner corner rounded over `radius` before and after it."""
    points = np.asarray(points, float)
    path, t = [points[:1]], np.linspace(0, 1, steps + 1)[:, None]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        back, ahead = before - corner, after - corner
        back, ahead = (arm * min(radius / np.linalg.norm(arm), 0.49) for arm in (back, ahead))
        path.append(corner + back * (1 - t) ** 2 + ahead * t**2)
    return np.concatenate([*path, points[-1:]])


def airfoil(segments: int, thickness: float) -> np.ndarray:
    """(2 segments, 2) outline of a symmetric NACA wing section of chord 1, nose at (0, 0), tail at (1, 0)."""
    x = 0.5 * (1 - np.cos(np.linspace(0, np.pi, segments + 1)))
    half = 5 * thickness * (0.2969 * np.sqrt(x) - 0.126 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1036 * x**4)
    lower, upper = np.column_stack([x, -half])[:-1], np.column_stack([x, half])[:0:-1]
    return np.concatenate([lower, upper])
