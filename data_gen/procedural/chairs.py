"""Chairs: wooden side chairs, moulded shells, cantilevers, office chairs, stools, armchairs and tubs. Metres."""

import numpy as np

from data_gen.procedural.parts import (
    Piece,
    four_legs,
    leg_style,
    pedestal,
    post,
    round_legs,
    star_base,
    stretchers,
    turned_profile,
)
from data_gen.shapes import finishes
from data_gen.shapes.primitives import (
    Mesh,
    bent_line,
    both_sides,
    box,
    curve,
    cylinder,
    lathe,
    merge,
    move,
    prism,
    rounded_rectangle,
    shell,
    superellipse,
    superellipsoid,
    tube,
    turn,
)


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
    legs = four_legs(leg_style(rng, 0.025), width * 0.8, depth * 0.75, seat * 0.35, rng.uniform(0, 0.03))
    return [*pieces, (body, legs)]


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
    disc = superellipse(28, 1.0, (radius * 0.8, radius * 0.8))
    column = post([(0, 0, 0), (0, 0.02, 0), (0, 0.03, 0), (0, foot + 0.01, 0)], [0.9, 0.9, 0.2, 0.2], disc)
    return [*pieces, (body, column)]


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
        z = -lean * np.sign(y) * np.abs(y) ** 1.3 - bow * (1 - x**2)
        return np.stack([x * width / 2, low + y * span, z], axis=-1)

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
        kind = rng.choice(["ring", "h", "cross"])
        rails = stretchers(inner[0] + reach, inner[1] + reach, seat * level, radius * 0.5, kind)
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
    side, middle = width / 2, (rear + front) / 2
    path = [(side, level, rear - 0.03), (side + flare, level + 0.015, middle)]
    top = curve([*path, (side + flare * 0.5, level - rng.uniform(0, 0.03), front)], 9)
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
        rod = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]]) * 0.01
        ring = lathe(rod + (radius * 0.75 + splay * (1 - level), seat * level), 28, closed=True)
        pieces.append((body, ring))
    else:
        column = pedestal(rng, seat - thick * 0.5, rng.uniform(0.02, 0.04), radius * rng.uniform(0.95, 1.3))
        pieces.append((body, column))
    if rng.random() < 0.3:
        back = backrest(rng, 1.5 * radius, seat - thick * 0.5, seat + rng.uniform(0.15, 0.35), 0.04, 0.03, 0.018)
        pieces += [(body, move(back["frame"], z=-radius * 0.62)), (top, move(back["fill"], z=-radius * 0.62))]
    return pieces


def bucket(rng, width, depth, high) -> tuple[Mesh, float]:
    """(moulded seat and back in one sheet, thickness), its seat at y = 0, front at z = depth / 2."""
    rear, roll, lean = -depth / 2, rng.uniform(0.05, 0.12), rng.uniform(0.04, 0.18)
    path = [(depth / 2 + 0.01, -rng.uniform(0.02, 0.05)), (depth * 0.3, 0.0), (-depth * 0.2, -0.015)]
    spine = curve([*path, (rear + 0.02, roll), (rear - lean * 0.5, high * 0.55), (rear - lean, high)], 22)
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
    frame = finishes.choose(rng, finishes.metal, finishes.paint)
    soft = finishes.choose(rng, finishes.leather, finishes.fabric, finishes.rattan, finishes.wood)
    width, depth = rng.uniform(0.4, 0.52), rng.uniform(0.42, 0.5)
    seat, high = rng.uniform(0.42, 0.47), rng.uniform(0.8, 0.95)
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
    path = [(0, seat - 0.05, 0), (0, seat - 0.06, rear * 0.7), (0, seat + 0.02, rear - 0.06)]
    spine = curve([*path, (0, seat + start + 0.15, rear - 0.05)], 12)
    pieces.append((hard, tube(spine, 1, section=rounded_rectangle(rng.uniform(0.05, 0.1), 0.025, 0.01, 2))))
    if rng.random() < 0.65:
        level, side = seat + rng.uniform(0.18, 0.25), width / 2 + 0.03
        loop = curve([(0.1, seat - 0.04, 0), (side, seat - 0.03, 0), (side, level, -0.02)], 10)
        pad = move(box((0.06, 0.03, 0.26), 0.012, 3), side, level)
        pieces += [(hard, both_sides(tube(loop, 0.014, segments=8)))]
        pieces.append((soft if rng.random() < 0.3 else hard, both_sides(pad)))
    if rng.random() < 0.25:
        rest = superellipsoid((width * 0.55, 0.14, 0.07), 0.5, 0.5, 8)
        pole = tube([(0, seat + high - 0.08, rear - lean - 0.01), (0, seat + high + 0.1, rear - lean - 0.01)], 0.012)
        pieces += [(soft, move(rest, y=seat + high + 0.11, z=rear - lean)), (hard, pole)]
    return pieces


STYLES = {
    side_chair: 0.32,
    shell_chair: 0.18,
    cantilever: 0.08,
    office_chair: 0.14,
    stool: 0.1,
    armchair: 0.1,
    tub_chair: 0.08,
}
