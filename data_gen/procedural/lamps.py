"""Lamps: table, floor, tripod, arc, desk, paper and mushroom lamps, lanterns; shades of every profile. Metres."""

import numpy as np

from data_gen.procedural.parts import Piece, four_legs, leg_style, line, pedestal, post, turned_profile
from data_gen.shapes import finishes
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
    superellipse,
    superellipsoid,
    tube,
    turn,
)


def shade_finish(rng) -> finishes.Finish:
    """A finish that shades have."""
    return finishes.choose(rng, finishes.glow, finishes.glow, finishes.fabric, finishes.metal, finishes.paint)


def shade(rng, radius: float, height: float) -> tuple[Mesh, Mesh]:
    """(open shade, spokes to the axis) from y = 0 to height: cone, drum, dome, bell, empire, square or pleated."""
    style = rng.choice(["cone", "drum", "dome", "bell", "square", "pleated"])
    at, wall = np.linspace(0, 1, 9), 0.004
    top = {"cone": rng.uniform(0.3, 0.7), "drum": rng.uniform(0.9, 1.0)}.get(style, rng.uniform(0.35, 0.7))
    outline = 1 + (top - 1) * at
    if style == "dome":
        outline = np.maximum(np.sqrt(1 - (at * 0.985) ** 2), 0.12)
    if style == "bell":
        outline = top + (1 - top) * (1 - at) ** rng.uniform(1.6, 3.0)
    outside = np.column_stack([radius * outline, at * height])
    profile = np.concatenate([outside, (outside - (wall, 0))[::-1]])
    around = circle(32)
    if style == "square":
        around = superellipse(32, 0.12) * 0.85
    if style == "pleated":
        around = circle(96) * (1 + 0.02 * np.cos(np.arange(96) * np.pi))[:, None]
    radii, y = profile[:, :1], profile[:, 1:]
    rings = np.stack(np.broadcast_arrays(radii * around[:, 0], y, -radii * around[:, 1]), -1)
    reach = 0.98 * radius * outline[-2]
    level = height * at[-2]
    ends = ((-reach, level, 0), (reach, level, 0)), ((0, level, -reach), (0, level, reach))
    spokes = [tube(pair, 0.003, segments=6) for pair in ends]
    return loft(rings, closed=True), merge(spokes)


def stem(rng, height: float, radius: float) -> Mesh:
    """A lamp's body from y = 0 to height: vase, gourd, stack of balls, turned post, column or block."""
    thick = 0.01  # of the rod
    style = rng.choice(["vase", "stack", "turned", "column", "block", "twist"])
    neck = rng.uniform(0.8, 0.95)
    if style in ("vase", "turned"):
        widths = rng.uniform(0.25, 1.0, int(rng.integers(4, 8)))
        body = np.clip(curve(np.column_stack([widths, widths]), 26)[:, 0], 0.15, 1.1)
        if style == "turned":
            body = turned_profile(rng, 26)[1] * rng.uniform(0.4, 0.9)
        profile = np.column_stack([radius * body, np.linspace(0, height * neck, 26)])
        top = move(cylinder(thick, height * (1 - neck) + 0.01, 10), y=height * neck - 0.01)
        return merge([lathe(profile, 28), top])
    if style == "stack":
        count, balls, y = int(rng.integers(2, 5)), [], 0.0
        size = height * neck / count
        for _ in range(count):
            wide = min(2 * radius, size * 1.6) * rng.uniform(0.7, 1.0)
            exponent = rng.choice([0.3, 1.0])
            balls.append(move(superellipsoid((wide, size * 1.06, wide), exponent, 1.0, 12), y=y + size / 2))
            y += size
        return merge([*balls, cylinder(thick, height, 10)])
    if style == "column":
        return merge([cylinder(radius * rng.uniform(0.25, 0.9), height * neck, 28, 0.006), cylinder(thick, height, 10)])
    section = superellipse(24, rng.uniform(0.1, 0.5), (radius * 0.8, radius * rng.uniform(0.4, 0.8)))
    if style == "block":
        scale = np.array([1.0, rng.uniform(0.5, 1.2)])
        block = post(line((0, 0, 0), (0, height * neck, 0), [0, 1]), scale, section)
        return merge([block, cylinder(thick, height, 10)])
    rings = []
    for at in np.linspace(0, 1, 16):
        angle = at * rng.uniform(2.4, 2.401)
        spin = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        x, z = ((section * (1 - 0.4 * at)) @ spin).T
        rings.append(np.column_stack([x, np.full(24, at * height * neck), -z]))
    return merge([loft(rings), cylinder(thick, height, 10)])


