"""Textures made in code: pictures of numbers in [0, 1] that tile, and coloured ones mixed from them.

Conventions: a pattern is (height, width) float in [0, 1], a picture is (height, width, 3) linear RGB; both join their
own other edge seamlessly (but for `painting`). u runs along the columns, v down the rows; grain runs along v, the
length of a part. `rng` is a np.random.Generator: the same generator state gives the same picture.
"""

import numpy as np

SIZE = 192


def grid() -> tuple[np.ndarray, np.ndarray]:
    """(u (1, SIZE), v (SIZE, 1)) at texel centres, in [0, 1]."""
    place = (np.arange(SIZE) + 0.5) / SIZE
    return place[None, :], place[:, None]


def noise(rng, frequency, slope=2.0) -> np.ndarray:
    """(SIZE, SIZE) smooth noise about 0.5 of spread about 1/6, of some `frequency` (along u, along v) in waves a tile.

    White noise filtered to (1 + |f/frequency|^2)^(-slope): periodic, because its spectrum is the discrete one.
    """
    along_u = np.fft.rfftfreq(SIZE, 1 / SIZE)[None, :] / frequency[0]
    along_v = np.fft.fftfreq(SIZE, 1 / SIZE)[:, None] / frequency[1]
    spectrum = np.fft.rfft2(rng.uniform(-1, 1, (SIZE, SIZE))) * (1 + along_u**2 + along_v**2) ** -slope
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, (SIZE, SIZE))
    return np.clip(0.5 + field / (6 * field.std()), 0, 1)


