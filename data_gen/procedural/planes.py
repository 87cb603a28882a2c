"""Aircraft: airliners, light aircraft, biplanes, fighters, gliders and helicopters. Fuselage about 1 long, nose +z."""

import numpy as np

from data_gen.procedural.parts import Piece, wheel
from data_gen.shapes import finishes, patterns
from data_gen.shapes.primitives import (
    Mesh,
    airfoil,
    both_sides,
    box,
    circle,
    cross,
    cylinder,
    lathe,
    loft,
    merge,
    move,
    patch,
    superellipsoid,
    tube,
    turn,
)


def fuselage(z, width, height, middle) -> Mesh:
    """Loft of ellipses (width, height) at z (n,), centred on height `middle`.

    Texture coordinates: u around from the belly, v from 0 at the nose to 1 at the tail.
    """
    segments = 28
    around = np.roll(circle(segments), segments // 4, axis=0)
    x, y = width[:, None] / 2 * around[:, 0], middle[:, None] + height[:, None] / 2 * around[:, 1]
    rings = np.stack([x, y, np.broadcast_to(z[:, None], (len(z), segments))], axis=-1)
    u = np.broadcast_to(np.arange(segments + 1) / segments, (len(z), segments + 1))
    v = np.broadcast_to(((z.max() - z) / np.ptp(z))[:, None], u.shape)
    return patch(rings, wrap_columns=True, texcoords=np.stack([u, v], axis=-1), crease=60)


def livery(rng) -> finishes.Finish:
    """Paint of a fuselage in its own texture coordinates: a colour and two of belly, line, bands, tail, nose."""
    u, v = patterns.grid()
    side = np.abs(u - 0.5) * 2 + 0 * v  # 1 at the belly, 0 along the back
    base, second, third = (finishes.color(rng) for _ in range(3))
    if rng.random() < 0.5:
        base = finishes.hsv(0.6, 0.03, rng.uniform(0.8, 0.97))
    picture = np.broadcast_to(base, (*side.shape, 3))
    for kind in rng.choice(["belly", "line", "tail", "bands", "nose", "sweep"], 2, replace=False):
        edge = rng.uniform(0.5, 0.75)
        weight = {
            "belly": patterns.step(side, edge),
            "line": patterns.step(0.05 - np.abs(side - edge), 0.0),
            "tail": patterns.step(v + 0 * u, rng.uniform(0.7, 0.85)),
            "bands": patterns.step(np.sin(v * rng.uniform(10, 40)) + 0 * u, 0.3, 0.1),
            "nose": patterns.step(-v + 0 * u, -rng.uniform(0.08, 0.2)),
            "sweep": patterns.step(v + 0.3 * side, rng.uniform(0.6, 0.9)),
        }[kind]
        picture = patterns.mix(picture, second if rng.random() < 0.6 else third, weight)
    return finishes.finish(picture, rng.uniform(0.15, 0.5))


def windows(picture_finish, rows, count) -> finishes.Finish:
    """The finish with a line of dark windows at each share of the way from back (0) to belly (1), on both sides."""
    u, v = patterns.grid()
    side = np.abs(u - 0.5) * 2
    cell = (v * count) % 1
    column = patterns.step(0.25 - np.abs(cell - 0.5), 0.0, 0.1) * (v > 0.12) * (v < 0.8)
    weight = sum(column * patterns.step(0.022 - np.abs(side - row), 0.0, 0.01) for row in rows)
    old = picture_finish.material
    picture = patterns.mix(old.base_color, np.full(3, 0.03), np.clip(weight, 0, 1))
    return finishes.finish(picture, old.roughness)


def surface(root, tip, chord, thickness, sections=2) -> Mesh:
    """Wing from a root to a tip point (leading edges), chords (root, tip) towards -z, closed at both ends."""
    root, tip = np.asarray(root, float), np.asarray(tip, float)
    outline = airfoil(9, thickness)
    span = tip - root
    up = cross(np.array([0, 0, 1.0]), span)
    up /= np.linalg.norm(up)
    rings = []
    for at in np.linspace(0, 1, sections):
        size = chord[0] + (chord[1] - chord[0]) * at
        rings.append(root + span * at - size * outline[:, :1] * (0, 0, 1.0) + size * outline[:, 1:] * up)
    return loft(rings)


def tail(rng, z, y, size, style) -> Mesh:
    """Fin and tailplane ahead of z = the end of the fuselage: "low", "cross", "t" or "twin"."""
    chord = size * rng.uniform(0.5, 0.7)
    high, back = size * rng.uniform(0.8, 1.1), size * rng.uniform(0.25, 0.6)
    lead = z + chord * 1.1
    fin = surface((0, y - 0.01, lead), (0, y + high, lead - back), (chord, chord * 0.5), 0.09)
    level = {"low": 0.1, "cross": 0.45, "t": 0.97, "twin": 0.1}[style]
    out = size * (rng.uniform(0.35, 0.55) if style == "twin" else rng.uniform(0.8, 1.2))
    front = lead - back * (level if style != "twin" else 0.1)
    top = y + high * level
    flat = surface((0, top, front), (out, top + 0.01, front - back * 0.6), (chord * 0.75, chord * 0.4), 0.09)
    if style != "twin":
        return merge([both_sides(flat), fin])
    low, tip = (out * 0.9, y - high * 0.2, front - 0.03), (out * 0.9, y + high * 0.8, front - back)
    return merge([both_sides(flat), both_sides(surface(low, tip, (chord * 0.7, chord * 0.4), 0.09))])


def propeller(rng, radius, blades) -> tuple[Mesh, Mesh]:
    """(blades, spinner) about the z axis, the tip of the spinner towards +z."""
    width = rng.uniform(0.12, 0.2) * radius
    blade = turn(move(superellipsoid((width, radius, 0.014), 0.6, 1, 8, 14), y=radius / 2), "y", 25)
    profile = [(0.16, 0), (0.155, 0.1), (0.11, 0.22), (0.0, 0.34)] * np.array([radius, radius])
    spinner = turn(lathe(profile, 16), "x", 90)
    return merge(turn(blade, "z", 360 / blades * i) for i in range(blades)), move(spinner, z=-0.008)


def jet(radius, long) -> tuple[Mesh, Mesh]:
    """(nacelle, dark intake and exhaust) about the z axis, front at z = 0."""
    outside = np.array(
        [(0.55, 0.0), (0.72, 0.12), (0.9, 0.4), (1.0, 0.7), (0.97, 0.92), (0.88, 1.0), (0.8, 0.95), (0.78, 0.85)]
    )
    pod = turn(lathe(outside * (radius, long), 24), "x", 90)
    inside = np.array([(0.5, -0.1), (0.5, 0.02), (0.76, 0.86), (0.2, 0.865), (0.0, 0.93)])
    fan = turn(lathe(inside * (radius, long), 20), "x", 90)
    return move(pod, z=-long), move(fan, z=-long)


def gear(rng, trim, legs, radius) -> list[Piece]:
    """A wheel at the foot of each leg (top point, ground point)."""
    tyre, rim = wheel(rng, radius, radius * 0.7)
    tyres, rest = [], []
    for top, foot in legs:
        hub = np.asarray(foot) + (0, radius, 0)
        tyres.append(move(tyre, *hub))
        rest += [move(rim, *hub), tube([hub, top], radius * 0.3, segments=8)]
        rest.append(move(box((radius * 0.9, radius * 0.4, radius * 0.4)), *hub))
    return [(finishes.rubber(rng), merge(tyres)), (trim, merge(rest))]


def body_profile(rng, nose, end, width):
    """(z, diameter, height of the axis) of a fuselage with a rounded nose and a rising tail of these lengths."""
    front = 0.5 - nose * (1 - np.cos(np.linspace(0, np.pi / 2, 9)))
    fat = np.sin(np.linspace(0, np.pi / 2, 9)) ** rng.uniform(0.75, 1.0)
    back = -0.5 + end * np.linspace(1, 0, 9)
    thin = 1 - (1 - rng.uniform(0.06, 0.2)) * np.linspace(0, 1, 9) ** rng.uniform(1.3, 2.2)
    z = np.concatenate([front, back, [back[-1] - 0.004]])[::-1]
    size = width * np.concatenate([fat, thin, [0]])[::-1]
    rise = width * 0.5 * np.concatenate([-(1 - fat) * 0.25, (1 - thin) * rng.uniform(0.3, 0.9), [0]])
    rise[-1] = rise[-2]
    return z, size, rise[::-1]


def cockpit(z, size, rise) -> Mesh:
    """A dark band over the nose of a fuselage."""
    places = np.linspace(0.86, 0.905, 4) - 0.5 + 0.045
    half = np.interp(places, z, size) / 2 * 1.015
    middle = np.interp(places, z, rise)
    angle = np.radians(np.linspace(28, 152, 15))
    x, y = half[:, None] * np.cos(angle), middle[:, None] + half[:, None] * np.sin(angle) * 1.02
    grid = np.stack(np.broadcast_arrays(x, y, places[:, None]), axis=-1)
    return patch(grid, crease=60)


def landing(rng, trim, width, front) -> list[Piece]:
    """Three wheels or two floats under a small aircraft."""
    down, x, place = -width * rng.uniform(1.0, 1.3), width * rng.uniform(0.7, 1.0), front - 0.1
    if rng.random() < 0.2:
        hull = superellipsoid((0.06, 0.06, 0.6), 0.7, 0.8, 10)
        bars = [
            tube([(x, down + 0.02, place + dz), (width * 0.2, -width * 0.35, place + dz)], 0.007) for dz in (0.1, -0.1)
        ]
        return [(trim, both_sides(merge([move(hull, x, down, place), *bars])))]
    legs = [((s * width * 0.25, -width * 0.35, place), (s * x, down, place)) for s in (1, -1)]
    nose, rear = ((0, -width * 0.3, 0.4), (0, down, 0.4)), ((0, 0.0, -0.42), (0, -width * 0.5, -0.44))
    legs.append(nose if rng.random() < 0.6 else rear)
    return gear(rng, trim, legs, rng.uniform(0.022, 0.032))


def airliner(rng) -> list[Piece]:
    """A tube with swept wings and two to four jets, under the wings or at the tail."""
    skin, white = livery(rng), finishes.finish(finishes.color(rng), rng.uniform(0.2, 0.5))
    accent, dark = finishes.car_paint(rng), finishes.glass(rng)
    width = rng.uniform(0.085, 0.15)
    z, size, rise = body_profile(rng, rng.uniform(0.1, 0.2), rng.uniform(0.3, 0.42), width)
    rows = (0.44,) if rng.random() < 0.75 else (0.34, 0.52)
    skin = windows(skin, rows, count=int(rng.integers(24, 48))) if rng.random() < 0.8 else skin
    pieces = [(skin, fuselage(z, size, size * rng.uniform(0.98, 1.12), rise))]
    low = -width * rng.uniform(0.2, 0.38)
    root, span, sweep = rng.uniform(0.2, 0.26), rng.uniform(0.38, 0.52), rng.uniform(0.16, 0.32)
    front, dihedral = rng.uniform(0.1, 0.2), rng.uniform(0.02, 0.08)
    tip = np.array([span, low + dihedral, front - sweep])
    pieces.append((white, both_sides(surface((0, low, front), tip, (root, root * 0.3), 0.1, sections=4))))
    if rng.random() < 0.5:
        winglet = surface(
            tip - (0.003, 0, 0), tip + (0.015, rng.uniform(0.03, 0.07), -0.05), (root * 0.3, root * 0.15), 0.09
        )
        pieces.append((accent, both_sides(winglet)))
    rear_jets = rng.random() < 0.25
    style = "t" if rear_jets else "low"
    pieces.append((accent, tail(rng, -0.49, width * 0.32, rng.uniform(0.15, 0.2), style)))
    radius, long = width * rng.uniform(0.22, 0.34), width * rng.uniform(1.0, 1.5)
    pod, fan = jet(radius, long)
    if rear_jets:
        places = [(width * 0.5 + radius * 0.85, width * 0.2, -0.22)]
        link = [(width * 0.5, width * 0.2, -0.22 - long * 0.5)]
    else:
        shares = (0.33,) if rng.random() < 0.6 else (0.3, 0.6)
        places = [(span * s, low + dihedral * s - radius * 1.15, front - sweep * s + long * 0.45) for s in shares]
        link = [(x, y + radius * 0.9, z_ - long * 0.6) for x, y, z_ in places]
    size_of = (radius * 2.4, radius * 0.2, long * 0.5) if rear_jets else (radius * 0.2, radius * 1.1, long * 0.7)
    pods = [move(pod, *place) for place in places] + [move(box(size_of), *place) for place in link]
    pieces += [(white if rng.random() < 0.5 else accent, both_sides(merge(pods)))]
    pieces.append((dark, both_sides(merge(move(fan, *place) for place in places))))
    pieces.append((dark, cockpit(z, size, rise)))
    if rng.random() < 0.5:
        down = low - radius * 3.2
        legs = [((0, -width * 0.4, 0.35), (0, down, 0.35))]
        place = front - root * 0.7
        legs += [((s * width * 0.5, low, place), (s * width * 0.55, down, place)) for s in (1, -1)]
        pieces += gear(rng, white, legs, 0.018)
    return pieces


def light_plane(rng) -> list[Piece]:
    """A propeller aircraft with a high or low wing and fixed gear; one or two engines, at times floats."""
    skin, wing_finish = livery(rng), finishes.car_paint(rng)
    dark, trim = finishes.glass(rng), finishes.choose(rng, finishes.metal, finishes.plastic)
    width = rng.uniform(0.13, 0.2)
    z, size, rise = body_profile(rng, rng.uniform(0.06, 0.14), rng.uniform(0.5, 0.62), width)
    tall = size * rng.uniform(1.0, 1.25)
    pieces = [(skin, fuselage(z, size, tall, rise))]
    high = rng.random() < 0.5
    level = width * (0.5 if high else -0.38)
    root, span, front = rng.uniform(0.17, 0.24), rng.uniform(0.5, 0.68), rng.uniform(0.2, 0.26)
    tip = (span, level + rng.uniform(0.0, 0.06), front - rng.uniform(0, 0.05))
    pieces.append((wing_finish, both_sides(surface((0, level, front), tip, (root, root * rng.uniform(0.5, 1)), 0.13))))
    if high:
        strut = tube([(width * 0.4, -width * 0.35, front - 0.08), (span * 0.55, level + 0.01, front - 0.08)], 0.006)
        pieces.append((trim, both_sides(strut)))
    canopy = superellipsoid((width * 0.82, width * 0.9, rng.uniform(0.22, 0.36)), 0.7, 0.7, 12)
    pieces.append((dark, move(canopy, y=width * 0.32, z=front - 0.07)))
    size_of = rng.uniform(0.15, 0.2)
    pieces.append((wing_finish, tail(rng, -0.49, width * 0.2, size_of, rng.choice(["low", "cross", "t"]))))
    reach, blades = rng.uniform(0.12, 0.16), int(rng.integers(2, 5))
    blade, spinner = propeller(rng, reach, blades)
    if rng.random() < 0.7:
        nose = rise[-1]
        pieces += [(trim, move(blade, y=nose, z=0.515)), (wing_finish, move(spinner, y=nose, z=0.495))]
    else:
        place = (span * 0.33, level + 0.005, front - 0.02)
        engine = superellipsoid((0.07, 0.08, 0.26), 0.8, 0.8, 10)
        pieces.append((wing_finish, both_sides(move(engine, *place))))
        pieces += [
            (finish, both_sides(move(mesh, place[0], place[1], place[2] + dz)))
            for finish, mesh, dz in ((trim, blade, 0.135), (skin, spinner, 0.115))
        ]
    return pieces + landing(rng, trim, width, front)


def biplane(rng) -> list[Piece]:
    """Two or three wings one above the other, with struts, an open seat and a round engine."""
    skin, wing_finish = livery(rng), finishes.choose(rng, finishes.paint, finishes.print_, finishes.fabric)
    trim = finishes.choose(rng, finishes.metal, finishes.wood)
    width, gap = rng.uniform(0.13, 0.18), rng.uniform(0.18, 0.26)
    z = np.concatenate([[-0.5], np.linspace(-0.495, 0.4, 10), [0.41, 0.41]])
    swell = np.interp(np.linspace(-0.495, 0.4, 10), [-0.5, 0.1, 0.4], [0.2, 1, 0.95])
    size = width * np.concatenate([[0], swell, [0.9, 0]])
    pieces = [(skin, fuselage(z, size, size * 1.1, np.zeros_like(z)))]
    chord, span, front = rng.uniform(0.15, 0.2), rng.uniform(0.45, 0.6), rng.uniform(0.26, 0.32)
    stagger, count = rng.uniform(-0.02, 0.06), 3 if rng.random() < 0.2 else 2
    levels = np.linspace(-width * 0.45, -width * 0.45 + gap * (count - 1) * (0.7 if count == 3 else 1), count)
    wings = []
    for i, y in enumerate(levels):
        lead = front + stagger * i
        wings.append(surface((0, y, lead), (span * (0.92 + 0.08 * i), y + 0.015, lead), (chord, chord * 0.9), 0.1))
    pieces.append((wing_finish, both_sides(merge(wings))))
    struts = []
    for share, dz in ((0.75, 0.03), (0.75, 0.1), (0.1, 0.03), (0.1, 0.1)):
        y0 = levels[0] if share > 0.5 else 0.0
        ends = [(span * share, y0, front - dz), (span * share, levels[-1] + 0.005, front + stagger - dz)]
        struts.append(tube(ends, 0.006, segments=8))
    pieces.append((trim, both_sides(merge(struts))))
    engine = [turn(cylinder(width * 0.52, 0.09, 24, 0.02), "x", 90)]
    pistons = int(rng.integers(5, 10))
    piston = move(cylinder(0.014, 0.03, 8), y=width * 0.5, z=0.05)
    engine += [turn(piston, "z", 360 / pistons * i) for i in range(pistons)]
    blade, spinner = propeller(rng, rng.uniform(0.14, 0.18), int(rng.integers(2, 4)))
    pieces.append((trim, merge([move(merge(engine), z=0.4), move(blade, z=0.515), move(spinner, z=0.48)])))
    pit = [move(superellipsoid((width * 0.6, 0.03, 0.12), 0.5, 1, 8), y=width * 0.48, z=zz) for zz in (0.05, -0.08)]
    head = move(superellipsoid((0.055, 0.07, 0.06), 1, 1, 8, 12), y=width * 0.6, z=0.03)
    pieces.append((finishes.choose(rng, finishes.leather), merge([*pit[: int(rng.integers(1, 3))], head])))
    pieces.append((wing_finish, tail(rng, -0.5, 0.01, rng.uniform(0.14, 0.18), "low")))
    return pieces + landing(rng, trim, width * 1.1, front + 0.04)


def fighter(rng) -> list[Piece]:
    """A jet with a pointed nose, a bubble canopy, delta or swept wings and one or two fins."""
    skin, paint = livery(rng), finishes.choose(rng, finishes.paint, finishes.metal, finishes.print_)
    paint = paint if rng.random() < 0.5 else finishes.car_paint(rng)
    dark, width = finishes.glass(rng), rng.uniform(0.09, 0.15)
    z = np.concatenate([[-0.46], np.linspace(-0.46, 0.48, 16), [0.5]])
    swell = np.interp(np.linspace(-0.46, 0.48, 16), [-0.46, -0.3, 0.1, 0.5], [0.75, 1, 0.9, 0.06])
    size = width * np.concatenate([[0], swell, [0]])
    pieces = [(skin, fuselage(z, size * rng.uniform(1, 1.4), size, np.zeros_like(z)))]
    root, span, front = rng.uniform(0.3, 0.5), rng.uniform(0.25, 0.38), rng.uniform(0.05, 0.15)
    tip_chord = root * rng.uniform(0.08, 0.45)
    tip = (span, rng.uniform(-0.04, 0.01), front - rng.uniform(0.4, 0.9) * (root - tip_chord) - 0.02)
    pieces.append((paint, both_sides(surface((0, -0.01, front), tip, (root, tip_chord), 0.05))))
    pieces.append((paint, tail(rng, -0.46, width * 0.3, rng.uniform(0.14, 0.19), rng.choice(["low", "twin"]))))
    canopy = superellipsoid((width * 0.6, width * 0.8, rng.uniform(0.16, 0.26)), 1, 1, 12)
    pieces.append((dark, move(canopy, y=width * 0.35, z=rng.uniform(0.15, 0.22))))
    nozzle = turn(lathe(np.array([(0.5, 0.01), (0.8, 0.0), (1, 0.05), (1, 0.1)]) * (width * 0.42, 0.8), 20), "x", 90)
    pieces.append((finishes.choose(rng, finishes.metal), move(nozzle, z=-0.5)))
    if rng.random() < 0.6:
        intake = both_sides(move(box((width * 0.4, width * 0.6, 0.3), 0.015, 3), width * 0.5, -width * 0.1, 0.0))
        pieces.append((paint, intake))
    if rng.random() < 0.6:
        profile = np.array([(0, 0), (0.7, 0.15), (1, 0.4), (1, 0.6), (0.6, 0.85), (0, 1)])
        store = turn(lathe(profile * (0.016, 0.22), 14), "x", 90)
        out = span * 0.55
        level, place = tip[1] * 0.55 - 0.03, front + (tip[2] - front) * 0.55 - tip_chord * 0.5
        racks = [move(store, out, level, place - 0.12), move(box((0.006, 0.035, 0.06)), out, level + 0.018, place)]
        pieces.append((dark if rng.random() < 0.3 else paint, both_sides(merge(racks))))
    return pieces


def glider(rng) -> list[Piece]:
    """A slender body under very long thin wings."""
    skin, wing_finish = livery(rng), finishes.car_paint(rng)
    width = rng.uniform(0.08, 0.11)
    z, size, rise = body_profile(rng, rng.uniform(0.18, 0.26), rng.uniform(0.6, 0.68), width)
    span, root, front = rng.uniform(0.7, 1.0), rng.uniform(0.1, 0.14), rng.uniform(0.1, 0.18)
    tip = (span, width * 0.3 + rng.uniform(0.03, 0.1), front - 0.04)
    pieces = [(skin, fuselage(z, size, size * 1.15, rise))]
    wing = surface((0, width * 0.3, front), tip, (root, root * 0.4), 0.13, sections=5)
    pieces.append((wing_finish, both_sides(wing)))
    pieces.append((wing_finish, tail(rng, -0.495, width * 0.22, rng.uniform(0.12, 0.16), rng.choice(["t", "low"]))))
    canopy = superellipsoid((width * 0.8, width * 0.8, 0.24), 1, 1, 12)
    return [*pieces, (finishes.glass(rng), move(canopy, y=width * 0.25, z=0.26))]


def helicopter(rng) -> list[Piece]:
    """A cabin with a tail boom, a rotor on a mast, a tail rotor and skids."""
    skin, second = finishes.car_paint(rng), finishes.car_paint(rng)
    dark, metal = finishes.glass(rng), finishes.choose(rng, finishes.metal, finishes.plastic)
    width, tall, long = rng.uniform(0.17, 0.24), rng.uniform(0.2, 0.27), rng.uniform(0.38, 0.5)
    cabin = superellipsoid((width, tall, long), rng.uniform(0.6, 1.0), rng.uniform(0.6, 0.9), 14, 28)
    centre = 0.5 - long / 2
    pieces = [(skin, move(cabin, z=centre))]
    screen = superellipsoid((width * 0.96, tall * 0.75, long * 0.62), 0.8, 0.8, 12, 24)
    pieces.append((dark, move(screen, y=tall * 0.06, z=0.5 - long * 0.3)))
    boom = tube([(0, tall * 0.15, centre), (0, tall * 0.25, -0.48)], [tall * 0.28, 0.022], segments=16)
    pieces.append((second, boom))
    fin = surface((0, tall * 0.2, -0.38), (0, tall * 0.2 + 0.16, -0.47), (0.1, 0.06), 0.12)
    flat = both_sides(surface((0, tall * 0.22, -0.33), (0.12, tall * 0.22, -0.35), (0.07, 0.05), 0.12))
    pieces.append((second, merge([fin, flat])))
    hub, reach, blades = tall * 0.5 + 0.07, rng.uniform(0.45, 0.62), int(rng.integers(2, 6))
    mast = move(cylinder(0.02, hub - tall * 0.3, 12), y=tall * 0.35, z=centre)
    hood = move(superellipsoid((width * 0.5, 0.09, long * 0.6), 0.7, 0.8, 10), y=tall * 0.47, z=centre)
    blade = move(box((0.045, 0.007, reach), 0.002), z=reach / 2)
    start = rng.uniform(0, 90)
    rotor = [move(turn(blade, "y", start + 360 / blades * i), y=hub, z=centre) for i in range(blades)]
    rotor.append(move(cylinder(0.03, 0.025, 16, 0.005), y=hub - 0.012, z=centre))
    small = [turn(move(box((0.008, 0.1, 0.018)), 0.026, 0.05), "x", 90 * i + 20) for i in range(4)]
    small.append(move(turn(cylinder(0.008, 0.03, 8), "z", -90), x=0.0))
    rotor.append(move(merge(small), y=tall * 0.2 + 0.1, z=-0.47))
    pieces += [(metal, merge([mast, *rotor])), (skin, hood)]
    down, x = -tall * 0.5 - 0.06, width * 0.5
    front, rear = (x, down, centre + long * 0.4), (x, down, centre - long * 0.4)
    runner = tube([(x, down + 0.02, centre + long * 0.5), front, rear], 0.008)
    places = (centre + long * 0.2, centre + -long * 0.2)
    bars = [tube([(x, down, place), (width * 0.2, -tall * 0.35, place)], 0.007) for place in places]
    return [*pieces, (metal, both_sides(merge([runner, *bars])))]


STYLES = {airliner: 0.34, light_plane: 0.22, biplane: 0.14, fighter: 0.12, glider: 0.07, helicopter: 0.11}
