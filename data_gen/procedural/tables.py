"""Tables: dining, coffee and side tables, desks; tops of every outline on legs, columns, trestles or panels."""

import numpy as np

from data_gen.procedural.parts import Piece, four_legs, leg_style, pedestal, round_legs, stretchers
from data_gen.procedural.shelves import drawer_stack
from data_gen.shapes import finishes
from data_gen.shapes.primitives import Mesh, box, merge, move, prism, rounded_rectangle, superellipse, tube, turn


def table(rng) -> list[Piece]:
    """Pieces of one table."""
    stiff = (finishes.wood, finishes.wood, finishes.stone, finishes.paint, finishes.glass, finishes.print_)
    top = finishes.choose(rng, *stiff)
    body = top if rng.random() < 0.4 else finishes.choose(rng, finishes.wood, finishes.metal, finishes.paint)
    base = rng.choice(
        [legs_base, column_base, trestle_base, panel_base, hairpin_base, desk_base],
        p=[0.35, 0.18, 0.13, 0.1, 0.1, 0.14],
    )
    height = rng.choice([rng.uniform(0.35, 0.5), rng.uniform(0.68, 0.8), rng.uniform(0.85, 1.1)], p=[0.35, 0.55, 0.1])
    width = rng.uniform(0.45, 1.0) if base is column_base else rng.uniform(0.5, 1.9)
    depth = width * rng.uniform(0.8, 1) if base is column_base else rng.uniform(0.4, 0.95) * min(width, 1.1)
    thick = rng.uniform(0.015, 0.06)
    slab, reach = table_top(rng, width, depth, thick, square=base in (panel_base, desk_base))
    under = base(rng, top, body, width * reach, depth * reach, height - thick * 0.9)
    return [(top, move(slab, y=height - thick / 2)), *under]


def table_top(rng, width, depth, thick, square) -> tuple[Mesh, float]:
    """(slab about 0, share of its size that a rectangle under it may have): rectangle, superellipse, round, barrel."""
    edge = thick * rng.uniform(0.05, 0.45)
    if square or rng.random() < 0.35:
        return box((width, thick, depth), edge, int(rng.choice([1, 3]))), 0.98
    exponent = rng.choice([0.1, 0.3, 0.55, 1.0])
    outline = superellipse(44, exponent, (width / 2, depth / 2))
    outline *= 1 + rng.uniform(0, 0.08) * np.cos(2 * np.arctan2(outline[:, 1], outline[:, 0]))[:, None]
    return turn(prism(outline, thick, edge), "x", -90), 0.5 ** (exponent / 2)


def legs_base(rng, top, body, width, depth, height) -> list[Piece]:
    """Three or four legs, with an apron, rails, drawers or a lower shelf."""
    radius = rng.uniform(0.016, 0.045)
    leg = leg_style(rng, radius)
    inset = rng.uniform(0.75, 0.98)
    x, z = width * inset - 2 * radius, depth * inset - 2 * radius
    if rng.random() < 0.15:
        return [(body, round_legs(leg, 3, 0.3 * min(width, depth), height, rng.uniform(0, 0.15)))]
    splay = rng.uniform(0, 0.08) * (rng.random() < 0.5)
    pieces = [(body, four_legs(leg, x, z, height, splay))]
    if rng.random() < 0.65:
        tall = rng.uniform(0.04, 0.12)
        sides = [move(box((x, tall, 0.02)), y=height - tall / 2, z=s * z / 2) for s in (1, -1)]
        ends = [move(box((0.02, tall, z)), s * x / 2, height - tall / 2) for s in (1, -1)]
        pieces.append((body, merge(sides + ends)))
        if tall > 0.08 and rng.random() < 0.6:
            count = max(1, round(x / 0.5))
            front = box((x / count * 0.85, tall * 0.75, 0.02), 0.004)
            places = [x * ((i + 0.5) / count - 0.5) for i in range(count)]
            pieces.append((top, merge(move(front, place, height - tall / 2, z / 2 + 0.012) for place in places)))
    if rng.random() < 0.35:
        level = rng.uniform(0.15, 0.4)
        reach = 2 * splay * (1 - level)
        if rng.random() < 0.5:
            pieces.append((top, move(box((x + reach, 0.02, z + reach), 0.004), y=height * level)))
        else:
            rails = stretchers(x + reach, z + reach, height * level, radius * 0.5, rng.choice(["ring", "h", "cross"]))
            pieces.append((body, rails))
    return pieces


def column_base(rng, top, body, width, depth, height) -> list[Piece]:
    """One column on a foot."""
    return [(body, pedestal(rng, height, rng.uniform(0.025, 0.08), min(width, depth) * rng.uniform(0.3, 0.45)))]


