"""Frames: pictures, mirrors, clocks, screens and collages, on the wall, on a strut or on a foot. Metres."""

import numpy as np

from data_gen.procedural.parts import Piece, four_legs, leg_style
from data_gen.shapes import finishes
from data_gen.shapes.primitives import (
    Mesh,
    box,
    cylinder,
    lathe,
    loft,
    merge,
    moulding,
    move,
    patch,
    rounded_rectangle,
    superellipsoid,
    tube,
    turn,
)


def profile(rng, width: float, depth: float) -> np.ndarray:
    """(k, 2) section (outward, z) of a moulding: a straight back and outside, a shaped front."""
    style = rng.choice(["flat", "bevel", "scoop", "round", "carved"])
    at = np.linspace(1, 0, 12)
    shape = {
        "flat": np.ones(12),
        "bevel": 0.5 + 0.5 * (at if rng.random() < 0.5 else 1 - at),
        "scoop": 1 - 0.6 * np.sin(np.pi * at),
        "round": 0.5 + 0.5 * np.sin(np.pi * np.clip(at, 0.05, 0.95)),
        "carved": np.clip(0.65 + 0.3 * np.sin(at * rng.uniform(6, 14)) * (0.4 + at), 0.2, 1),
    }[style]
    front = np.column_stack([at * width, depth * shape])
    return np.concatenate([[(0, 0), (width, 0)], front[[0, -1]] if style in ("flat", "bevel") else front])


def sheet(width: float, height: float, z: float) -> Mesh:
    """Rectangle facing +z with the unit square of texture coordinates upright on it."""
    x, y = np.meshgrid([-width / 2, width / 2], [-height / 2, height / 2])
    texcoords = np.stack(np.meshgrid([0.0, 1.0], [1.0, 0.0]), axis=-1)
    return patch(np.stack([x, y, np.full((2, 2), z)], axis=-1), texcoords=texcoords)


def framed_sheet(rng, border, image, mount, width, height) -> list[Piece]:
    """Moulding, back, perhaps a mount with its opening, and the picture, about x = y = 0, its back at z = 0."""
    rim, depth = rng.uniform(0.04, 0.2) * min(width, height), rng.uniform(0.015, 0.05)
    pieces = [(border, moulding(width, height, profile(rng, rim, depth)))]
    pieces.append((mount, move(box((width + 0.01, height + 0.01, 0.006)), z=0.005)))
    level = rng.uniform(0.2, 0.5) * depth + 0.004
    edge = rng.uniform(0.06, 0.2) * min(width, height) * (rng.random() < 0.5)
    inner = (width - 2 * edge, height - 2 * edge)
    if edge:
        card = moulding(*inner, [(0, 0.008), (edge + 0.002, 0.008), (edge + 0.002, level), (0.003, level)])
        pieces.append((mount, card))
    pieces.append((image, move(box((*inner, 0.004)), z=level - 0.0035)))
    return [*pieces, (image, sheet(inner[0] - 0.002, inner[1] - 0.002, level - 0.001))]


def content(rng) -> finishes.Finish:
    """What a frame shows: mostly a painting, at times a mirror."""
    if rng.random() < 0.85:
        return finishes.canvas(rng)
    return finishes.finish(np.full(3, rng.uniform(0.7, 0.92)), rng.uniform(0.05, 0.1), 1.0)


def border_finish(rng) -> finishes.Finish:
    """A finish that mouldings have."""
    return finishes.choose(rng, finishes.wood, finishes.wood, finishes.metal, finishes.paint)


def paper(rng) -> finishes.Finish:
    """Card of a mount: mostly pale."""
    tint = finishes.hsv(rng.random(), rng.uniform(0, 0.12), rng.uniform(0.75, 0.97))
    return finishes.finish(tint if rng.random() < 0.75 else finishes.color(rng), 0.9)


