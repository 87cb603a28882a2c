"""Upholstered chairs: armchairs between wooden or stuffed arms, and tubs. Metres."""

import numpy as np

from data_gen.procedural.joining import Piece
from data_gen.procedural.legs import four_legs, leg_style, post, round_legs
from data_gen.shapes import finishes
from data_gen.shapes.outlines import superellipse
from data_gen.shapes.primitives import both_sides, box, cylinder, merge, move, shell, superellipsoid, turn


def armchair(rng) -> list[Piece]:
    """An upholstered or wood-framed easy chair: thick seat and back between two arms."""
    soft = finishes.choose(rng, finishes.fabric, finishes.leather)
    body = finishes.choose(rng, finishes.wood, finishes.metal, finishes.wood)
    width, depth, seat = rng.uniform(0.55, 0.75), rng.uniform(0.55, 0.7), rng.uniform(0.34, 0.42)
    squareness, thick, high = rng.uniform(0.2, 0.55), rng.uniform(0.1, 0.18), rng.uniform(0.45, 0.7)
    cushion = superellipsoid((width, thick, depth), squareness, 0.25, 10)
    rest = superellipsoid((width, high, thick * rng.uniform(0.8, 1.3)), 0.3, squareness, 12)
    tilt = rng.uniform(4, 18)
    rest = move(turn(move(rest, y=high / 2 - 0.04), "x", -tilt), y=seat - thick * 0.3, z=-depth / 2 + 0.08)
    pieces = [(soft, move(cushion, y=seat - thick / 2)), (soft, rest)]
    level, side = seat + rng.uniform(0.14, 0.24), width / 2 + 0.03
    if rng.random() < 0.5:  # open wooden arms that carry the seat
        leg, r = leg_style(rng, rng.uniform(0.02, 0.03)), 0.02
        pieces.append((body, four_legs(leg, 2 * side, depth * 0.85, level, rng.uniform(0, 0.05))))
        arm = box((rng.uniform(0.04, 0.09), 0.03, depth * 1.02), 0.01, 3)
        rails = both_sides(move(box((0.025, 0.05, depth * 0.85)), side, seat - thick * 0.7))
        cross = [move(box((2 * side, 0.05, 0.03)), y=seat - thick * 0.7, z=z) for z in (-depth * 0.4, 0, depth * 0.4)]
        return [*pieces, (body, merge([both_sides(move(arm, side, level + r / 2)), rails, *cross]))]
    arm = superellipsoid((rng.uniform(0.1, 0.18), level - seat * 0.35, depth), squareness, 0.3, 10)
    base = move(box((width, seat * 0.5, depth * 0.9), 0.02, 3), y=seat * 0.55)
    pieces += [(soft, both_sides(move(arm, side + 0.02, (level + seat * 0.35) / 2))), (soft, base)]
    return [
        *pieces,
        (body, four_legs(leg_style(rng, 0.025), width * 0.8, depth * 0.75, seat * 0.35, rng.uniform(0, 0.03))),
    ]


def tub_chair(rng) -> list[Piece]:
    """A curved back that runs into the arms around a round cushion."""
    soft = finishes.choose(rng, finishes.fabric, finishes.leather, finishes.rattan)
    inner = soft if rng.random() < 0.5 else finishes.choose(rng, finishes.fabric, finishes.leather)
    body = finishes.choose(rng, finishes.wood, finishes.metal)
    radius, seat, thick = rng.uniform(0.26, 0.36), rng.uniform(0.34, 0.44), rng.uniform(0.03, 0.08)
    foot, high = rng.uniform(0.1, 0.25), rng.uniform(0.28, 0.5)
    sweep = np.radians(rng.uniform(95, 140))
    angle, y = np.meshgrid(np.linspace(sweep, -sweep, 29), np.linspace(0, 1, 6))
    drop = rng.uniform(0.2, 0.7) * np.abs(angle / sweep) ** rng.uniform(1.5, 4)
    level = foot + y * (seat - foot + high * (1 - drop))
    around = radius * (1 + rng.uniform(-0.1, 0.2) * y)
    points = np.stack([around * np.sin(angle), level, -around * np.cos(angle)], axis=-1)
    cushion = superellipsoid((2 * radius, 0.14, 2 * radius), 0.45, rng.uniform(0.6, 1), 10)
    drum = cylinder(radius * 0.97, seat - 0.06 - foot, 32)
    pieces = [(soft, shell(points, -thick)), (inner, move(cushion, y=seat - 0.04)), (soft, move(drum, y=foot))]
    if rng.random() < 0.6:
        leg = leg_style(rng, 0.022)
        return [*pieces, (body, round_legs(leg, 4, radius * 0.7, foot + 0.01, rng.uniform(0, 0.05), 45))]
    column = post(
        [(0, 0, 0), (0, 0.02, 0), (0, 0.03, 0), (0, foot + 0.01, 0)],
        [0.9, 0.9, 0.2, 0.2],
        superellipse(28, 1.0, (radius * 0.8, radius * 0.8)),
    )
    return [*pieces, (body, column)]
