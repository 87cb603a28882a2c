"""Sofas: boxy, rounded, scrolled, curved, wood-framed and corner sofas, day beds; with cushions. Metres."""

import numpy as np

from data_gen.procedural.parts import Piece, four_legs, leg_style, round_legs
from data_gen.shapes import finishes
from data_gen.shapes.primitives import (
    Mesh,
    both_sides,
    box,
    circle,
    cylinder,
    merge,
    move,
    prism,
    shell,
    superellipsoid,
    turn,
)


def upholstery(rng) -> finishes.Finish:
    """A finish that sofas are covered with."""
    return finishes.choose(rng, finishes.fabric, finishes.fabric, finishes.leather)


def cushions(count, width, thick, depth, roundness) -> Mesh:
    """Seat cushions side by side about x = z = 0, their under sides at y = 0."""
    each = width / count
    pad = superellipsoid((each * 1.01, thick, depth), roundness, 0.22, 10, 28)
    return merge(move(pad, (i + 0.5) * each - width / 2, thick / 2) for i in range(count))


def arm(rng, style, width, height, depth) -> Mesh:
    """One arm about x = z = 0, standing on y = 0."""
    if style == "box":
        return move(box((width, height, depth), width * rng.uniform(0.05, 0.4), 3), y=height / 2)
    if style == "round":
        return move(superellipsoid((width, height, depth), rng.uniform(0.3, 0.6), 0.3, 12), y=height / 2)
    if style == "scroll":
        radius = width * rng.uniform(0.45, 0.6)
        roll = move(prism(circle(20, radius), depth, 0.015), x=width * 0.12, y=height - radius)
        return merge([move(box((width * 0.8, height - radius, depth * 0.97), 0.02, 3), y=(height - radius) / 2), roll])
    front = height * rng.uniform(0.6, 0.85)  # sloping towards the front
    outline = [(-depth / 2, 0), (depth / 2, 0), (depth / 2, front), (depth * 0.1, front * 1.04), (-depth / 2, height)]
    return turn(prism(outline, width, 0.02), "y", -90)


def pillows(rng, count, width, seat, rear) -> Mesh:
    """Throw pillows leaning on the back at z = rear."""
    meshes = []
    for _ in range(count):
        size = rng.uniform(0.3, 0.42)
        pad = superellipsoid((size, size, 0.15), 0.55, 0.45, 10)
        pad = turn(turn(pad, "z", rng.uniform(-15, 15)), "x", -rng.uniform(12, 25))
        meshes.append(move(pad, rng.uniform(-0.4, 0.4) * width, seat + size * 0.46, rear + 0.1))
    return merge(meshes)


def classic(rng) -> list[Piece]:
    """Base, arms, back and cushions in any proportion; one end may run out into a long seat."""
    cover, seats = upholstery(rng), int(rng.integers(1, 5))
    second = cover if rng.random() < 0.65 else upholstery(rng)
    feet = finishes.choose(rng, finishes.wood, finishes.metal)
    inner, depth = seats * rng.uniform(0.5, 0.7) + 0.25 * (seats == 1), rng.uniform(0.55, 0.75)
    foot, base, thick = rng.uniform(0.04, 0.18), rng.uniform(0.12, 0.25), rng.uniform(0.1, 0.2)
    seat, roundness = foot + base + thick, rng.uniform(0.2, 0.5)
    back, deep = rng.uniform(0.3, 0.5), rng.uniform(0.14, 0.24)
    width = rng.uniform(0.1, 0.28)
    armless = rng.random() < 0.1
    whole = inner + 2 * width * (not armless)

    pieces = [(cover, move(box((whole, base, depth + deep), 0.03, 3), y=foot + base / 2, z=-deep / 2))]
    count = seats if rng.random() < 0.75 else 1
    pad = cushions(count, inner, thick, depth * 1.02, roundness)
    pieces.append((second, move(pad, y=foot + base - 0.01, z=0.01)))
    tilt = rng.uniform(0, 12)
    rest = box((whole if rng.random() < 0.6 else inner, back + thick, deep * 0.8), deep * rng.uniform(0.1, 0.38), 3)
    rest = turn(move(rest, y=(back + thick) / 2), "x", -tilt)
    pieces.append((cover, move(rest, y=seat - thick - 0.02, z=-depth / 2 - deep * 0.5)))
    if rng.random() < 0.75:
        pad = move(turn(cushions(count, inner, back * 1.1, deep, 0.45), "x", -tilt - 4), y=seat - 0.02)
        pieces.append((second, move(pad, z=-depth / 2 + deep * 0.25)))
    if not armless:
        style = rng.choice(["box", "round", "scroll", "slope"])
        side = arm(rng, style, width, base + thick + rng.uniform(0.08, 0.28), depth + deep * 0.9)
        pieces.append((cover, both_sides(move(side, (inner + width) / 2, foot, -deep * 0.4))))
    if seats > 1 and rng.random() < 0.3:
        pieces += long_seat(rng, cover, second, inner / count, (inner / 2, depth / 2), foot, base, thick, roundness)
    legs = four_legs(leg_style(rng, rng.uniform(0.018, 0.035)), whole - 0.1, depth + deep - 0.1, foot + 0.02)
    pieces.append((feet, move(legs, z=-deep / 2)))
    if rng.random() < 0.4:
        throw = finishes.choose(rng, finishes.fabric)
        pieces.append((throw, pillows(rng, int(rng.integers(1, 4)), inner * 0.8, seat - 0.02, -depth / 2 + deep * 0.5)))
    return pieces