def size(rng) -> tuple[float, float]:
    """(width, height): upright, lying or square."""
    long = rng.uniform(0.25, 1.1)
    short = long * rng.uniform(0.45, 1.0)
    return (long, short) if rng.random() < 0.5 else (short, long)


def picture(rng) -> list[Piece]:
    """A framed picture that hangs, or leans on a strut."""
    width, height = size(rng)
    pieces = framed_sheet(rng, border_finish(rng), content(rng), paper(rng), width, height)
    if rng.random() < 0.4:
        border, lean = pieces[0][0], rng.uniform(6, 16)
        low = min(mesh.positions[:, 1].min() for _, mesh in pieces)
        tilted = [(finish, turn(move(mesh, y=-low), "x", -lean)) for finish, mesh in pieces]
        top = 0.6 * (height / 2 - low) * np.array([0, np.cos(np.radians(lean)), -np.sin(np.radians(lean))])
        foot = (0, 0.005, top[2] - top[1] * rng.uniform(0.3, 0.6))
        return [*tilted, (border, tube([foot, top], 1, section=rounded_rectangle(0.07, 0.012)))]
    return pieces


def round_frame(rng) -> list[Piece]:
    """A round or oval moulding about a mirror or picture."""
    border, image = border_finish(rng), content(rng)
    radius, rim, depth = rng.uniform(0.15, 0.45), rng.uniform(0.02, 0.1), rng.uniform(0.015, 0.04)
    section = profile(rng, rim, depth) + (radius, 0)
    ring = turn(lathe(section, 48, closed=True), "x", 90)
    disc = turn(cylinder(radius + 0.004, depth * 0.5, 48), "x", 90)
    face = disc._replace(texcoords=0.5 + disc.positions[:, :2] * (1, -1) / (2 * radius + 0.01))
    squash = np.array([1.0, rng.uniform(1.0, 1.5), 1.0])  # an oval: normals go the inverse way

    def oval(mesh):
        normals = mesh.normals / squash
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return mesh._replace(positions=mesh.positions * squash, normals=normals)

    pieces = [(border, oval(ring)), (image, oval(face))]
    if rng.random() < 0.3:  # a stand mirror
        high = (radius + rim) * squash[1]
        foot = move(cylinder(radius * 0.6, 0.02, 28, 0.004), y=-high - 0.13, z=-0.01)
        post = [tube([(0, -high - 0.12, -0.01), (0, -high * 0.9, depth * 0.4)], 0.012), foot]
        pieces.append((border, merge(post)))
    return pieces


def clock(rng) -> list[Piece]:
    """A dial with marks and hands in a round, square or petalled case; on the wall or on two feet."""
    case = border_finish(rng)
    dial = finishes.finish(finishes.color(rng), 0.6) if rng.random() < 0.7 else finishes.print_(rng)
    dark = finishes.choose(rng, finishes.metal, finishes.plastic)
    radius, depth = rng.uniform(0.08, 0.3), rng.uniform(0.03, 0.07)
    pieces = [(dial, turn(cylinder(radius * 0.99, depth * 0.6, 48), "x", 90))]
    style = rng.choice(["round", "square", "rays"])
    if style == "square":
        half = 2 * radius
        pieces.append((case, moulding(half, half, profile(rng, radius * 0.25, depth))))
        pieces.append((dial, move(box((half, half, depth * 0.5)), z=depth * 0.26)))
    else:
        section = profile(rng, radius * rng.uniform(0.08, 0.25), depth) + (radius * 0.97, 0)
        pieces.append((case, turn(lathe(section, 48, closed=True), "x", 90)))
    if style == "rays":
        count = int(rng.integers(8, 25))
        tip = radius * rng.uniform(1.4, 2.0)
        spike = tube([(0, radius, depth * 0.4), (0, tip, depth * 0.4)], [radius * 0.07, 0.004])
        pieces.append((case, merge(turn(spike, "z", 360 / count * i) for i in range(count))))
    pieces.append((dark, hands_and_marks(rng, radius, depth * 0.6)))
    if rng.random() < 0.35 and style != "rays":
        feet = []
        for s in (1, -1):
            foot, top = (s * radius * 0.7, -radius * 1.25), (s * radius * 0.5, -radius * 0.75)
            feet.append(tube([(*foot, depth * 0.5), (*top, depth * 0.5)], radius * 0.07))
        pieces.append((case, merge(feet)))
        if style == "round":
            pieces.append((dark, bells(radius, depth)))
    return pieces


