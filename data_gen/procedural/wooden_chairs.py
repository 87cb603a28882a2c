"""Chairs and stools put together from legs, a seat and a back of posts, rails, slats or panels. Metres."""

import numpy as np

from data_gen.procedural.joining import Piece
from data_gen.procedural.legs import four_legs, leg_style, pedestal, round_legs, stretchers, turned_profile
from data_gen.shapes import finishes
from data_gen.shapes.outlines import curve, rounded_rectangle, superellipse
from data_gen.shapes.primitives import (
    Mesh,
    both_sides,
    box,
    cylinder,
    lathe,
    merge,
    move,
    prism,
    shell,
    superellipsoid,
    tube,
    turn,
)


def seat_slab(rng, width, depth, thickness) -> Mesh:
    """Seat board or pad about (0, 0, 0): narrower at the back, square to round, edges rounded."""
    exponent = rng.choice([0.12, 0.3, 0.6, 1.0], p=[0.4, 0.3, 0.15, 0.15])
    outline = superellipse(32, exponent, (width / 2, depth / 2))
    outline[:, 0] *= 1 + rng.uniform(0, 0.12) * -outline[:, 1] / (depth / 2)  # the outline's +y becomes -z, the back
    return turn(prism(outline, thickness, thickness * rng.uniform(0.15, 0.45)), "x", -90)


def backrest(rng, width, low, high, lean, bow, thickness) -> dict[str, Mesh]:
    """Meshes {"frame", "fill"} of a back standing on z = 0 from y = low to high, leaning to -z and bowed sideways."""
    span = high - low

    def surface(x, y):  # x and y fractions, of the half width and the height
        return np.stack(
            [x * width / 2, low + y * span, -lean * np.sign(y) * np.abs(y) ** 1.3 - bow * (1 - x**2)], axis=-1
        )

    def panel(left, right, bottom, top, thick, columns=9, rows=7, arch=0.0):
        x, y = np.meshgrid(np.linspace(left, right, columns), np.linspace(bottom, top, rows))
        y = y + arch * (1 - x**2) * (y - bottom) / max(top - bottom, 1e-6)
        return move(shell(surface(x, y), thick), z=thick / 2)

    at, turned = turned_profile(rng, 14)
    radius = thickness * rng.uniform(0.6, 0.9) * (turned if rng.random() < 0.4 else np.linspace(1.0, 0.75, 14))
    posts = both_sides(tube(surface(np.full(14, 0.93), np.linspace(-0.04, 1, 14)), radius, segments=10))
    style = rng.choice(["slats", "spindles", "splat", "panel", "pad", "cross"])
    rail = rng.uniform(0.1, 0.2)
    crest = panel(-1, 1, 1 - rail, 1, thickness * 1.1, arch=rng.uniform(0, 0.12))
    if style == "slats":
        count = int(rng.integers(2, 6))
        edges = np.linspace(rng.uniform(0.15, 0.35), 1 - rail, count + 1)
        gap = rng.uniform(0.25, 0.6)
        fill = [
            panel(-0.95, 0.95, a, a + (b - a) * (1 - gap), thickness * 0.6, 9, 3)
            for a, b in zip(edges[:-1], edges[1:], strict=True)
        ]
    elif style == "spindles":
        count = int(rng.integers(3, 9))
        fill = [
            tube(surface(np.full(6, x), np.linspace(-0.03, 1 - rail / 2, 6)), thickness * 0.35, segments=7)
            for x in np.linspace(-0.93, 0.93, count + 2)[1:-1]
        ]
    elif style == "splat":
        half = 0.15 + 0.3 * rng.random() + 0.08 * np.sin(np.linspace(0, rng.uniform(3, 9), 9))
        x = half[:, None] * np.linspace(-1, 1, 5)
        y = np.broadcast_to(np.linspace(-0.03, 1 - rail / 2, 9)[:, None], x.shape)
        fill = [shell(surface(x, y), thickness * 0.6)]
    elif style == "cross":
        fill = [
            tube(surface(np.linspace(-0.93 * s, 0.93 * s, 8), np.linspace(0.1, 1 - rail / 2, 8)), thickness * 0.4)
            for s in (1, -1)
        ]
    else:
        bottom = rng.uniform(0.05, 0.45)
        fill = [panel(-0.97, 0.97, bottom, 1 - rail / 2, thickness * (2.2 if style == "pad" else 0.8), 11, 9)]
    return {"frame": merge([posts, crest]), "fill": merge(fill)}


