"""Parts that several families share, legs, bases and wheels, and how pieces become an object.

A piece is (finish, mesh) in metres or any other unit; families of objects return lists of them.  Meshes that share a
finish become one part, and the object stands on y = 0.  A leg style is drawn once per object and gives a function
(foot, top) -> Mesh, so that all legs of an object match.
"""

from collections.abc import Callable

import numpy as np

from data_gen.shapes.finishes import Finish
from data_gen.shapes.primitives import (
    Mesh,
    box,
    circle,
    curve,
    cylinder,
    lathe,
    loft,
    merge,
    move,
    rounded_rectangle,
    superellipse,
    superellipsoid,
    tube,
    turn,
)
from spnr_jax.formats.assets import Asset, Part

Piece = tuple[Finish, Mesh]
DECIMALS = 6  # of positions and normals: hides the last bit, in which the sines of two processors may differ


def assemble(pieces: list[Piece], category: str, source: dict) -> Asset:
    """Asset with one part per finish, in order of first use, its lowest point at y = 0."""
    floor = min(mesh.positions[:, 1].min() for _, mesh in pieces)
    finishes = list({id(finish): finish for finish, _ in pieces}.values())
    parts = []
    for finish in finishes:
        mesh = merge([mesh for other, mesh in pieces if other is finish])
        parts.append(
            Part(
                positions=(mesh.positions - (0, floor, 0)).round(DECIMALS),
                faces=mesh.faces,
                material=finish.material,
                normals=mesh.normals.round(DECIMALS),
                texcoords=(mesh.texcoords / finish.tile).round(DECIMALS),
            )
        )
    return Asset(parts=tuple(parts), category=category, source=source)


def wheel(rng, radius: float, width: float) -> tuple[Mesh, Mesh]:
    """(tyre, rim) about 0, the outside of the rim towards +x."""
    inner = radius * rng.uniform(0.55, 0.75)
    half, round_ = width / 2, width * rng.uniform(0.15, 0.3)
    edge = round_ * 0.3
    section = [(inner, -half), (radius - round_, -half), (radius - edge, -half + edge), (radius, -half + round_)]
    section += [(radius, half - round_), (radius - edge, half - edge), (radius - round_, half), (inner, half)]
    section += [(inner * 0.97, half * 0.5), (inner * 0.97, -half * 0.5)]
    tyre = lathe(section, 24, closed=True)
    dish = half * rng.uniform(0.1, 0.7)
    profile = [(inner, -half * 0.4), (inner, half * 0.95), (inner * 0.92, half), (inner * 0.88, dish)]
    lip = lathe([*profile, (inner * 0.85, -half * 0.4)], 24, closed=True)
    hub = move(cylinder(inner * rng.uniform(0.2, 0.35), half * 0.5 + dish, 12, half * 0.1), y=-half * 0.3)
    style = rng.choice(["spokes", "disc", "dish"])
    parts = [lip, hub]
    if style == "spokes":
        count = int(rng.integers(3, 9))
        thick = rng.uniform(0.1, 0.3) * inner
        spoke = move(box((inner * 0.75, half * 0.4, thick), 0.002), x=inner * 0.53, y=dish * 0.8)
        parts += [turn(spoke, "y", 360 / count * i) for i in range(count)]
        parts.append(move(cylinder(inner * 0.9, half * 0.1, 20), y=-half * 0.3))
    elif style == "disc":
        parts.append(move(cylinder(inner * 0.92, dish + half * 0.3, 20, half * 0.08), y=-half * 0.3))
    else:
        at = np.linspace(1, 0, 6)
        parts.append(lathe([(inner * 0.9, -half * 0.3), *zip(inner * 0.9 * at, dish * (1 - at**2), strict=True)], 20))
    return turn(tyre, "z", -90), turn(merge(parts), "z", -90)


Leg = Callable[[np.ndarray, np.ndarray], Mesh]