def long_seat(rng, cover, second, width, corner, foot, base, thick, roundness) -> list[Piece]:
    """A chaise in front of the last seat, on either side, on the floor; `corner` = (x, z) of the seat's edge."""
    side, reach = int(rng.choice([1, -1])), rng.uniform(0.35, 0.8)
    x, z = side * (corner[0] - width / 2), corner[1] + reach / 2
    block = move(box((width, base + foot, reach + 0.04), 0.03, 3), x, (base + foot) / 2, z)
    pad = superellipsoid((width, thick, reach + 0.06), roundness, 0.22, 10, 28)
    pad = move(pad, x, foot + base - 0.01 + thick / 2, z)
    return [(cover, block), (second, pad)]


def framed(rng) -> list[Piece]:
    """A wooden or metal frame with loose cushions: settee, futon or garden bench."""
    body = finishes.choose(rng, finishes.wood, finishes.metal, finishes.paint)
    cover, seats = finishes.choose(rng, finishes.fabric, finishes.leather), int(rng.integers(2, 4))
    inner, depth, seat = seats * rng.uniform(0.5, 0.65), rng.uniform(0.55, 0.7), rng.uniform(0.28, 0.36)
    back, level, thick = rng.uniform(0.36, 0.5), rng.uniform(0.5, 0.62), rng.uniform(0.1, 0.16)
    radius, lean = rng.uniform(0.02, 0.035), rng.uniform(6, 18)
    legs = four_legs(leg_style(rng, radius), inner + 2 * radius, depth - 2 * radius, level, rng.uniform(0, 0.05))
    rests = both_sides(move(box((rng.uniform(0.05, 0.12), 0.03, depth * 1.05), 0.01, 3), inner / 2 + radius, level))
    rails = [move(box((inner + 2 * radius, 0.06, 0.03)), y=seat - 0.03, z=s * (depth / 2 - radius)) for s in (1, -1)]
    slats = [move(box((inner / 8, 0.02, depth - radius)), (i / 6 - 0.5) * inner * 0.95, seat) for i in range(7)]
    ladder = [move(box((inner + 2 * radius, 0.06, 0.025), 0.005), y=y) for y in np.linspace(0.08, back, 4)]
    bar = box((0.04, back + 0.1, 0.025))
    ladder += [move(bar, x, (back - 0.06) / 2) for x in np.linspace(-0.48, 0.48, seats + 1) * inner]
    rest = move(turn(merge(ladder), "x", -lean), y=seat, z=-depth / 2 + radius)
    pad = cushions(seats, inner, thick, depth * 0.9, rng.uniform(0.25, 0.45))
    upright = turn(cushions(seats, inner, back, thick, 0.4), "x", -lean)
    pieces = [(body, merge([legs, rests, *rails, *slats, rest])), (cover, move(pad, y=seat + 0.005))]
    return [*pieces, (cover, move(upright, y=seat + thick * 0.8, z=-depth / 2 + thick * 0.6))]


