"""Chairs: wooden side chairs, moulded shells, cantilevers, office chairs, stools, armchairs and tubs. Metres."""

import numpy as np

from data_gen.procedural.easy_chairs import armchair, tub_chair
from data_gen.procedural.joining import Piece
from data_gen.procedural.legs import four_legs, leg_style, pedestal, star_base
from data_gen.procedural.wooden_chairs import side_chair, stool
from data_gen.shapes import finishes
from data_gen.shapes.outlines import bent_line, curve, rounded_rectangle
from data_gen.shapes.primitives import Mesh, both_sides, box, cylinder, merge, move, shell, superellipsoid, tube, turn


def chair(rng) -> list[Piece]:
    """Pieces of one chair."""
    style = rng.choice(
        [side_chair, shell_chair, cantilever, office_chair, stool, armchair, tub_chair],
        p=[0.32, 0.18, 0.08, 0.14, 0.1, 0.1, 0.08],
    )
    return style(rng)


def bucket(rng, width, depth, high) -> tuple[Mesh, float]:
    """(moulded seat and back in one sheet, thickness), its seat at y = 0, front at z = depth / 2."""
    rear, roll, lean = -depth / 2, rng.uniform(0.05, 0.12), rng.uniform(0.04, 0.18)
    spine = curve(
        [
            (depth / 2 + 0.01, -rng.uniform(0.02, 0.05)),
            (depth * 0.3, 0.0),
            (-depth * 0.2, -0.015),
            (rear + 0.02, roll),
            (rear - lean * 0.5, high * 0.55),
            (rear - lean, high),
        ],
        22,
    )
    across = np.linspace(-1, 1, 15)
    along = np.linspace(0, 1, 22)
    taper = 1 - rng.uniform(0, 0.35) * along**3 - rng.uniform(0, 0.3) * np.clip(along - 0.8, 0, 1) / 0.2
    soft = rng.uniform(0.4, 1.0)  # how round the front and the crest are
    taper *= 1 - soft * 0.5 * (np.abs(2 * along - 1) ** 8)
    wrap = rng.uniform(0.02, 0.13) * np.sin(np.pi * np.clip(along * 1.1, 0, 1)) ** 2
    points = np.empty((22, 15, 3))
    points[..., 0] = -across * width / 2 * taper[:, None]
    lift = np.abs(across) ** rng.uniform(2, 4)
    tangent = np.gradient(spine, axis=0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1) / np.linalg.norm(tangent, axis=1, keepdims=True)
    points[..., 1] = spine[:, 1:] + lift * (wrap * normal[:, 1])[:, None]
    points[..., 2] = spine[:, :1] + lift * (wrap * normal[:, 0])[:, None]
    thickness = rng.uniform(0.008, 0.022)
    return shell(points, thickness), thickness


def shell_chair(rng) -> list[Piece]:
    """A moulded bucket on legs, a pedestal, a star or a sled."""
    body = finishes.choose(rng, finishes.plastic, finishes.plastic, finishes.wood, finishes.leather, finishes.fabric)
    under = finishes.choose(rng, finishes.metal, finishes.wood, finishes.paint)
    width, depth, seat = rng.uniform(0.42, 0.62), rng.uniform(0.4, 0.5), rng.uniform(0.38, 0.48)
    sheet, thick = bucket(rng, width, depth, rng.uniform(0.3, 0.55))
    pieces = [(body, move(sheet, y=seat)), (under, move(cylinder(0.11, 0.03, 20), y=seat - thick - 0.04))]
    top = seat - thick - 0.02
    base = rng.choice(["legs", "pedestal", "star", "sled"])
    if base == "legs":
        pieces.append((under, four_legs(leg_style(rng, 0.018), 0.16, 0.16, top + 0.01, rng.uniform(0.08, 0.15))))
    elif base == "pedestal":
        pieces.append((under, pedestal(rng, top, rng.uniform(0.02, 0.05), rng.uniform(0.2, 0.28))))
    elif base == "star":
        arms_, castors = star_base(rng, top, rng.uniform(0.24, 0.32))
        pieces += [(under, arms_), (finishes.rubber(rng), castors)]
    else:
        pieces.append((under, sled(width * 0.8, depth * 0.85, top)))
    if rng.random() < 0.3:
        soft = finishes.choose(rng, finishes.fabric, finishes.leather)
        pieces.append((soft, move(superellipsoid((width * 0.7, 0.05, depth * 0.7), 0.5, 0.5, 8), y=seat + 0.005)))
    return pieces


def sled(width, depth, top) -> Mesh:
    """Two runners of bent tube that meet under the seat."""
    x, z, r = width / 2, depth / 2, 0.011
    corners = [(0.04, top, z * 0.6), (x * 0.8, top - 0.01, z * 0.7), (x, r, z), (x, r, -z)]
    corners += [(x * 0.8, top - 0.01, -z * 0.7), (0.04, top, -z * 0.6)]
    plate = move(box((0.12, 0.015, 1.3 * z)), y=top)
    return merge([both_sides(tube(bent_line(corners, 0.06), r, segments=8)), plate])