def post(path, radius, section) -> Mesh:
    """Upright solid with level sections (k, 2), scaled by radius (n,), centred on path (n, 3) from foot to top."""
    path, section = np.asarray(path, float), np.asarray(section, float)
    flat = np.stack([section[:, 0], np.zeros(len(section)), -section[:, 1]], axis=-1)
    return loft(path[:, None] + np.broadcast_to(radius, len(path))[:, None, None] * flat)


def line(first, last, at) -> np.ndarray:
    """(n, 3) points between two, at fractions (n,)."""
    return np.asarray(first) + np.asarray(at)[:, None] * (np.asarray(last) - np.asarray(first))


def turned_profile(rng, samples=18) -> tuple[np.ndarray, np.ndarray]:
    """(height fractions, radii of at most 1) of a turned post: a slow curve with beads and coves cut into it."""
    at = np.linspace(0, 1, samples)
    controls = np.stack([np.linspace(0, 1, 6), rng.uniform(0.4, 1.0, 6)], axis=1)
    radius = curve(controls, samples)[:, 1]
    beads = rng.random(samples) < rng.uniform(0.05, 0.35)
    radius = np.clip(np.where(beads, radius * rng.uniform(0.55, 1.4, samples), radius), 0.3, 1.0)
    radius[-2:] = 1.0
    return at, radius


def leg_style(rng, radius: float) -> Leg:
    """A leg of about a radius at its top: square, tapered, turned, round, flat, bowed or bent."""
    style = rng.choice(["square", "tapered", "turned", "round", "flat", "cabriole", "bowed"])
    taper = rng.uniform(0.35, 0.9)
    square = rounded_rectangle(2, 2, rng.uniform(0.0, 0.6), 2)
    if style == "square":
        return lambda foot, top: post(line(foot, top, [0, 1]), radius * 0.9, square)
    if style == "tapered":
        section = square if rng.random() < 0.5 else circle(12)
        return lambda foot, top: post(line(foot, top, [0, 1]), radius * np.array([taper, 1.0]), section)
    if style == "turned":
        at, profile = turned_profile(rng)
        return lambda foot, top: post(line(foot, top, at), radius * profile, circle(14))
    if style == "round":
        return lambda foot, top: post(line(foot, top, [0, 0.02, 1]), radius * np.array([0.55, 0.6, 0.6]), circle(12))
    if style == "flat":
        blade = rounded_rectangle(2, rng.uniform(0.5, 1.2), 0.2, 2)
        return lambda foot, top: post(line(foot, top, [0, 1]), radius * np.array([taper, 1.1]), blade)
    swing = rng.uniform(0.6, 1.5) * radius

    def bent(foot, top):
        outward = np.asarray(foot - top) * (1, 0, 1) + 1e-9
        if np.abs(outward).max() < 1e-6:  # a straight leg bends away from the middle of the object
            outward = np.asarray(top) * (1, 0, 1) + 1e-9
        outward /= np.linalg.norm(outward)
        at = np.linspace(0, 1, 9)
        wave = np.sin(2 * np.pi * (at - 0.05)) * -1 if style == "cabriole" else np.sin(np.pi * at)
        thick = 0.5 + 0.5 * at**2 + 0.25 * (at < 0.1) if style == "cabriole" else taper + (1 - taper) * at
        return post(line(foot, top, at) + swing * (wave * at * (1.2 - at))[:, None] * outward, radius * thick, square)

    return bent


def four_legs(leg: Leg, width: float, depth: float, height: float, splay=0.0) -> Mesh:
    """Four legs under a rectangle of (width, depth) up to a height; feet `splay` further out."""
    corners = rounded_rectangle(width, depth)
    out = np.sign(corners) * splay
    return merge(
        leg(np.array([x + a, 0, z + b]), np.array([x, height, z])) for (x, z), (a, b) in zip(corners, out, strict=True)
    )


def round_legs(leg: Leg, count: int, radius: float, height: float, splay=0.0, start=90.0) -> Mesh:
    """Legs on a circle up to a height, the first at `start` degrees from +x."""
    angles = np.radians(start + 360 / count * np.arange(count))
    out = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=-1)
    return merge(leg(o * (radius + splay), o * radius + (0, height, 0)) for o in out)