def bulb(radius) -> Mesh:
    """A bulb about 0 with its screw below."""
    ball = superellipsoid((2 * radius, 2.3 * radius, 2 * radius), 1, 1, 8, 12)
    return merge([ball, move(cylinder(radius * 0.5, radius, 10), y=-1.8 * radius)])


def table_lamp(rng) -> list[Piece]:
    """A body on a foot, under a shade."""
    body = finishes.choose(rng, finishes.wood, finishes.metal, finishes.stone, finishes.paint, finishes.print_)
    metal, cover = finishes.choose(rng, finishes.metal), shade_finish(rng)
    height, radius = rng.uniform(0.2, 0.42), rng.uniform(0.05, 0.11)
    wide, tall = rng.uniform(0.12, 0.22), rng.uniform(0.14, 0.28)
    screen, spokes = shade(rng, wide, tall)
    low = height - tall * rng.uniform(0.15, 0.5)
    link = tube([(0, height - 0.01, 0), (0, low + tall * 0.9, 0)], 0.005, segments=8)
    pieces = [
        (body, stem(rng, height, radius)),
        (metal, merge([move(spokes, y=low), link])),
        (cover, move(screen, y=low)),
    ]
    if rng.random() < 0.7:
        foot = cylinder(radius * rng.uniform(0.9, 1.5), rng.uniform(0.015, 0.035), 28, 0.005)
        pieces.append((metal if rng.random() < 0.5 else body, foot))
    return pieces


def floor_lamp(rng) -> list[Piece]:
    """A tall pole on a foot, under a shade, or a bowl that shines upward."""
    metal, cover = finishes.choose(rng, finishes.metal, finishes.wood, finishes.paint), shade_finish(rng)
    height, wide, tall = rng.uniform(1.2, 1.7), rng.uniform(0.16, 0.32), rng.uniform(0.16, 0.36)
    pole = pedestal(rng, height, rng.uniform(0.01, 0.025), rng.uniform(0.13, 0.2))
    screen, spokes = shade(rng, wide, tall)
    if rng.random() < 0.2:
        bowl = move(turn(screen, "x", 180), y=height + tall)
        return [(metal, merge([pole, move(turn(spokes, "x", 180), y=height + tall)])), (cover, bowl)]
    low = height - tall * 0.8
    return [(metal, merge([pole, move(spokes, y=low)])), (cover, move(screen, y=low))]


def tripod_lamp(rng) -> list[Piece]:
    """Three or four legs that meet under a shade."""
    wood, cover = finishes.choose(rng, finishes.wood, finishes.metal, finishes.paint), shade_finish(rng)
    metal = finishes.choose(rng, finishes.metal)
    height, reach = rng.uniform(0.4, 1.4), rng.uniform(0.2, 0.3)
    reach *= 0.4 + 0.6 * height
    wide, tall, count = rng.uniform(0.15, 0.28), rng.uniform(0.16, 0.3), int(rng.integers(3, 5))
    radius = rng.uniform(0.01, 0.02)
    leg = tube([(reach, 0, 0), (0.02, height, 0)], [radius * 0.7, radius], segments=10)
    legs = [turn(leg, "y", 360 / count * i + 90) for i in range(count)]
    hub = move(cylinder(0.04, 0.05, 16, 0.008), y=height - 0.02)
    screen, spokes = shade(rng, wide, tall)
    link = tube([(0, height, 0), (0, height + 0.05 + tall * 0.9, 0)], 0.007, segments=8)
    top = height + 0.05
    return [(wood, merge(legs)), (metal, merge([hub, link, move(spokes, y=top)])), (cover, move(screen, y=top))]


