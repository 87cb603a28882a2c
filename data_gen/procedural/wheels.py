"""Wheels of cars, trucks and aircraft: a tyre and a rim about the x axis."""

import numpy as np

from data_gen.shapes.primitives import Mesh, box, cylinder, lathe, merge, move, turn


def wheel(rng, radius: float, width: float) -> tuple[Mesh, Mesh]:
    """(tyre, rim) about 0, the outside of the rim towards +x."""
    inner = radius * rng.uniform(0.55, 0.75)
    half, round_ = width / 2, width * rng.uniform(0.15, 0.3)
    section = [
        (inner, -half),
        (radius - round_, -half),
        (radius - round_ * 0.3, -half + round_ * 0.3),
        (radius, -half + round_),
        (radius, half - round_),
        (radius - round_ * 0.3, half - round_ * 0.3),
        (radius - round_, half),
        (inner, half),
        (inner * 0.97, half * 0.5),
        (inner * 0.97, -half * 0.5),
    ]
    tyre = lathe(section, 24, closed=True)
    dish = half * rng.uniform(0.1, 0.7)
    lip = lathe(
        [
            (inner, -half * 0.4),
            (inner, half * 0.95),
            (inner * 0.92, half),
            (inner * 0.88, dish),
            (inner * 0.85, -half * 0.4),
        ],
        24,
        closed=True,
    )
    hub = move(cylinder(inner * rng.uniform(0.2, 0.35), half * 0.5 + dish, 12, half * 0.1), y=-half * 0.3)
    style = rng.choice(["spokes", "disc", "dish"])
    parts = [lip, hub]
    if style == "spokes":
        count = int(rng.integers(3, 9))
        thick = rng.uniform(0.1, 0.3) * inner
        spoke = move(box((inner * 0.75, half * 0.4, thick), 0.002), x=inner * 0.53, y=dish * 0.8)
        parts += [turn(spoke, "y", 360 / count * i) for i in range(count)]
        parts.append(move(cylinder(inner * 0.9, half * 0.1, 20), y=-half * 0.3))
    elif style == "disc":
        parts.append(move(cylinder(inner * 0.92, dish + half * 0.3, 20, half * 0.08), y=-half * 0.3))
    else:
        at = np.linspace(1, 0, 6)
        parts.append(lathe([(inner * 0.9, -half * 0.3), *zip(inner * 0.9 * at, dish * (1 - at**2), strict=True)], 20))
    return turn(tyre, "z", -90), turn(merge(parts), "z", -90)