def stretchers(width: float, depth: float, y: float, radius: float, style: str) -> Mesh:
    """Rails between four legs at a height: a "ring" of four, an "h", or a "cross"."""
    x, z = width / 2, depth / 2
    if style == "ring":
        ends = [((-x, z), (x, z)), ((-x, -z), (x, -z)), ((-x, -z), (-x, z)), ((x, -z), (x, z))]
    elif style == "h":
        ends = [((-x, -z), (-x, z)), ((x, -z), (x, z)), ((-x, 0), (x, 0))]
    else:
        ends = [((-x, -z), (x, z)), ((-x, z), (x, -z))]
    return merge(tube([(a, y, b), (c, y, d)], radius, segments=8) for (a, b), (c, d) in ends)


def pedestal(rng, height: float, radius: float, foot: float) -> Mesh:
    """One column: a turned or plain post on a disc, dome or cross of a `foot` radius."""
    style = rng.choice(["disc", "dome", "cross", "trumpet"])
    if style == "trumpet":
        at = np.linspace(0, 1, 14)
        profile = radius + (foot - radius) * np.exp(-rng.uniform(6, 16) * at)
        return lathe(np.column_stack([profile, at * height]), 28)
    rise = {"disc": 0.03, "dome": 0.09, "cross": 0.06}[style]
    at, scale = turned_profile(rng) if rng.random() < 0.5 else (np.array([0.0, 1.0]), np.ones(2))
    column = lathe(np.column_stack([radius * scale, rise * 0.5 + at * (height - rise * 0.5)]), 18)
    if style == "disc":
        return merge([column, cylinder(foot, rise, 32, rise * rng.uniform(0.1, 0.45))])
    if style == "dome":
        angle = np.linspace(0, np.pi / 2, 7)
        return merge([column, lathe(np.column_stack([foot * np.cos(angle), rise * np.sin(angle)]), 28)])
    arm = rng.uniform(0.03, 0.06)
    arms = [turn(loft_arm(foot, rise + 0.02, arm), "y", 90 * i + 45 * (rng.random() < 0.5)) for i in range(4)]
    return merge([column, *arms])


def loft_arm(length: float, height: float, width: float) -> Mesh:
    """Arm along +x from the axis, high inside, low at the tip."""
    at = np.linspace(0, 1, 6)
    tall = np.maximum(height * (1 - at**2 * 0.8), 0.012)
    rings = []
    for x, high in zip(at * length, tall, strict=True):
        outline = superellipse(12, 0.4, (width / 2, high / 2))
        rings.append(np.column_stack([np.full(12, x), outline[:, 1] + high / 2, -outline[:, 0]]))
    return loft(rings)


def star_base(rng, height: float, reach: float) -> tuple[Mesh, Mesh]:
    """(arms and column, castors or glides) of a swivel chair, from the floor to a height."""
    count = int(rng.integers(4, 6))
    wheel = rng.uniform(0.02, 0.035)
    rise = 2 * wheel
    arms, feet = [], []
    for i in range(count):
        arm = move(loft_arm(reach, rng.uniform(0.05, 0.051) + 0.02, 0.045), y=rise - 0.008)
        arms.append(turn(arm, "y", 360 / count * i))
        ball = move(superellipsoid((2 * wheel, 2 * wheel, 0.03), 1, 1, 8, 12), x=0, y=wheel)
        castor = merge([ball, move(box((0.02, wheel + 0.01, 0.02)), y=1.5 * wheel)])
        feet.append(turn(move(castor, x=reach - 0.02), "y", 360 / count * i))
    low, middle = rise, (rise + height) / 2
    width = rng.uniform(0.022, 0.04)
    profile = [(0.05, low - 0.005), (0.05, low + 0.06), (width, low + 0.08), (width, middle)]
    profile += [(0.6 * width, middle + 0.01), (0.6 * width, height - 0.04), (0.08, height - 0.03), (0.08, height)]
    column = lathe(profile, 16)
    return merge([*arms, column]), merge(feet)