def arc_lamp(rng) -> list[Piece]:
    """A pole that bends over and lets a shade hang."""
    metal, cover = finishes.choose(rng, finishes.metal, finishes.paint), shade_finish(rng)
    height, reach = rng.uniform(1.2, 1.8), rng.uniform(0.4, 0.9)
    drop = height * rng.uniform(0.68, 0.9)
    points = [(0, 0.02, 0), (0, height * 0.55, 0), (reach * 0.25, height * 0.93, 0), (reach * 0.65, height, 0)]
    path = curve([*points, (reach, drop, 0)], 26)
    block = box((0.3, 0.05, 0.24), 0.01, 3) if rng.random() < 0.5 else move(cylinder(0.16, 0.05, 28, 0.01), y=-0.025)
    screen, spokes = shade(rng, rng.uniform(0.12, 0.22), rng.uniform(0.1, 0.2))
    foot = finishes.choose(rng, finishes.stone, finishes.metal)
    hang = (reach, drop - screen.positions[:, 1].max(), 0)
    pieces = [
        (metal, merge([tube(path, rng.uniform(0.008, 0.016)), move(spokes, *hang)])),
        (cover, move(screen, *hang)),
        (foot, move(block, y=0.025)),
    ]
    heading = rng.choice([0, -40, -90])
    return [(finish, turn(mesh, "y", heading)) for finish, mesh in pieces]


def desk_lamp(rng) -> list[Piece]:
    """A jointed or curved arm from a heavy foot to a tilted head."""
    body = finishes.choose(rng, finishes.paint, finishes.plastic, finishes.metal)
    metal = finishes.choose(rng, finishes.metal)
    first, second = rng.uniform(0.18, 0.32), rng.uniform(0.15, 0.28)
    elbow = np.array([0, 0.03 + first * 0.95, -first * rng.uniform(0.1, 0.5)])
    wrist = elbow + (0, second * rng.uniform(0.2, 0.7), second * rng.uniform(0.6, 1.0))
    radius = rng.uniform(0.007, 0.013)
    if rng.random() < 0.35:
        arm = tube(curve([(0, 0.02, 0), elbow * (1, 0.8, 1), elbow + (0, 0.06, 0.05), wrist], 24), radius)
    else:
        pairs = [((0, 0.02, 0), elbow), (elbow, wrist)]
        twin = 0.018 * (rng.random() < 0.4)
        arm = merge(
            tube(np.array(pair) + (s * twin, 0, 0), radius * (0.6 if twin else 1))
            for pair in pairs
            for s in ((1, -1) if twin else (1,))
        )
        ball = superellipsoid((0.05, 0.035, 0.035), 1, 1, 8, 12)
        arm = merge([arm, move(ball, *elbow), move(ball, *wrist)])
    wide, tall = rng.uniform(0.05, 0.1), rng.uniform(0.08, 0.15)
    at = np.linspace(0, 1, 8)
    outline = wide * np.where(rng.random() < 0.5, np.sqrt(1 - (0.96 * at) ** 2), 1 - 0.7 * at)
    outside = np.column_stack([outline, at * tall])
    head = lathe(np.concatenate([outside, (outside - (0.003, 0.003))[::-1]]), 28, closed=True)
    head = merge([head, move(cylinder(outline[-1] * 1.05, 0.03, 16, 0.004), y=tall - 0.015)])
    tilt = rng.uniform(-50, 10)
    head = turn(move(head, y=-tall - 0.005), "x", tilt)
    lit = merge([bulb(min(wide * 0.45, 0.03)), tube([(0, 0, 0), (0, tall * 0.6, 0)], 0.008, segments=8)])
    glow = turn(move(lit, y=-tall * 0.65), "x", tilt)
    foot = cylinder(rng.uniform(0.07, 0.11), 0.03, 28, 0.008)
    if rng.random() < 0.3:
        foot = move(box((0.16, 0.03, 0.13), 0.01, 3), y=0.015)
    return [(metal, arm), (body, move(head, *wrist)), (finishes.glow(rng), move(glow, *wrist)), (body, foot)]


