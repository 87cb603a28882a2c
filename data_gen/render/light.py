"""The light of every picture: an environment map, scaled so that a white diffuse sphere averages 0.6 linear.

One map lights a whole data set, or each view draws a map of its own and turns it about the up axis.

Conventions: a map is (height, 2 * height, 3) float32, linear radiance, latitude-longitude as Mitsuba reads it.
Row 0 is straight up (+y); column c of w looks along azimuth phi = 2 pi (c + 0.5) / w, where the direction is
(sin phi, 0, -cos phi) on the horizon: phi = 0 is -z, phi = 90 degrees is +x.
The default map is the package's room (`spnr_jax.surfels.skies`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.images import ENDINGS, read_envmap
from spnr_jax.surfels import lighting, skies

WHITE_SPHERE_RADIANCE = 0.6  # far enough below 1 that white objects keep their shading against the white background

DRAWN_HEIGHT = 256  # rows of a map that a view draws
MOST_LAMPS = 4  # of a random map


@dataclass(frozen=True)
class Lights:
    """One map for every view, or kinds of light of which each view draws one; a kind without maps is a random one."""

    shared: np.ndarray | None = None
    kinds: tuple[tuple[np.ndarray, ...], ...] = ()

    def of_views(self, count: int, seed: int) -> Iterator[np.ndarray]:
        """The map of each of so many views, or the shared one once."""
        if self.shared is not None:
            yield self.shared
            return
        for view in range(count):
            generator = np.random.default_rng((seed, view, DRAWN_HEIGHT))
            maps = self.kinds[generator.integers(len(self.kinds))]
            drawn = maps[generator.integers(len(maps))] if maps else random_map(generator)
            turned = np.roll(drawn, generator.integers(drawn.shape[1]), axis=1)
            yield scale_to_white(turned)


def random_map(generator: np.random.Generator) -> np.ndarray:
    """A sky of random colours with up to MOST_LAMPS lamps, from broad glows to suns of three degrees."""

    def random_color(brightness: float, tint: float) -> np.ndarray:
        return brightness * np.exp(tint * generator.standard_normal(3))

    above, around, below = (random_color(brightness, 0.3) for brightness in np.exp(generator.normal(-1, 0.7, 3)))
    whole = skies.gradient(above, around, below, DRAWN_HEIGHT)
    for _ in range(generator.integers(0, MOST_LAMPS + 1)):
        rise = np.degrees(np.arcsin(generator.uniform(-0.4, 1)))
        size = np.exp(generator.uniform(np.log(3), np.log(90)))
        power = np.exp(generator.normal(-0.3, 0.7))
        turn = generator.uniform(0, 360)
        whole = whole + skies.lamp(turn, rise, size, random_color(power, 0.2), DRAWN_HEIGHT)
    return np.asarray(whole)


def read_kinds(names: Sequence[str]) -> tuple[tuple[np.ndarray, ...], ...]:
    """The kinds of light of --lights: `room`, `random`, or a folder's maps; ValueError if it has none."""
    kinds: list[tuple[np.ndarray, ...]] = []
    for name in names:
        if name == "random":
            kinds.append(())
        elif name == "room":
            kinds.append((skies.indoor_envmap(DRAWN_HEIGHT),))
        else:
            files = map_files(name)
            kinds.append(tuple(np.asarray(lighting.resample(read_envmap(file), DRAWN_HEIGHT)) for file in files))
    return tuple(kinds)


def map_files(folder: str) -> list[Path]:
    """The environment maps in a folder, by name; ValueError if there are none."""
    files = sorted(path for path in Path(folder).glob("*") if path.suffix.lower() in ENDINGS)
    if not files:
        raise UserError(f"--lights {folder}: expected room, random, or a folder with .hdr or .exr maps; found no map")
    return files


def scale_to_white(envmap: np.ndarray) -> np.ndarray:
    """The map times the factor that makes a white diffuse sphere average WHITE_SPHERE_RADIANCE."""
    return np.asarray(skies.normalise(envmap, WHITE_SPHERE_RADIANCE))
