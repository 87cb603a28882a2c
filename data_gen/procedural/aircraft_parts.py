"""What aircraft are put together from: fuselages and their paint, wings, tails, propellers, jets and gear.

The fuselage is about 1 long, its nose at z = 0.5.
"""

import numpy as np

from data_gen.procedural.joining import Piece
from data_gen.procedural.wheels import wheel
from data_gen.shapes import finishes, patterns
from data_gen.shapes.outlines import airfoil, circle
from data_gen.shapes.primitives import (
    Mesh,
    both_sides,
    box,
    cross,
    lathe,
    loft,
    merge,
    move,
    patch,
    superellipsoid,
    tube,
    turn,
)


def fuselage(z, width, height, middle, segments=28) -> Mesh:
    """Loft of ellipses (width, height) at z (n,), centred on height `middle`.

    Texture coordinates: u around from the belly, v from 0 at the nose to 1 at the tail.
    """
    around = np.roll(circle(segments), segments // 4, axis=0)
    rings = np.stack(
        [
            width[:, None] / 2 * around[:, 0],
            middle[:, None] + height[:, None] / 2 * around[:, 1],
            np.broadcast_to(z[:, None], (len(z), segments)),
        ],
        axis=-1,
    )
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
    return finishes.Finish(finishes.material(picture, rng.uniform(0.15, 0.5), 0.0))


def windows(picture_finish, rows=(0.44,), start=0.12, end=0.8, count=40) -> finishes.Finish:
    """The finish with a line of dark windows at each share of the way from back (0) to belly (1), on both sides."""
    u, v = patterns.grid()
    side = np.abs(u - 0.5) * 2
    cell = (v * count) % 1
    column = patterns.step(0.25 - np.abs(cell - 0.5), 0.0, 0.1) * (v > start) * (v < end)
    weight = sum(column * patterns.step(0.022 - np.abs(side - row), 0.0, 0.01) for row in rows)
    old = picture_finish.material
    picture = patterns.mix(old.base_color, np.full(3, 0.03), np.clip(weight, 0, 1))
    return finishes.Finish(finishes.material(picture, old.roughness))


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
    flat = surface(
        (0, y + high * level, front),
        (out, y + high * level + 0.01, front - back * 0.6),
        (chord * 0.75, chord * 0.4),
        0.09,
    )
    meshes = [both_sides(flat)]
    if style == "twin":
        meshes.append(
            both_sides(
                surface(
                    (out * 0.9, y - high * 0.2, front - 0.03),
                    (out * 0.9, y + high * 0.8, front - back),
                    (chord * 0.7, chord * 0.4),
                    0.09,
                )
            )
        )
    else:
        meshes.append(fin)
    return merge(meshes)


def propeller(rng, radius, blades) -> tuple[Mesh, Mesh]:
    """(blades, spinner) about the z axis, the tip of the spinner towards +z."""
    width = rng.uniform(0.12, 0.2) * radius
    blade = turn(move(superellipsoid((width, radius, 0.014), 0.6, 1, 8, 14), y=radius / 2), "y", 25)
    spinner = turn(
        lathe([(0.16, 0), (0.155, 0.1), (0.11, 0.22), (0.0, 0.34)] * np.array([radius, radius]), 16), "x", 90
    )
    return merge(turn(blade, "z", 360 / blades * i) for i in range(blades)), move(spinner, z=-0.008)


def jet(radius, long) -> tuple[Mesh, Mesh]:
    """(nacelle, dark intake and exhaust) about the z axis, front at z = 0."""
    outside = np.array(
        [(0.55, 0.0), (0.72, 0.12), (0.9, 0.4), (1.0, 0.7), (0.97, 0.92), (0.88, 1.0), (0.8, 0.95), (0.78, 0.85)]
    )
    pod = turn(lathe(outside * (radius, long), 24), "x", 90)
    fan = turn(
        lathe(np.array([(0.5, -0.1), (0.5, 0.02), (0.76, 0.86), (0.2, 0.865), (0.0, 0.93)]) * (radius, long), 20),
        "x",
        90,
    )
    return move(pod, z=-long), move(fan, z=-long)


def gear(rng, legs, radius) -> tuple[Mesh, Mesh]:
    """(tyres, struts and rims): a wheel at the foot of each leg (top point, ground point)."""
    tyre, rim = wheel(rng, radius, radius * 0.7)
    tyres, rest = [], []
    for top, foot in legs:
        hub = np.asarray(foot) + (0, radius, 0)
        tyres.append(move(tyre, *hub))
        rest += [move(rim, *hub), tube([hub, top], radius * 0.3, segments=8)]
        rest.append(move(box((radius * 0.9, radius * 0.4, radius * 0.4)), *hub))
    return merge(tyres), merge(rest)


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
    grid = np.stack(
        np.broadcast_arrays(
            half[:, None] * np.cos(angle), middle[:, None] + half[:, None] * np.sin(angle) * 1.02, places[:, None]
        ),
        axis=-1,
    )
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
    legs.append(
        ((0, -width * 0.3, 0.4), (0, down, 0.4)) if rng.random() < 0.6 else ((0, 0.0, -0.42), (0, -width * 0.5, -0.44))
    )
    tyres, struts = gear(rng, legs, rng.uniform(0.022, 0.032))
    return [(finishes.rubber(rng), tyres), (trim, struts)]