def trestle_base(rng, top, body, width, depth, height) -> list[Piece]:
    """Two A, X or T frames joined by a beam."""
    style, thick = rng.choice(["a", "x", "t"]), rng.uniform(0.03, 0.07)
    half, place = depth * rng.uniform(0.32, 0.45), width * rng.uniform(0.28, 0.42)

    def beam(start, end):
        return tube([(0, *start), (0, *end)], thick / 2, section=rounded_rectangle(2, 2))

    if style == "t":
        foot = box((thick, 0.05, 2 * half), 0.012)
        parts = [beam((0.02, 0), (height, 0)), move(foot, y=0.025), move(foot, y=height - 0.025)]
    else:
        inner = 0.1 * half if style == "a" else -half
        parts = [beam((0.0, s * half), (height - 0.01, s * inner)) for s in (1, -1)]
        parts.append(move(box((thick, 0.04, 2 * max(inner, half * 0.8))), y=height - 0.02))
    level = height * (0.5 if style == "x" else rng.uniform(0.25, 0.9))
    pieces = [move(merge(parts), x=s * place) for s in (1, -1)]
    if style == "a":  # the beam needs something to hold it between the legs
        width_there = 2 * (half + (inner - half) * level / height)
        pieces += [move(box((thick * 0.6, 0.04, width_there)), s * place, level) for s in (1, -1)]
    pieces.append(move(box((2 * place, 0.05, thick)), y=level))
    return [(body, merge(pieces))]


def panel_base(rng, top, body, width, depth, height) -> list[Piece]:
    """Two solid sides and a back or a lower shelf."""
    thick, place = rng.uniform(0.02, 0.06), width * rng.uniform(0.38, 0.48)
    pieces = [(body, move(box((thick, height, depth * 0.96), 0.003), s * place, height / 2)) for s in (1, -1)]
    if rng.random() < 0.5:
        tall = height * rng.uniform(0.2, 0.7)
        pieces.append((body, move(box((2 * place, tall, 0.02)), y=height - tall / 2, z=-depth * 0.3)))
    else:
        pieces.append((top, move(box((2 * place, 0.025, depth * 0.9)), y=height * rng.uniform(0.2, 0.6))))
    return pieces


def hairpin_base(rng, top, body, width, depth, height) -> list[Piece]:
    """Bent rods: hairpins at the corners or two loops."""
    rod, x, z = rng.uniform(0.006, 0.014), width * 0.42, depth * 0.4
    spread, meshes = rng.uniform(0.05, 0.12), []
    if rng.random() < 0.5:
        for sx in (1, -1):
            for sz in (1, -1):
                foot = (sx * x, rod, sz * z)
                ends = [(sx * (x - spread), height, sz * z), (sx * x, height, sz * (z - spread))]
                meshes += [tube([foot, end], rod, segments=8) for end in ends]
    else:
        drop = rng.uniform(0.6, 0.95)
        for s in (1, -1):
            corners = [(s * x, height, -z), (s * x * drop, rod, -z), (s * x * drop, rod, z), (s * x, height, z)]
            meshes += [tube(np.stack(pair), rod, segments=8) for pair in zip(corners[:-1], corners[1:], strict=True)]
        meshes.append(tube([(-x, height - rod, 0), (x, height - rod, 0)], rod, segments=8))
    return [(body, merge(meshes))]


def desk_base(rng, top, body, width, depth, height) -> list[Piece]:
    """A stack of drawers on one side or both, legs or a panel on the other, a modesty panel behind."""
    fronts = finishes.choose(rng, finishes.wood, finishes.paint) if rng.random() < 0.5 else body
    stack, deep = rng.uniform(0.22, 0.32) * width, depth * 0.94
    sides = (1, -1) if rng.random() < 0.4 else (int(rng.choice([1, -1])),)
    count, pieces = int(rng.integers(2, 5)), []
    shape = rng.integers(1 << 30)
    for s in sides:
        place = s * (width / 2 * 0.97 - stack / 2)
        drawers = drawer_stack(np.random.default_rng(shape), body, fronts, stack, height, deep, count)
        pieces += [(finish, move(mesh, x=place)) for finish, mesh in drawers]
    if len(sides) == 1:
        side = move(box((0.03, height, deep)), -sides[0] * (width / 2 * 0.95), height / 2)
        pieces.append((body, side))
    back = height * rng.uniform(0.3, 0.8)
    pieces.append((body, move(box((width * 0.94, back, 0.02)), y=height - back / 2, z=-deep / 2 + 0.02)))
    return pieces