def cantilever(rng) -> list[Piece]:
    """One bent tube for runners, front legs and back; two pads hang in it."""
    frame, soft = (
        finishes.choose(rng, finishes.metal, finishes.paint),
        finishes.choose(rng, finishes.leather, finishes.fabric, finishes.rattan, finishes.wood),
    )
    width, depth, seat, high = (
        rng.uniform(0.4, 0.52),
        rng.uniform(0.42, 0.5),
        rng.uniform(0.42, 0.47),
        rng.uniform(0.8, 0.95),
    )
    x, z, r, lean = width / 2, depth / 2, rng.uniform(0.01, 0.016), rng.uniform(0.04, 0.12)
    corners = [(0, r, -z), (x, r, -z), (x, r, z), (x, seat, z), (x, seat, -z), (x, high, -z - lean)]
    loop = bent_line(corners, rng.uniform(0.04, 0.08))
    top = tube([(-x, high, -z - lean), (x, high, -z - lean)], r, segments=8)
    pieces = [(frame, merge([both_sides(tube(loop, r, segments=8)), top]))]
    pieces.append((soft, move(box((width, rng.uniform(0.02, 0.05), depth * 0.9), 0.012, 3), y=seat + 0.005)))
    rest = rng.uniform(0.15, 0.35)
    pad = move(box((width, rest, 0.03), 0.012, 3), y=-rest / 2)
    tilt = np.degrees(np.arctan2(lean, high - seat - 0.06))
    pieces.append((soft, move(turn(pad, "x", -tilt), y=high - 0.01, z=-z - lean + 0.01)))
    return pieces


def office_chair(rng) -> list[Piece]:
    """A swivel chair on castors with a cushioned seat and back, perhaps arms and a head rest."""
    soft = finishes.choose(rng, finishes.fabric, finishes.leather, finishes.fabric, finishes.plastic)
    hard = finishes.choose(rng, finishes.plastic, finishes.metal)
    width, depth, seat = rng.uniform(0.44, 0.54), rng.uniform(0.42, 0.52), rng.uniform(0.42, 0.52)
    arms_, castors = star_base(rng, seat - 0.04, rng.uniform(0.27, 0.34))
    thick = rng.uniform(0.06, 0.12)
    pieces = [(hard, arms_), (finishes.rubber(rng), castors)]
    pieces.append((soft, move(superellipsoid((width, thick, depth), 0.4, rng.uniform(0.2, 0.5), 10), y=seat)))
    high, rear, bow = rng.uniform(0.4, 0.75), -depth / 2, rng.uniform(0.01, 0.06)
    start = rng.uniform(0.04, 0.14)
    lean = rng.uniform(0.04, 0.14)
    x, y = np.meshgrid(np.linspace(-1, 1, 13), np.linspace(0, 1, 13))
    narrow = 1 - rng.uniform(0, 0.3) * y - rng.uniform(0, 0.15) * (1 - y) ** 2
    z = bow * x**2 - lean * y + 0.03 * np.sin(np.pi * y * 1.3)
    points = np.stack([x * width * 0.48 * narrow, start + y * (high - start), z], axis=-1)
    pieces.append((soft, move(shell(points, rng.uniform(0.02, 0.07), 50), y=seat, z=rear)))
    spine = curve(
        [
            (0, seat - 0.05, 0),
            (0, seat - 0.06, rear * 0.7),
            (0, seat + 0.02, rear - 0.06),
            (0, seat + start + 0.15, rear - 0.05),
        ],
        12,
    )
    pieces.append((hard, tube(spine, 1, section=rounded_rectangle(rng.uniform(0.05, 0.1), 0.025, 0.01, 2))))
    if rng.random() < 0.65:
        level, side = seat + rng.uniform(0.18, 0.25), width / 2 + 0.03
        loop = curve([(0.1, seat - 0.04, 0), (side, seat - 0.03, 0), (side, level, -0.02)], 10)
        pad = move(box((0.06, 0.03, 0.26), 0.012, 3), side, level)
        pieces += [
            (hard, both_sides(tube(loop, 0.014, segments=8))),
            (soft if rng.random() < 0.3 else hard, both_sides(pad)),
        ]
    if rng.random() < 0.25:
        rest = superellipsoid((width * 0.55, 0.14, 0.07), 0.5, 0.5, 8)
        pole = tube([(0, seat + high - 0.08, rear - lean - 0.01), (0, seat + high + 0.1, rear - lean - 0.01)], 0.012)
        pieces += [(soft, move(rest, y=seat + high + 0.11, z=rear - lean)), (hard, pole)]
    return pieces