def curved(rng) -> list[Piece]:
    """A back bent around a curved or round seat."""
    cover, feet = upholstery(rng), finishes.choose(rng, finishes.wood, finishes.metal)
    width, depth, foot = rng.uniform(1.2, 2.2), rng.uniform(0.75, 1.0), rng.uniform(0.06, 0.16)
    seat, high, thick = rng.uniform(0.38, 0.46), rng.uniform(0.25, 0.42), rng.uniform(0.08, 0.18)
    sweep = np.radians(rng.uniform(90, 125))
    angle, y = np.meshgrid(np.linspace(sweep, -sweep, 33), np.linspace(0, 1, 7))
    fall = rng.uniform(0, 0.7) * np.abs(angle / sweep) ** 2.5
    level = foot + y * (seat - foot + high * (1 - fall))
    flare = 1 + rng.uniform(0, 0.1) * y
    points = np.stack([width / 2 * flare * np.sin(angle), level, -depth / 2 * flare * np.cos(angle)], axis=-1)
    outline = circle(40) * (width / 2, depth / 2)
    base = move(turn(prism(outline, seat - 0.12 - foot), "x", -90), y=(seat - 0.12 + foot) / 2)
    pad = move(superellipsoid((width * 0.99, 0.2, depth * 0.99), 0.35, 1.0, 10, 40), y=seat - 0.1)
    legs = round_legs(leg_style(rng, 0.025), 6, depth * 0.38, foot + 0.02)
    pieces = [(cover, shell(points, -thick)), (cover, base), (cover, pad), (feet, legs)]
    if rng.random() < 0.5:
        throw = finishes.choose(rng, finishes.fabric)
        pieces.append((throw, pillows(rng, 2, width * 0.7, seat - 0.05, -depth * 0.4)))
    return pieces


def bench(rng) -> list[Piece]:
    """A day bed, ottoman or waiting bench: one long pad, perhaps a bolster or separate backs."""
    cover, body = upholstery(rng), finishes.choose(rng, finishes.wood, finishes.metal)
    width, depth = rng.uniform(0.9, 2.0), rng.uniform(0.45, 0.8)
    seat, thick = rng.uniform(0.36, 0.46), rng.uniform(0.08, 0.18)
    parts = int(rng.integers(1, 5))
    pad = cushions(parts, width, thick, depth, rng.uniform(0.2, 0.5))
    frame = move(box((width * 0.99, 0.06, depth * 0.95), 0.01, 3), y=seat - thick - 0.02)
    leg = leg_style(rng, rng.uniform(0.018, 0.035))
    legs = four_legs(leg, width * 0.88, depth * 0.8, seat - thick, rng.uniform(0, 0.06))
    pieces = [(cover, move(pad, y=seat - thick)), (body, merge([frame, legs]))]
    kind = rng.choice(["plain", "bolster", "backs"])
    if kind == "bolster":
        radius = rng.uniform(0.08, 0.13)
        roll = turn(move(cylinder(radius, depth * 0.95, 24, 0.02), y=-depth * 0.475), "x", 90)
        roll = move(roll, y=seat + radius * 0.9)
        ends = (1, -1) if rng.random() < 0.5 else (1,)
        pieces += [(cover, move(roll, s * (width / 2 - radius - 0.02))) for s in ends]
    if kind == "backs":
        high = rng.uniform(0.3, 0.45)
        upright = turn(cushions(parts, width, high, thick * 0.8, 0.35), "x", -rng.uniform(4, 14))
        pieces.append((cover, move(upright, y=seat - 0.03, z=-depth / 2 + thick * 0.3)))
        post = box((0.03, high, 0.02))
        posts = [move(post, x, seat + high * 0.3, -depth / 2 - 0.02) for x in (-width * 0.35, width * 0.35)]
        pieces.append((body, merge(posts)))
    return pieces


STYLES = {classic: 0.55, framed: 0.17, curved: 0.13, bench: 0.15}