def side_chair(rng) -> list[Piece]:
    """Four legs, a seat and a back; perhaps arms, rails and a cushion."""
    body = finishes.choose(rng, finishes.wood, finishes.wood, finishes.paint, finishes.metal, finishes.plastic)
    soft = finishes.choose(rng, finishes.fabric, finishes.leather, finishes.fabric, finishes.rattan)
    fill = body if rng.random() < 0.6 else soft
    width, depth, seat = rng.uniform(0.38, 0.56), rng.uniform(0.36, 0.5), rng.uniform(0.4, 0.5)
    thick, radius = rng.uniform(0.02, 0.06), rng.uniform(0.016, 0.032)
    splay = rng.uniform(0, 0.06) * (rng.random() < 0.6)
    pieces = [(body if rng.random() < 0.6 else soft, move(seat_slab(rng, width, depth, thick), y=seat - thick / 2))]
    inner = (width * 0.86 - 2 * radius, depth * 0.86 - 2 * radius)
    pieces.append((body, four_legs(leg_style(rng, radius), *inner, seat - thick * 0.5, splay)))
    if rng.random() < 0.45:
        level = rng.uniform(0.25, 0.6)
        reach = 2 * splay * (1 - level)
        rails = stretchers(
            inner[0] + reach, inner[1] + reach, seat * level, radius * 0.5, rng.choice(["ring", "h", "cross"])
        )
        pieces.append((body, rails))
    if rng.random() < 0.4:
        pieces.append((soft, move(superellipsoid((width * 0.93, 0.07, depth * 0.9), 0.5, 0.3, 8), y=seat + 0.015)))
    high, rear = seat + rng.uniform(0.32, 0.62), -depth * 0.43
    back_width = width * rng.uniform(0.82, 0.95)
    back = backrest(rng, back_width, seat - thick * 0.5, high, rng.uniform(0.02, 0.16), rng.uniform(0, 0.05), 0.024)
    pieces += [(body, move(back["frame"], z=rear)), (fill, move(back["fill"], z=rear))]
    if rng.random() < 0.35:
        pieces.append((body, arms(rng, back_width * 0.93, seat, rear, depth, radius)))
    return pieces


def arms(rng, width, seat, rear, depth, radius) -> Mesh:
    """Arm rests from the back posts forward, on a post each."""
    level, front = seat + rng.uniform(0.17, 0.26), rear + depth * rng.uniform(0.6, 0.85)
    flare = rng.uniform(0, 0.05)
    top = curve(
        [
            (width / 2, level, rear - 0.03),
            (width / 2 + flare, level + 0.015, (rear + front) / 2),
            (width / 2 + flare * 0.5, level - rng.uniform(0, 0.03), front),
        ],
        9,
    )
    section = rounded_rectangle(2 * rng.uniform(0.4, 1.0), 2, 0.35, 2)
    rest = tube(top, radius * rng.uniform(0.7, 1.0), section=section)
    foot = np.array([width / 2 * 0.98, seat - 0.02, front - 0.04])
    return both_sides(merge([rest, tube(np.stack([foot, top[-2]]), radius * 0.6, segments=8)]))


def stool(rng) -> list[Piece]:
    """A round or square seat at any height on three or four legs, a pedestal or a star; perhaps a low back."""
    body = finishes.choose(rng, finishes.wood, finishes.metal, finishes.paint)
    top = body if rng.random() < 0.4 else finishes.choose(rng, finishes.leather, finishes.fabric, finishes.wood)
    seat, radius, thick = rng.uniform(0.35, 0.78), rng.uniform(0.15, 0.22), rng.uniform(0.025, 0.1)
    disc = cylinder(radius, thick, 32, thick * rng.uniform(0.15, 0.45))
    square = move(box((2 * radius, thick, 1.8 * radius), thick * 0.3, 3), y=thick / 2)
    pieces = [(top, move(disc if rng.random() < 0.7 else square, y=seat - thick))]
    if rng.random() < 0.7:
        count, splay = int(rng.integers(3, 5)), rng.uniform(0, 0.12)
        leg = leg_style(rng, rng.uniform(0.014, 0.026))
        pieces.append((body, round_legs(leg, count, radius * 0.75, seat - thick * 0.7, splay, 45)))
        level = rng.uniform(0.25, 0.5)
        ring = lathe(
            np.array([[0, -1], [1, 0], [0, 1], [-1, 0]]) * 0.01 + (radius * 0.75 + splay * (1 - level), seat * level),
            28,
            closed=True,
        )
        pieces.append((body, ring))
    else:
        pieces.append(
            (body, pedestal(rng, seat - thick * 0.5, rng.uniform(0.02, 0.04), radius * rng.uniform(0.95, 1.3)))
        )
    if rng.random() < 0.3:
        back = backrest(rng, 1.5 * radius, seat - thick * 0.5, seat + rng.uniform(0.15, 0.35), 0.04, 0.03, 0.018)
        pieces += [(body, move(back["frame"], z=-radius * 0.62)), (top, move(back["fill"], z=-radius * 0.62))]
    return pieces