def hands_and_marks(rng, radius: float, face: float) -> Mesh:
    """Twelve marks, two hands at any time, and their pin, on a dial whose face lies at z."""
    mark = move(box((radius * 0.04, radius * 0.14, 0.006)), y=radius * 0.82, z=face)
    marks = [turn(mark, "z", 30 * i) for i in range(12)]
    hands = []
    for w, long in ((0.06, 0.55), (0.04, 0.8)):
        hand = move(box((radius * w, radius * long, 0.005)), y=radius * long * 0.4, z=face + 0.004)
        hands.append(turn(hand, "z", rng.uniform(0, 360)))
    pin = move(turn(cylinder(radius * 0.05, 0.02, 12), "x", 90), z=face - 0.005)
    return merge([*marks, *hands, pin])


def bells(radius: float, depth: float) -> Mesh:
    """Two bells, left and right on top of an alarm clock."""
    bell = superellipsoid((radius * 0.6, radius * 0.4, depth), 1, 1, 8, 16)
    placed = [move(turn(bell, "z", -s * 35), s * radius * 0.62, radius * 0.95, depth * 0.5) for s in (1, -1)]
    return merge(placed)


def screen(rng) -> list[Piece]:
    """A television, monitor or tablet: a thin bezel, dark or lit, on a foot; flat or bent."""
    case = finishes.choose(rng, finishes.plastic, finishes.metal)
    lit = finishes.canvas(rng) if rng.random() < 0.5 else finishes.glass(rng)
    width = rng.uniform(0.4, 1.2)
    height, bend = width * rng.uniform(0.42, 0.65), rng.uniform(0, 0.08) * (rng.random() < 0.5)
    depth, bezel = rng.uniform(0.02, 0.05), rng.uniform(0.008, 0.03)
    place = np.linspace(-0.5, 0.5, 13)

    def bent(wide, tall, z):
        x, y = np.meshgrid(place * wide, [-tall / 2, tall / 2])
        texcoords = np.stack(np.meshgrid(place + 0.5, [1.0, 0.0]), axis=-1)
        return patch(np.stack([x, y, z + bend * (2 * x / width) ** 2], axis=-1), texcoords=texcoords)

    rings = [
        np.array([(x, -height / 2, z), (x, height / 2, z), (x, height / 2, z + depth), (x, -height / 2, z + depth)])
        for x, z in zip(place * width, bend * (2 * place) ** 2, strict=True)
    ]
    body = loft(rings)
    pieces = [(case, body), (lit, bent(width - 2 * bezel, height - 2 * bezel, depth + 0.001))]
    drop = height * rng.uniform(0.12, 0.3)
    neck = tube([(0, -height / 2 - drop, 0.0), (0, -height * 0.2, 0.0)], rng.uniform(0.015, 0.03))
    foot = cylinder(width * rng.uniform(0.14, 0.22), 0.015, 28, 0.004)
    if rng.random() < 0.5:
        foot = move(box((width * rng.uniform(0.3, 0.5), 0.015, 0.2), 0.005), y=0.007)
    return [*pieces, (case, merge([neck, move(foot, y=-height / 2 - drop - 0.01)]))]


