"""Aircraft: airliners, light aircraft, biplanes, fighters, gliders and helicopters. Fuselage about 1 long, nose +z."""

import numpy as np

from data_gen.procedural.aircraft_parts import (
    body_profile,
    cockpit,
    fuselage,
    gear,
    jet,
    landing,
    livery,
    propeller,
    surface,
    tail,
    windows,
)
from data_gen.procedural.joining import Piece
from data_gen.shapes import finishes
from data_gen.shapes.primitives import both_sides, box, cylinder, lathe, merge, move, superellipsoid, tube, turn


def plane(rng) -> list[Piece]:
    """Pieces of one aircraft."""
    style = rng.choice(
        [airliner, light_plane, biplane, fighter, glider, helicopter], p=[0.34, 0.22, 0.14, 0.12, 0.07, 0.11]
    )
    return style(rng)


def airliner(rng) -> list[Piece]:
    """A tube with swept wings and two to four jets, under the wings or at the tail."""
    skin, white = livery(rng), finishes.Finish(finishes.material(finishes.color(rng), rng.uniform(0.2, 0.5)))
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
        legs += [
            ((s * width * 0.5, low, front - root * 0.7), (s * width * 0.55, down, front - root * 0.7)) for s in (1, -1)
        ]
        tyres, struts = gear(rng, legs, 0.018)
        pieces += [(finishes.rubber(rng), tyres), (white, struts)]
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
    pieces.append(
        (wing_finish, tail(rng, -0.49, width * 0.2, rng.uniform(0.15, 0.2), rng.choice(["low", "cross", "t"])))
    )
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
    size = width * np.concatenate(
        [[0], np.interp(np.linspace(-0.495, 0.4, 10), [-0.5, 0.1, 0.4], [0.2, 1, 0.95]), [0.9, 0]]
    )
    pieces = [(skin, fuselage(z, size, size * 1.1, np.zeros_like(z)))]
    chord, span, front = rng.uniform(0.15, 0.2), rng.uniform(0.45, 0.6), rng.uniform(0.26, 0.32)
    stagger, count = rng.uniform(-0.02, 0.06), 3 if rng.random() < 0.2 else 2
    levels = np.linspace(-width * 0.45, -width * 0.45 + gap * (count - 1) * (0.7 if count == 3 else 1), count)
    wings = [
        surface(
            (0, y, front + stagger * i),
            (span * (0.92 + 0.08 * i), y + 0.015, front + stagger * i),
            (chord, chord * 0.9),
            0.1,
        )
        for i, y in enumerate(levels)
    ]
    pieces.append((wing_finish, both_sides(merge(wings))))
    struts = []
    for share, dz in ((0.75, 0.03), (0.75, 0.1), (0.1, 0.03), (0.1, 0.1)):
        y0 = levels[0] if share > 0.5 else 0.0
        struts.append(
            tube(
                [(span * share, y0, front - dz), (span * share, levels[-1] + 0.005, front + stagger - dz)],
                0.006,
                segments=8,
            )
        )
    pieces.append((trim, both_sides(merge(struts))))
    engine = [turn(cylinder(width * 0.52, 0.09, 24, 0.02), "x", 90)]
    pistons = int(rng.integers(5, 10))
    engine += [
        turn(move(cylinder(0.014, 0.03, 8), y=width * 0.5, z=0.05), "z", 360 / pistons * i) for i in range(pistons)
    ]
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
    size = width * np.concatenate(
        [[0], np.interp(np.linspace(-0.46, 0.48, 16), [-0.46, -0.3, 0.1, 0.5], [0.75, 1, 0.9, 0.06]), [0]]
    )
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
        store = turn(
            lathe(np.array([(0, 0), (0.7, 0.15), (1, 0.4), (1, 0.6), (0.6, 0.85), (0, 1)]) * (0.016, 0.22), 14), "x", 90
        )
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
    pieces.append(
        (wing_finish, both_sides(surface((0, width * 0.3, front), tip, (root, root * 0.4), 0.13, sections=5)))
    )
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
    runner = tube(
        [(x, down + 0.02, centre + long * 0.5), (x, down, centre + long * 0.4), (x, down, centre - long * 0.4)], 0.008
    )
    bars = [
        tube([(x, down, centre + dz), (width * 0.2, -tall * 0.35, centre + dz)], 0.007)
        for dz in (long * 0.2, -long * 0.2)
    ]
    return [*pieces, (metal, both_sides(merge([runner, *bars])))]
