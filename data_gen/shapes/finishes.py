"""Finishes: what a part is made of. Each is a principled material made in code, and the size of its texture.

Colours are linear RGB, albedo in [0.02, 0.9] as of real surfaces (metals up to 0.95); textures are rounded to 8 bits,
as image files are, so that the last bit of a processor's sine cannot change them.
A finish is chosen by family ("wood", "fabric", ...); now and then any family stands in for any other and every colour
can come with every shape, so that colour cannot be guessed from shape.
"""

from typing import NamedTuple

import numpy as np

from data_gen.shapes import patterns
from spnr_jax.formats.assets import Material
from spnr_jax.kernels.imaging import srgb_to_linear

METALS = {
    "steel": (0.56, 0.57, 0.58),
    "chrome": (0.66, 0.67, 0.69),
    "aluminium": (0.88, 0.89, 0.9),
    "gold": (0.93, 0.72, 0.3),
    "brass": (0.86, 0.72, 0.38),
    "copper": (0.92, 0.6, 0.48),
    "bronze": (0.55, 0.38, 0.2),
    "iron": (0.3, 0.29, 0.28),
    "black": (0.06, 0.06, 0.065),
}
WOODS = [(0.45, 0.25, 0.11), (0.6, 0.4, 0.22), (0.22, 0.1, 0.045), (0.08, 0.045, 0.025), (0.72, 0.55, 0.36)]
WOODS += [(0.36, 0.12, 0.06), (0.3, 0.26, 0.22), (0.5, 0.33, 0.14)]


class Finish(NamedTuple):
    """A material and the length that one repeat of its textures covers, in the units of the object."""

    material: Material
    tile: float = 1.0


def hsv(hue, saturation, value) -> np.ndarray:
    """(3,) linear RGB of a hue, saturation and value in [0, 1], as a colour picker has them."""
    wheel = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return np.clip(srgb_to_linear(value * (1 - saturation * (1 - wheel))), 0.02, 0.9)


def color(rng) -> np.ndarray:
    """(3,) linear RGB as products and toys come: saturated, pastel, dark, white or grey, earthen."""
    hue, a, b = rng.random(3)
    kind = rng.choice(5, p=[0.36, 0.16, 0.14, 0.2, 0.14])
    if kind == 0:
        return hsv(hue, 0.6 + 0.4 * a, 0.45 + 0.53 * b)
    if kind == 1:
        return hsv(hue, 0.15 + 0.3 * a, 0.75 + 0.22 * b)
    if kind == 2:
        return hsv(hue, 0.8 * a, 0.12 + 0.25 * b)
    if kind == 3:
        return hsv(hue, 0.06 * a, 0.15 + 0.82 * b**0.6)
    return hsv(0.02 + 0.12 * hue, 0.25 + 0.5 * a, 0.25 + 0.6 * b)


def finish(base_color, roughness, metallic=0.0, tile=1.0) -> Finish:
    """Finish of values or pictures, rounded to 8 bits where they are pictures."""

    def channel(value):
        value = np.asarray(value, float)
        return np.asarray(np.round(value * 255) / 255 if value.ndim > 1 else value, np.float32)

    made = Material(base_color=channel(base_color), roughness=channel(roughness), metallic=channel(metallic))
    return Finish(made, tile)


# ---------------------------------------------------------------- families


def wood(rng) -> Finish:
    """Bare, stained or varnished wood."""
    light = np.array(WOODS[rng.integers(len(WOODS))]) * rng.uniform(0.8, 1.2, 3)
    light = color(rng) if rng.random() < 0.2 else light  # stained
    dark = light * rng.uniform(0.3, 0.7) * rng.uniform(0.85, 1.0, 3)
    grain = patterns.wood(rng)
    picture = np.clip(patterns.mix(light, dark, grain), 0.02, 0.9)
    gloss = rng.uniform(0.2, 0.6)
    return finish(picture, np.clip(gloss + 0.25 * (grain - 0.3), 0.05, 1), tile=rng.uniform(0.25, 0.6))


def paint(rng) -> Finish:
    """Plain colour, from matt to gloss."""
    return finish(color(rng), rng.uniform(0.15, 0.9))


def plastic(rng) -> Finish:
    """Plain colour, satin to shiny."""
    return finish(color(rng), rng.uniform(0.12, 0.5))


def metal(rng) -> Finish:
    """Bare metal, polished, satin or brushed, at times tinted."""
    tint = np.array(METALS[rng.choice(list(METALS))]) * rng.uniform(0.85, 1.02)
    tint = np.clip(color(rng), 0.05, 0.9) if rng.random() < 0.12 else tint  # anodised
    roughness = rng.uniform(0.05, 0.5)
    if rng.random() < 0.35:
        return finish(tint, np.clip(roughness + 0.6 * (patterns.brushed(rng) - 0.4), 0.05, 1), 1.0, tile=0.3)
    return finish(tint, roughness, 1.0)


