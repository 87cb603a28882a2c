"""The best pictures that keep to a time: `spnr render --seconds S`.

Levels of quality and sizes are tried from the best to the cheapest; the first that draws all pictures in so many
seconds is taken.  How long a picture takes is measured once for each network, level, size and power of two of points,
on a sphere that fills the picture (few objects cover more of it), and kept in a file of the user's cache:

    ~/.cache/spnr_jax/seconds.json    {machine, network, points, level, pixels: seconds a picture}

Reading, encoding, compilation and writing come on top.
"""

import hashlib
import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from spnr_jax.config import NetworkConfig, RayNetworkConfig, SurfelConfig
from spnr_jax.devices import compilation, machine
from spnr_jax.formats.images import write_whole
from spnr_jax.kernels.cloud_arrays import bucket, plain_cloud
from spnr_jax.kernels.records import PointCloud, Volume
from spnr_jax.method.model import Model, Quality
from spnr_jax.tools.render_command import Render

FILE = "seconds.json"
REPEATS = 3
GOLDEN_ANGLE = np.pi * (3 - 5**0.5)
# From the best to the cheapest, with the share of the pixels along a side: docs/performance.md
OF_SURFELS: tuple[tuple[Quality, float], ...] = (
    ("best", 1),
    ("balanced", 1),
    ("best", 0.5),
    ("draft", 0.5),
    ("draft", 0.25),
)
OF_RAYS: tuple[tuple[Quality, float], ...] = (
    ("best", 1),
    ("balanced", 1),
    ("draft", 1),
    ("draft", 0.5),
    ("draft", 0.25),
)


class Level(NamedTuple):
    """A way to draw."""

    quality: Quality
    pixels: int


class Timing(NamedTuple):
    """What measures and where it is kept: a clock in seconds, a folder."""

    clock: Callable[[], float] = time.perf_counter
    folder: Path | None = None


TIMING = Timing()


def choose(options: Render, model: Model, num_points: int, timing: Timing = TIMING) -> tuple[Render, str]:
    """The options with the level and size that keep to their seconds instead, and a line that says what was chosen."""
    assert options.seconds is not None
    pictures = max(options.views + (options.frames if options.turntable != "none" else 0), 1)
    known = _Known(model, num_points, timing)
    for level in levels(model.config, options.resolution):
        seconds = pictures * known.seconds(level)
        if seconds <= options.seconds:
            break
    kept = "" if seconds <= options.seconds else "; nothing that is known here keeps to it, this comes nearest"
    line = f"--seconds {options.seconds:g}: {level.quality} at {level.pixels} px, "
    line += f"about {seconds:.2g} s for {pictures} pictures{kept}"
    return replace(options, quality=level.quality, resolution=level.pixels, seconds=None), line


def levels(config: NetworkConfig, resolution: int | None) -> list[Level]:
    """What is tried, from the best to the cheapest; a size that is asked for is kept."""
    ways: tuple[tuple[Quality, float], ...] = (("best", 1),)
    if isinstance(config, SurfelConfig):
        ways = OF_SURFELS
    elif isinstance(config, RayNetworkConfig):
        ways = OF_RAYS
    full = resolution or config.image_resolution
    fixed = resolution is not None or not config.any_size
    found = [Level(quality, full if fixed else max(round(share * full / 4) * 4, 16)) for quality, share in ways]
    return list(dict.fromkeys(found))


class _Known:
    """Seconds a picture of one network and number of points, from the file or measured."""

    def __init__(self, model: Model, num_points: int, timing: Timing) -> None:
        self._model, self._clock = model, timing.clock
        self._points = bucket(num_points)
        self._file = (timing.folder or compilation.folder()) / FILE
        network = hashlib.sha256(repr(model.config).encode())
        for values in jax.tree.leaves(model.variables):
            network.update(np.asarray(values).tobytes())
        self._prefix = f"{machine.hardware()}, {network.hexdigest()[:16]}, {self._points}"
        self._sphere: Volume | None = None

    def seconds(self, level: Level) -> float:
        name = f"{self._prefix}, {level.quality}, {level.pixels}"
        found = self._read().get(name)
        if not isinstance(found, float):
            found = self._measured(level)
            with suppress(OSError):  # a cache that cannot be written is measured again
                content = json.dumps(self._read() | {name: found}, indent=1, sort_keys=True) + "\n"
                write_whole(self._file, content.encode())
        return found

    def _read(self) -> dict:
        try:
            known = json.loads(self._file.read_text())
        except (OSError, ValueError):  # none yet, or damaged: it is measured anew
            return {}
        return known if isinstance(known, dict) else {}

    def _measured(self, level: Level) -> float:
        """The median of several drawings, after the one that compiles."""
        if self._sphere is None:
            self._sphere = self._model.encode(sphere(self._points))
        camera = self._model.camera(self._sphere, resolution=level.pixels)
        taken = []
        for _ in range(1 + REPEATS):
            begin = self._clock()
            jax.block_until_ready(self._model.render(self._sphere, camera, level.quality).image)
            taken.append(self._clock() - begin)
        return float(np.median(taken[1:]))


def sphere(count: int) -> PointCloud:
    """Even points of a grey sphere."""
    number = np.arange(count) + 0.5
    height, turn = 1 - 2 * number / count, GOLDEN_ANGLE * number
    wide = np.sqrt(1 - height**2)
    return plain_cloud(np.stack([wide * np.cos(turn), height, wide * np.sin(turn)], axis=-1).astype(np.float32))
