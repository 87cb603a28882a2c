"""Cars: saloons, coupes, hatchbacks, estates, vans, buses, pick-ups, trucks, racers and toys. Length about 1, front +z.

A body is one loft along the car: level bottom with wheel arches cut into it, sides that tumble home, a deck whose
height is the bonnet, belt and boot line. The cabin is a second, narrower loft of glass, with roof and pillars on it.
"""

import numpy as np

from data_gen.procedural.parts import Piece, wheel
from data_gen.shapes import finishes
from data_gen.shapes.primitives import (
    Mesh,
    both_sides,
    box,
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

# Fractions of the length, from the tail (0) to the nose (1): rear glass foot, roof start, roof end, windscreen foot.
CABINS = {
    "saloon": ((0.14, 0.24), (0.28, 0.36), (0.55, 0.6), (0.68, 0.75)),
    "coupe": ((0.04, 0.14), (0.32, 0.42), (0.52, 0.58), (0.68, 0.76)),
    "hatch": ((0.02, 0.05), (0.08, 0.2), (0.56, 0.62), (0.7, 0.78)),
    "estate": ((0.02, 0.04), (0.05, 0.1), (0.56, 0.62), (0.69, 0.76)),
    "van": ((0.015, 0.03), (0.03, 0.06), (0.74, 0.84), (0.86, 0.95)),
    "bus": ((0.012, 0.02), (0.02, 0.04), (0.93, 0.96), (0.965, 0.985)),
    "pickup": ((0.4, 0.44), (0.44, 0.48), (0.6, 0.64), (0.7, 0.77)),
    "truck": ((0.66, 0.7), (0.68, 0.72), (0.86, 0.9), (0.93, 0.97)),
}


def car(rng) -> list[Piece]:
    """Pieces of one car."""
    style = rng.choice([*CABINS, "racer"], p=[0.18, 0.15, 0.14, 0.12, 0.1, 0.06, 0.08, 0.1, 0.07])
    return racer(rng) if style == "racer" else road_car(rng, style)


def arch_line(z, axles, radius, low):
    """Lower edge of the side at z (n,): level, lifted to a circle above each axle."""
    line = np.full_like(z, low)
    for axle in axles:
        inside = np.abs(z - axle) < radius
        arch = np.sqrt(np.maximum(radius**2 - (z - axle) ** 2, 0)) + radius * 0.85
        line = np.where(inside, np.maximum(line, arch), line)
    return line


def stations(axles, radius) -> np.ndarray:
    """(n,) places along the car to loft through: even, and close together around the wheel arches."""
    around = [axle + radius * np.concatenate([np.cos(np.linspace(0, np.pi, 9)), [-1.06, 1.06]]) for axle in axles]
    even = np.concatenate([[-0.5, -0.495, -0.485, -0.465, 0.465, 0.485, 0.495, 0.5], np.linspace(-0.44, 0.44, 12)])
    even = even[np.all([np.abs(even - axle) > radius * 1.1 for axle in axles], axis=0)]
    return np.sort(np.concatenate([even, *around]))


def body_shell(z, low, deck, half, sill, waist) -> Mesh:
    """Loft of a car body: lower edge, deck height and half width at each z (n,); widest at the `waist` height."""
    rings = []
    for place, bottom, top, wide in zip(z, low, deck, half, strict=True):
        top = max(top, bottom + 0.004)
        y = np.maximum(sill + (top - sill) * np.array([0, 0.15, 0.35, 0.55, 0.75, 0.88, 0.96]), bottom)
        x = wide * (1 - 0.1 * ((y - waist) / (waist - sill + 1e-3)) ** 2)
        x[-1] -= wide * 0.03
        crown = np.array([0.85, 0.45, 0.0])
        right = np.column_stack([np.concatenate([x, crown * x[-1]]), np.concatenate([y, top + 0.006 * (1 - crown**2)])])
        left = right[-2::-1] * (-1, 1)
        outline = np.concatenate([right, left])
        rings.append(np.column_stack([outline, np.full(len(outline), place)]))
    return loft(rings)


def road_car(rng, style) -> list[Piece]:
    """A car with a cabin of the given style."""
    tall_kind = style in ("van", "bus", "truck")
    paint = finishes.car_paint(rng) if rng.random() < 0.85 else finishes.choose(rng, finishes.print_)
    second = paint if style in ("truck", "pickup") or rng.random() < 0.7 else finishes.car_paint(rng)
    glass, rubber = finishes.glass(rng), finishes.rubber(rng)
    trim = finishes.choose(rng, finishes.metal, finishes.plastic)
    chubby = rng.uniform(1.0, 1.5) if rng.random() < 0.25 else 1.0  # toys are short, high and wide
    radius = rng.uniform(0.066, 0.085) * chubby * (rng.uniform(1.2, 1.8) if rng.random() < 0.08 else 1)
    half = rng.uniform(0.185, 0.21) * chubby
    lift = rng.uniform(0.0, 0.04)
    sill = radius * rng.uniform(0.5, 0.8) + lift
    belt = sill + rng.uniform(0.1, 0.14) * chubby + (0.03 if tall_kind else 0)
    high = belt + rng.uniform(0.075, 0.115) * chubby + {"van": 0.07, "bus": 0.1, "truck": 0.08}.get(style, 0)
    axles = (-0.5 + rng.uniform(0.17, 0.22), 0.5 - rng.uniform(0.15, 0.2))
    foot = [rng.uniform(*span) - 0.5 for span in CABINS[style]]

    arch = radius * rng.uniform(1.1, 1.2)
    z = stations(axles, arch)
    low = np.maximum(arch_line(z, axles, arch, sill), sill)
    deck = deck_line(rng, style, z, foot, sill, belt)
    ends = np.abs(2 * z)
    width = 1 - rng.uniform(0.05, 0.18) * ends**4 - rng.uniform(0.02, 0.08) * np.maximum(ends - 0.93, 0) / 0.07
    width = half * width
    pieces = [(paint, body_shell(z, low, deck, width, sill, sill + (belt - sill) * 0.5))]
    under = box((2 * half * 0.72, (belt - sill) * 0.55, 0.94))
    pieces.append((rubber, move(under, y=sill + (belt - sill) * 0.3)))
    pieces += cabin(rng, second, glass, half, belt, high, foot, style)
    pieces += fittings(rng, trim, half, sill, belt, axles)
    pieces += wheels(rng, rubber, trim, radius, half, axles, thick=rng.uniform(0.05, 0.075) * chubby)
    if style in ("truck", "pickup"):
        pieces += load(rng, style, second, trim, half, sill, belt, foot)
    if rng.random() < 0.12 and style in ("saloon", "estate", "van", "hatch"):
        sign = move(box((half * rng.uniform(0.5, 1.2), 0.025, 0.04), 0.006), y=high + 0.012, z=(foot[1] + foot[2]) / 2)
        pieces.append((trim, sign))
    if rng.random() < 0.15 and style in ("coupe", "saloon", "hatch"):
        wing = [move(box((2 * half * 0.9, 0.008, 0.05), 0.002), y=belt + 0.045, z=-0.46)]
        wing += [move(box((0.01, 0.06, 0.03)), s * half * 0.6, belt + 0.018, -0.46) for s in (1, -1)]
        pieces.append((second, merge(wing)))
    return pieces


def deck_line(rng, style, z, foot, sill, belt):
    """Height of the deck at z (n,): boot, belt and bonnet with rounded ends."""
    nose = rng.uniform(0.55, 0.9) if style not in ("van", "bus", "truck") else rng.uniform(0.85, 1.0)
    tail = rng.uniform(0.75, 0.98)
    bonnet = belt - (belt - sill) * (1 - nose) * np.clip((z - foot[3]) / max(0.5 - foot[3], 1e-3), 0, 1) ** rng.uniform(
        1, 2.5
    )
    boot = (belt - sill) * (1 - tail) * np.clip((foot[0] - z) / max(foot[0] + 0.5, 1e-3), 0, 1) ** 2
    line = bonnet - boot
    if style == "truck":
        line = np.where(z < foot[0] - 0.02, sill + (belt - sill) * 0.45, line)
    end = np.maximum(np.abs(z) - 0.465, 0) / 0.035
    return line - (line - sill) * rng.uniform(0.12, 0.35) * end**2.5


def cabin(rng, paint, glass, half, belt, high, foot, style) -> list[Piece]:
    """Glass house, roof and pillars."""
    tumble = rng.uniform(0.72, 0.85) if style not in ("van", "bus", "truck") else rng.uniform(0.88, 0.96)
    base, top = half * 0.93, half * tumble
    corner = rng.uniform(0.02, 0.05)

    def ring(wide, rear, front, y):
        outline = rounded_rectangle(2 * wide, front - rear, corner, 3)
        return np.column_stack([outline[:, 0], np.full(len(outline), y), (rear + front) / 2 - outline[:, 1]])

    def at(t, grow=0.0):  # ring at a fraction of the height of the glass
        return ring(
            base + (top - base) * t + grow,
            foot[0] + (foot[1] - foot[0]) * t - grow,
            foot[3] + (foot[2] - foot[3]) * t + grow,
            belt - 0.015 + (high - belt + 0.015) * t,
        )

    house = loft([at(0.0), at(0.5), at(0.92)])
    crown = [at(0.9, 0.004), at(0.97, 0.002), at(1.0, -0.006)]
    crown.append(at(1.0, -0.03) + (0, 0.006, 0))
    pieces = [(glass, house), (paint, loft(crown))]
    lines = [at(0.0, 0.002), at(0.5, 0.002), at(0.92, 0.002)]
    count = len(lines[0])
    posts = [
        tube(np.array([line[i] for line in lines]), 0.007, segments=6)
        for i in (count // 8, 3 * count // 8, 5 * count // 8, 7 * count // 8)
    ]
    places = {"bus": np.linspace(-0.35, 0.4, 6).tolist(), "van": [0.2, 0.55], "truck": []}.get(style, [0.42])
    low, up = at(0.0), at(0.92)
    for share in places:
        a, b = (line[:, 2].min() * (1 - share) + line[:, 2].max() * share for line in (low, up))
        a, b = (share, share) if style == "bus" else (a, b)
        ends = [(low[:, 0].max() * 0.995, low[0, 1], a), (up[:, 0].max() * 0.995, up[0, 1], b)]
        posts.append(both_sides(tube(ends, 0.007, segments=6)))
    if style == "van" and rng.random() < 0.7:  # closed sides
        span = (foot[1] + 0.02, foot[1] + (foot[2] - foot[1]) * 0.55)
        panel = box((2 * half * 0.95, (high - belt) * 0.95, span[1] - span[0]), 0.01, 3)
        posts.append(move(panel, y=(belt + high) / 2 - 0.005, z=sum(span) / 2))
    return [*pieces, (paint, merge(posts))]


def fittings(rng, trim, half, sill, belt, axles) -> list[Piece]:
    """Bumpers, lamps, a grille, mirrors and side strips."""
    tall = belt - sill
    bar = box((2 * half * 0.9, tall * 0.2, 0.04), 0.006, 3)
    bumper = [move(bar, y=sill + tall * 0.16, z=s * 0.488) for s in (1, -1)]
    level, place = sill + tall * rng.uniform(0.42, 0.58), half * rng.uniform(0.55, 0.66)
    size = rng.uniform(0.02, 0.035)
    if rng.random() < 0.5:
        lights = superellipsoid((2.2 * size, size, 0.05), 0.4, 0.4, 8, 14)
    else:
        lights = superellipsoid((1.5 * size, 1.5 * size, 0.05), 1, 1, 8, 14)
    head = move(lights._replace(texcoords=np.full_like(lights.texcoords, 0.25)), place, level, 0.47)
    tail = move(lights._replace(texcoords=np.full_like(lights.texcoords, 0.75)), place, level + 0.005, -0.475)
    grille = box((half * rng.uniform(0.6, 1.1), tall * rng.uniform(0.12, 0.3), 0.03), 0.004)
    grille = move(grille, y=level - 0.005, z=0.485)
    mirror_ = move(box((0.03, 0.02, 0.014), 0.005), half * 0.98, belt + 0.008, axles[1] - 0.1)
    stalk = move(box((0.05, 0.008, 0.01)), half * 0.93, belt, axles[1] - 0.1)
    metal = merge([*bumper, grille, both_sides(merge([mirror_, stalk]))])
    return [(trim, metal), (lamp_glass(), both_sides(merge([head, tail])))]


def lamp_glass() -> finishes.Finish:
    """Head lamps at texture coordinate 0.25, tail lamps at 0.75: white and red in one material."""
    picture = np.repeat([[(0.85, 0.85, 0.85), (0.6, 0.03, 0.02)]], 8, axis=1).repeat(16, axis=0)
    return finishes.finish(picture, 0.12)


def wheels(rng, rubber, trim, radius, half, axles, thick) -> list[Piece]:
    """Four wheels on their axles."""
    tyre, rim = wheel(rng, radius, thick)
    out = half - thick * rng.uniform(0.35, 0.5)
    shafts = [move(turn(cylinder(radius * 0.2, 2 * out, 10), "z", 90), x=out, y=radius, z=axle) for axle in axles]
    pieces = [(trim, merge(shafts))]
    for axle in axles:
        place = (out, radius, axle)
        pieces += [(rubber, both_sides(move(tyre, *place))), (trim, both_sides(move(rim, *place)))]
    return pieces


def load(rng, style, paint, trim, half, sill, belt, foot) -> list[Piece]:
    """What stands behind the cab: an open bed, a box, a tank or a flat bed."""
    rear, front = -0.49, foot[0] - 0.01
    middle, long = (rear + front) / 2, front - rear
    if style == "pickup":
        rail = [move(box((0.02, 0.03, long), 0.004), s * half * 0.88, belt + 0.01, middle) for s in (1, -1)]
        rail += [move(box((2 * half * 0.88, 0.03, 0.02), 0.004), y=belt + 0.01, z=rear + 0.01)]
        bed = [(trim, move(box((2 * half * 0.84, 0.01, long * 0.97)), y=belt - 0.002, z=middle)), (paint, merge(rail))]
        if rng.random() < 0.4:
            goods = finishes.choose(rng, finishes.wood, finishes.print_, finishes.fabric)
            bed.append((goods, move(box((half * 1.2, 0.06, long * 0.6), 0.01), y=belt + 0.032, z=middle)))
        return bed
    floor = sill + (belt - sill) * 0.45
    kind = rng.choice(["box", "tank", "flat", "tipper"])
    goods = finishes.choose(rng, finishes.paint, finishes.metal, finishes.print_)
    deck = move(box((2 * half, 0.02, long), 0.004), y=floor + 0.005, z=middle)
    if kind == "box":
        tall = rng.uniform(0.2, 0.34)
        cargo = box((2 * half * 1.02, tall, long * 0.97), 0.008)
        return [(trim, deck), (goods, move(cargo, y=floor + 0.01 + tall / 2, z=middle))]
    if kind == "tank":
        profile = np.array([(0.5, 0), (0.9, 0.03), (1, 0.1), (1, 0.9), (0.9, 0.97), (0.5, 1.0)])
        tank = lathe(profile * (half * 0.85, long * 0.95), 28)
        return [(trim, deck), (goods, move(turn(tank, "x", 90), y=floor + half * 0.84, z=rear + 0.01))]
    if kind == "tipper":
        sides = [move(box((0.015, 0.12, long * 0.95)), s * half * 0.95, floor + 0.07, middle) for s in (1, -1)]
        board = box((2 * half * 0.95, 0.12, 0.015))
        sides += [move(board, y=floor + 0.07, z=middle + s * long * 0.47) for s in (1, -1)]
        heap = superellipsoid((2 * half * 0.9, 0.16, long * 0.9), 1, 0.5, 8)
        heap = move(heap, y=floor + 0.08, z=middle)
        return [(trim, merge([deck, *sides])), (finishes.choose(rng, finishes.stone), heap)]
    logs = [
        move(turn(cylinder(0.03, long * 0.9, 12), "x", 90), x, floor + 0.044 + y, rear + 0.02)
        for y, row in ((0, (-0.1, -0.04, 0.02, 0.08)), (0.05, (-0.07, -0.01, 0.05)))
        for x in row
    ]
    return [(trim, deck), (finishes.choose(rng, finishes.wood, finishes.metal), merge(logs))]


def racer(rng) -> list[Piece]:
    """An open racing car: slim body, four free wheels, wings front and rear."""
    paint, trim = finishes.car_paint(rng), finishes.choose(rng, finishes.metal, finishes.plastic)
    rubber = finishes.rubber(rng)
    second = finishes.car_paint(rng)
    radius, half, clear = rng.uniform(0.07, 0.1), rng.uniform(0.18, 0.22), rng.uniform(0.03, 0.05)
    z = np.linspace(-0.46, 0.5, 22)
    wide = np.interp(
        z, [-0.46, -0.25, 0.05, 0.25, 0.5], [0.05, rng.uniform(0.08, 0.12), rng.uniform(0.08, 0.12), 0.05, 0.02]
    )
    tall = np.interp(z, [-0.46, -0.2, 0.0, 0.2, 0.5], [0.06, rng.uniform(0.11, 0.15), 0.12, 0.09, 0.03])
    shape = superellipse(24, rng.uniform(0.5, 0.9))
    rings = [
        np.column_stack([shape[:, 0] * w, clear + t / 2 + shape[:, 1] * t / 2, np.full(24, p)])
        for p, w, t in zip(z, wide, tall, strict=True)
    ]
    pods = both_sides(move(superellipsoid((0.1, 0.08, 0.34), 0.5, 0.4, 8), 0.1, clear + 0.05, -0.08))
    helmet = move(superellipsoid((0.07, 0.08, 0.08), 1, 1, 10, 16), y=clear + 0.15, z=-0.02)
    floor = move(box((half * 1.1, 0.012, 0.8), 0.004), y=clear + 0.006)
    wing = [move(box((2 * half * 0.95, 0.008, 0.09), 0.003), y=clear + 0.02, z=0.46)]
    wing += [move(box((2 * half * 0.8, 0.008, 0.08), 0.003), y=clear + rng.uniform(0.17, 0.22), z=-0.44)]
    wing += [move(box((0.008, 0.2, 0.07)), s * half * 0.5, clear + 0.11, -0.43) for s in (1, -1)]
    pieces = [(paint, loft(rings)), (second, pods), (finishes.glass(rng), helmet), (trim, floor), (second, merge(wing))]
    return pieces + wheels(rng, rubber, trim, radius, half, (-0.34, 0.3), thick=rng.uniform(0.08, 0.11))