def step(x, edge=0.5, softness=0.02) -> np.ndarray:
    """0 below the edge, 1 above, a smooth ramp between."""
    t = np.clip((x - edge) / softness / 2 + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def mix(first, second, weight) -> np.ndarray:
    """(height, width, 3) picture: the first colour or picture where weight (height, width) is 0, the second where 1."""
    weight = np.asarray(weight)[..., None]
    return np.asarray(first) * (1 - weight) + np.asarray(second) * weight


# ---------------------------------------------------------------- patterns


def wood(rng) -> np.ndarray:
    """Growth rings cut lengthwise, and fine fibres, along v."""
    u, _ = grid()
    rings = rng.integers(3, 9) * u + rng.uniform(0.4, 1.8) * noise(rng, (1.5, 0.7))
    late = (0.5 + 0.5 * np.cos(2 * np.pi * rings)) ** rng.uniform(1, 3)
    fibres = noise(rng, (60, 3), 1.5)
    blend = rng.uniform(0.3, 0.7)
    return np.clip(blend * late + (1 - blend) * (0.5 + 1.6 * (fibres - 0.5)), 0, 1)


def weave(rng) -> np.ndarray:
    """Plain cloth: threads over and under, each a little different."""
    threads = 2 * int(rng.integers(6, 17))
    u, v = grid()
    over = np.sign(np.sin(np.pi * threads * u) * np.sin(np.pi * threads * v))
    bulge = np.where(over > 0, np.abs(np.sin(np.pi * threads * u)) + 0 * v, np.abs(np.sin(np.pi * threads * v)) + 0 * u)
    tone = rng.uniform(-1, 1, (2, threads))
    column = tone[0][np.minimum((u * threads).astype(int), threads - 1)]
    row = tone[1][np.minimum((v * threads).astype(int), threads - 1)]
    return np.clip(0.25 + 0.5 * bulge + 0.15 * np.where(over > 0, column, row), 0, 1)


def stripes(rng) -> np.ndarray:
    """Bands along v: some widths, repeated a whole number of times."""
    u, v = grid()
    phase = (u * rng.integers(1, 8)) % 1 + 0 * v
    edges = np.sort(rng.uniform(0.1, 0.9, 4))
    values = np.concatenate([[0.0], rng.permutation([1.0, 0.35, 0.7]), [0.0]])
    bands = sum((b - a) * step(phase, edge, 0.02) for edge, a, b in zip(edges, values[:-1], values[1:], strict=True))
    plain = step(np.abs(phase - 0.5), rng.uniform(0.15, 0.35), 0.02)
    return np.clip(bands if rng.random() < 0.5 else plain, 0, 1)


def checks(rng) -> np.ndarray:
    """Chess board, gingham or tartan."""
    u, v = grid()
    style = rng.integers(3)
    if style == 2:
        one = stripes(rng)[:1]
        return 0.5 * (one + one.T)
    count = rng.integers(2, 9)
    across, down = step(np.sin(2 * np.pi * count * u), 0, 0.1), step(np.sin(2 * np.pi * count * v), 0, 0.1)
    return across + down - 2 * across * down if style == 0 else 0.5 * (across + down)


def dots(rng) -> np.ndarray:
    """Spots on a lattice, every other row shifted."""
    count = 2 * int(rng.integers(1, 5))
    u, v = grid()
    row = np.floor(v * count)
    x, y = (u * count + 0.5 * (row % 2)) % 1 - 0.5, v * count - row - 0.5
    return 1 - step(np.hypot(x, y), rng.uniform(0.15, 0.38), 0.06)


def chevrons(rng) -> np.ndarray:
    """Zigzag bands."""
    u, v = grid()
    zigzag = np.abs((u * rng.integers(1, 5)) % 1 - 0.5) * rng.uniform(0.5, 1.5)
    return step(np.abs((rng.integers(2, 7) * v + zigzag) % 1 - 0.5), 0.25, 0.06)


def marble(rng) -> np.ndarray:
    """Veins: the ridges of a wave bent by noise."""
    u, v = grid()
    bend = 3 * noise(rng, (2, 2), 1.5)
    wave = np.abs(np.sin(np.pi * (rng.integers(1, 4) * u + rng.integers(-2, 3) * v + bend)))
    return np.clip(0.85 * (1 - wave) ** rng.uniform(2, 6) + 0.5 * (noise(rng, (3, 3)) - 0.4), 0, 1)


def speckles(rng) -> np.ndarray:
    """Terrazzo, granite or spatter: noise cut at a level."""
    frequency = rng.uniform(8, 40)
    return step(noise(rng, (frequency, frequency), 2.5), rng.uniform(0.5, 0.68), rng.uniform(0.02, 0.1))


def leather(rng) -> np.ndarray:
    """Pebbles between creases."""
    frequency = rng.uniform(14, 28)
    ridges = np.minimum(*(np.abs(noise(rng, (frequency, frequency), 3.0) - 0.5) for _ in range(2)))
    return np.clip(6 * ridges, 0, 1)


def brushed(rng) -> np.ndarray:
    """Scratches along v."""
    return noise(rng, (80, 1.2), 1.2)


def tiles(rng) -> np.ndarray:
    """Bricks, planks or quilting: 1 on the joints, a different tone (up to 0.5) on each tile."""
    rows, columns = 2 * int(rng.integers(1, 5)), int(rng.integers(1, 6))
    u, v = grid()
    row = np.minimum((v * rows).astype(int), rows - 1)
    across = (u * columns + 0.5 * (row % 2) * rng.integers(2)) % columns
    column = np.minimum(across.astype(int), columns - 1)
    joint = np.minimum(np.abs((across + 0.5) % 1 - 0.5) / columns, np.abs((v * rows + 0.5) % 1 - 0.5) / rows)
    tone = rng.uniform(0, 0.5, (rows, columns))[row, column]
    return np.maximum(tone, 1 - step(joint, 0.012, 0.006))


# ---------------------------------------------------------------- pictures (these do not tile)


def painting(rng, colors) -> np.ndarray:
    """(SIZE, SIZE, 3) picture to hang on a wall, of colours (k, 3): landscape, blocks, discs or clouds of colour."""
    style = (landscape, blocks, discs, clouds)[rng.integers(4)]
    return style(rng, np.asarray(colors))


def landscape(rng, colors) -> np.ndarray:
    """Sky over hills, nearer ones lower, perhaps a sun."""
    u, v = grid()
    picture = mix(colors[0], colors[1], np.broadcast_to(v, (SIZE, SIZE)))
    sun = np.hypot(u - rng.uniform(0.2, 0.8), v - rng.uniform(0.15, 0.4))
    picture = mix(picture, colors[2], 1 - step(sun, rng.uniform(0.05, 0.12), 0.01))
    for level, color in zip(np.linspace(0.45, 0.9, 4), np.roll(colors, -3, axis=0)[:4], strict=True):
        hills = level + rng.uniform(0.2, 0.8) * (noise(rng, (3, 3), 1.6)[:1] - 0.5)
        picture = mix(picture, color, step(v - hills, 0, 0.01))
    return picture


def blocks(rng, colors) -> np.ndarray:
    """Rectangles of colour between lines."""
    u, v = grid()
    across, down = np.sort(rng.uniform(0, 1, (2, 4)), axis=1)
    cell = 5 * np.searchsorted(down, v[:, 0])[:, None] + np.searchsorted(across, u[0])[None, :]
    picture = colors[rng.integers(len(colors), size=25)[cell]]
    gap = np.minimum(np.abs(u[..., None] - across).min(-1), np.abs(v[..., None] - down).min(-1))
    return mix(colors[0], picture, step(gap, rng.uniform(0.005, 0.02), 0.003))


def discs(rng, colors) -> np.ndarray:
    """Overlapping circles and rings."""
    u, v = grid()
    picture = np.broadcast_to(colors[0], (SIZE, SIZE, 3))
    for _ in range(rng.integers(4, 14)):
        x, y, radius = rng.uniform(0, 1), rng.uniform(0, 1), rng.uniform(0.05, 0.3)
        picture = mix(picture, colors[rng.integers(len(colors))], 1 - step(np.hypot(u - x, v - y), radius, 0.01))
    return picture


def clouds(rng, colors) -> np.ndarray:
    """Soft fields of colour, one over another."""
    picture = np.broadcast_to(colors[0], (SIZE, SIZE, 3))
    for color in colors[1:]:
        frequency = rng.uniform(1, 10, 2)
        picture = mix(picture, color, step(noise(rng, frequency), rng.uniform(0.4, 0.65), rng.uniform(0.05, 0.3)))
    return picture