def fabric(rng) -> Finish:
    """Cloth: plain weave, stripes, checks, dots, zigzag or a print, over a weave."""
    first, second = color(rng), color(rng)
    style = rng.choice(["plain", "stripes", "checks", "dots", "chevrons", "marble", "speckles"], p=[0.4] + [0.1] * 6)
    cloth = patterns.weave(rng)
    picture = first
    if style != "plain":
        picture = patterns.mix(first, second, getattr(patterns, style)(rng))
    picture = np.clip(picture * (0.6 + 0.55 * cloth[..., None]), 0.02, 0.9)
    return finish(picture, rng.uniform(0.7, 1.0), tile=rng.uniform(0.12, 0.4))


def leather(rng) -> Finish:
    """Leather, creases darker and duller."""
    pebbles = patterns.leather(rng)
    base = color(rng) if rng.random() < 0.6 else np.array(WOODS[rng.integers(len(WOODS))])
    picture = np.clip(base * (0.75 + 0.3 * pebbles[..., None]), 0.02, 0.9)
    return finish(picture, np.clip(rng.uniform(0.4, 0.65) - 0.2 * pebbles, 0.05, 1), tile=rng.uniform(0.15, 0.3))


def stone(rng) -> Finish:
    """Marble, granite, terrazzo or tiles, matt to polished."""
    pattern = (patterns.marble, patterns.speckles, patterns.tiles)[rng.choice(3, p=[0.5, 0.35, 0.15])](rng)
    ground, vein = color(rng), color(rng)
    if rng.random() < 0.5:  # grey and beige stones
        ground, vein = (hsv(0.1, rng.uniform(0, 0.2), rng.uniform(0.1, 0.97)) for _ in range(2))
    return finish(patterns.mix(ground, vein, pattern), rng.uniform(0.1, 0.7), tile=rng.uniform(0.3, 0.8))


def print_(rng) -> Finish:
    """Painted or printed pattern of two colours on a smooth ground."""
    style = rng.choice(["stripes", "checks", "dots", "chevrons", "tiles", "speckles", "marble"])
    picture = patterns.mix(color(rng), color(rng), getattr(patterns, style)(rng))
    return finish(picture, rng.uniform(0.2, 0.8), tile=rng.uniform(0.2, 0.6))


def rattan(rng) -> Finish:
    """Coarse weave of straw or plastic."""
    light = np.array(WOODS[rng.integers(len(WOODS))]) if rng.random() < 0.6 else color(rng)
    straw = patterns.weave(rng)
    return finish(np.clip(light * (0.25 + straw[..., None]), 0.02, 0.9), rng.uniform(0.5, 0.9), tile=0.25)


def car_paint(rng) -> Finish:
    """Coachwork: a shiny colour, now and then metallic."""
    metallic = rng.uniform(0.3, 0.9) if rng.random() < 0.3 else 0.0
    return finish(color(rng), rng.uniform(0.08, 0.35), metallic)


def glass(rng) -> Finish:
    """Windows seen from outside: dark, smooth, opaque, tinted a little."""
    return finish(hsv(rng.random(), rng.uniform(0, 0.5), rng.uniform(0.12, 0.4)), rng.uniform(0.05, 0.12))


def rubber(rng) -> Finish:
    """Tyres and feet."""
    return finish(np.full(3, rng.uniform(0.02, 0.05)), rng.uniform(0.75, 1.0))


def glow(rng) -> Finish:
    """Lamp shades, bulbs and paper: light and dull, warm to white, at times coloured."""
    tint = hsv(rng.uniform(0.06, 0.16), rng.uniform(0.0, 0.35), rng.uniform(0.8, 0.97))
    return finish(tint if rng.random() < 0.5 else color(rng), rng.uniform(0.4, 1.0))


ANY = (wood, paint, plastic, metal, fabric, leather, stone, print_, rattan)
SURPRISE = 0.12  # how often any finish stands in for the one that a part would have


def choose(rng, *families) -> Finish:
    """One finish of the families given, with equal chance, or now and then of any family at all."""
    options = ANY if rng.random() < SURPRISE else families
    return options[rng.integers(len(options))](rng)


def canvas(rng) -> Finish:
    """A painting that fills the unit square of texture coordinates."""
    picture = patterns.painting(rng, [color(rng) for _ in range(7)])
    return finish(picture, rng.uniform(0.3, 0.9))


SWATCHES = 12


def swatches(rng) -> Finish:
    """Plain colours in one material, colour k at u = (k + 0.5) / SWATCHES; with lines across, as book spines."""
    colors = np.stack([color(rng) for _ in range(SWATCHES)])
    lines = patterns.step(np.abs((np.arange(64) + 0.5) / 64 - 0.5), rng.uniform(0.3, 0.4), 0.02)
    lines *= 1 - patterns.step(np.abs((np.arange(64) + 0.5) / 64 - 0.5), rng.uniform(0.42, 0.46), 0.02)
    marks = np.stack([color(rng) for _ in range(SWATCHES)])
    picture = colors + lines[:, None, None] * rng.uniform(0, 0.8, (SWATCHES, 1)) * (marks - colors)
    return finish(np.repeat(picture, 128 // SWATCHES, axis=1), rng.uniform(0.3, 0.8))
