"""Light from a file or by name: environment maps (.hdr .exr), and the lights of the package."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Float

from spnr_jax.errors import UserError, first_line
from spnr_jax.kernels.records import Light
from spnr_jax.surfels import skies
from spnr_jax.surfels.lighting import light_of

ENDINGS = (".hdr", ".exr")
MOST_BYTES = 2**26  # of a file; a map of 2048 x 1024 texels has a quarter
NAMES = tuple(skies.NAMED)


def read_light(source: Path | str, normalise: bool = True) -> Light:
    """The light of a map's file, or one of the package: room, studio, sunset, overcast, night.

    Normalised, a white diffuse sphere averages 0.6, as in the data that the networks learnt from; else the radiance is
    that of the file.  ValueError in one line for what is no such map.
    """
    named = skies.NAMED.get(str(source))
    envmap = named(skies.HEIGHT) if named else read_envmap(Path(source))
    return light_of(skies.normalise(envmap) if normalise else envmap)


def read_envmap(path: Path) -> Float[np.ndarray, "height width 3"]:
    """Linear radiance of a latitude-longitude map; ValueError names the file and what is wrong with it."""
    if not path.is_file():
        known = ", ".join(NAMES)
        raise UserError(f"{path}: no such file; give a latitude-longitude .hdr or .exr, or one of {known}")
    if path.suffix.lower() not in ENDINGS:
        raise UserError(f"{path}: no map of radiance, which is .hdr or .exr; 8-bit pictures have no bright lamps")
    if path.stat().st_size > MOST_BYTES:
        size = path.stat().st_size / 2**20
        raise UserError(f"{path}: {size:.0f} MB, more than {MOST_BYTES >> 20}; a map of 1024 x 512 texels is enough")
    if find_spec("mitsuba") is None:
        raise UserError(f"{path}: maps are read by the package mitsuba; pip install 'spnr-jax[data]'")
    radiance = _read(path)
    height, width = radiance.shape[:2]
    if width != 2 * height:
        raise UserError(f"{path}: {width} x {height} texels; a latitude-longitude map is twice as wide as high")
    if not np.isfinite(radiance).all() or radiance.min() < 0 or radiance.max() <= 0:
        raise UserError(f"{path}: expected finite radiance >= 0 with some light in it")
    return radiance


def _read(path: Path) -> np.ndarray:
    mi = import_module("mitsuba")
    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    try:
        with threads(2):  # with a single one the OpenEXR reader waits for itself for ever
            bitmap = mi.Bitmap(str(path))
            if bitmap.component_format() in (mi.Struct.Type.UInt8, mi.Struct.Type.UInt16):
                raise UserError(f"{path}: holds an 8- or 16-bit picture, not radiance; give a real .hdr or .exr")
            bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    except RuntimeError as error:
        raise UserError(f"{path}: not a readable .hdr or .exr ({first_line(error)})") from None
    return np.array(bitmap, dtype=np.float32)


@contextmanager
def threads(least: int) -> Iterator[None]:
    """Let Mitsuba use at least so many threads for a while."""
    drjit = import_module("drjit")
    before = drjit.thread_count()
    drjit.set_thread_count(max(before, least))
    try:
        yield
    finally:
        drjit.set_thread_count(before)