def collage(rng) -> list[Piece]:
    """Several openings in one board, or a folding pair of frames."""
    border = border_finish(rng)
    if rng.random() < 0.4:
        width, height = rng.uniform(0.15, 0.3), rng.uniform(0.2, 0.4)
        half = framed_sheet(rng, border, content(rng), paper(rng), width, height)
        reach, angle = max(mesh.positions[:, 0].max() for _, mesh in half), rng.uniform(15, 40)
        image = content(rng)
        sheet_finish = half[-1][0]
        left = [(f, turn(move(mesh, x=-reach), "y", angle)) for f, mesh in half]
        right = [(image if f is sheet_finish else f, turn(move(mesh, x=reach), "y", -angle)) for f, mesh in half]
        return left + right
    columns, rows = int(rng.integers(2, 4)), int(rng.integers(1, 4))
    cell, gap, depth = rng.uniform(0.15, 0.3), rng.uniform(0.03, 0.06), 0.02
    tall = cell * rng.uniform(0.7, 1.4)
    width, height = columns * (cell + gap) + gap, rows * (tall + gap) + gap
    images = [content(rng) for _ in range(2)]
    pieces = [(border, move(box((width, height, depth), 0.004), z=depth / 2))]
    for i in range(columns):
        for j in range(rows):
            x, y = (i + 0.5) * (cell + gap) - (width - gap) / 2, (j + 0.5) * (tall + gap) - (height - gap) / 2
            lip = moulding(cell, tall, profile(rng, gap * 0.25, 0.012))
            pieces.append((border, move(lip, x, y, depth * 0.9)))
            pieces.append((images[(i + j) % 2], move(sheet(cell, tall, depth + 0.001), x, y)))
    return pieces


def easel(rng) -> list[Piece]:
    """A painting on a three-legged easel, or a standing mirror or board on feet."""
    wood, image = finishes.choose(rng, finishes.wood, finishes.metal, finishes.paint), content(rng)
    width, height = rng.uniform(0.35, 0.7), rng.uniform(0.4, 0.9)
    if rng.random() < 0.5:
        high, spread, lean = height + rng.uniform(0.4, 0.7), width * 0.55, rng.uniform(0.1, 0.2)
        bars = [tube([(s * spread, 0, 0.06), (s * 0.03, high, -lean)], 0.015, segments=8) for s in (1, -1)]
        bars.append(tube([(0, 0, -0.5), (0, high * 0.97, -lean)], 0.015, segments=8))
        level = rng.uniform(0.3, 0.45) * high
        slope = np.degrees(np.arctan2(lean + 0.06, high))
        depth = 0.06 - (lean + 0.06) * level / high
        bars.append(move(box((2 * spread, 0.03, 0.09), 0.005), y=level, z=depth + 0.02))
        block = merge([move(box((width, height, 0.03)), y=height / 2 + 0.01)])
        face = move(sheet(width * 0.995, height * 0.995, 0.016), y=height / 2 + 0.01)
        place = [(wood, block), (image, face)] if rng.random() < 0.3 else [(paper(rng), block), (image, face)]
        return [
            (wood, merge(bars)),
            *[(f, move(turn(m, "x", -slope), y=level + 0.01, z=depth + 0.025)) for f, m in place],
        ]
    pieces = framed_sheet(rng, wood, image, paper(rng), width, height * 1.6)
    low = min(mesh.positions[:, 1].min() for _, mesh in pieces)
    wide = max(mesh.positions[:, 0].max() for _, mesh in pieces)
    stand = four_legs(leg_style(rng, 0.02), 2 * wide + 0.02, 0.25, 0.12, 0.03)
    posts = [move(box((0.03, 0.2 + height, 0.03), 0.005), s * (wide + 0.01), (0.2 + height) / 2 + 0.1) for s in (1, -1)]
    feet = [move(box((0.04, 0.03, 0.3), 0.008), s * (wide + 0.01), 0.11) for s in (1, -1)]
    raised = [(f, move(mesh, y=-low + 0.14)) for f, mesh in pieces]
    return [*raised, (wood, merge([stand, *posts, *feet]))]


STYLES = {picture: 0.4, round_frame: 0.14, clock: 0.14, screen: 0.12, collage: 0.1, easel: 0.1}