def paper_lamp(rng) -> list[Piece]:
    """A paper or cloth body that stands by itself: ribbed globe, column or box in a wooden frame."""
    paper, frame = finishes.glow(rng), finishes.choose(rng, finishes.wood, finishes.metal, finishes.wood)
    height, radius = rng.uniform(0.3, 1.1), rng.uniform(0.1, 0.2)
    if rng.random() < 0.4:
        wide = 2 * radius
        leg = leg_style(rng, 0.012)
        levels = np.linspace(0.08, 0.98, 5) * height
        across, along = box((wide, 0.014, 0.014)), box((0.014, 0.014, wide))
        bars = [move(across, y=y, z=s * radius) for y in levels for s in (1, -1)]
        bars += [move(along, s * radius, y) for y in levels for s in (1, -1)]
        bars += [move(box((0.012, height * 0.92, 0.012)), 0, height * 0.53, s * radius) for s in (1, -1)]
        core = move(box((wide * 0.98, height * 0.9, wide * 0.98)), y=height * 0.53)
        return [(paper, core), (frame, merge([four_legs(leg, wide, wide, height), *bars]))]
    ribs = int(rng.integers(8, 22))
    at = np.linspace(0, 1, 2 * ribs + 1)
    body = np.sqrt(np.maximum(1 - (2 * at - 1) ** 2 * rng.uniform(0.3, 0.95), 0.05))
    scallop = 1 + 0.03 * np.where(np.arange(len(at)) % 2, 1, -1)
    foot = rng.uniform(0.03, 0.15)
    ball = lathe(np.column_stack([radius * body * scallop, foot + at * height]), 28, crease=60)
    if rng.random() < 0.5:
        stand = merge([cylinder(radius * 0.7, 0.02, 24, 0.004), cylinder(0.02, foot + 0.01, 12)])
        return [(paper, ball), (frame, stand)]
    strut = tube([(radius * 0.7, 0, 0), (radius * body[0] * 0.8, foot + 0.02, 0)], 0.008)
    legs = [turn(strut, "y", 120 * i) for i in range(3)]
    return [(paper, ball), (frame, merge([*legs, move(cylinder(radius * body[0] * 0.95, 0.01, 20), y=foot)]))]


def mushroom_lamp(rng) -> list[Piece]:
    """A dome or globe set straight on a stem."""
    cap_finish = finishes.choose(rng, finishes.glow, finishes.paint, finishes.metal, finishes.plastic)
    body = cap_finish if rng.random() < 0.4 else finishes.choose(rng, finishes.metal, finishes.stone, finishes.wood)
    height, radius = rng.uniform(0.15, 0.4), rng.uniform(0.1, 0.2)
    column = pedestal(rng, height, rng.uniform(0.015, 0.06), radius * rng.uniform(0.5, 0.9))
    if rng.random() < 0.4:
        globe = move(superellipsoid((2 * radius, 2 * radius, 2 * radius), 1, 1, 16, 28), y=height + radius * 0.95)
        return [(body, column), (cap_finish, globe)]
    rise, angle = rng.uniform(0.5, 1.0) * radius, np.linspace(0, np.pi / 2, 10)
    dome = np.column_stack([radius * np.cos(angle), rise * np.sin(angle)])
    inside = (dome * 0.96)[::-1]
    profile = np.concatenate([inside[:1] * (0, 1), inside[1:], dome])  # the under side first, from the axis outward
    return [(body, column), (cap_finish, move(lathe(profile, 32), y=height - rise * 0.9))]


STYLES = {
    table_lamp: 0.28,
    floor_lamp: 0.16,
    tripod_lamp: 0.12,
    arc_lamp: 0.1,
    desk_lamp: 0.16,
    paper_lamp: 0.09,
    mushroom_lamp: 0.09,
}
