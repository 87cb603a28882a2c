"""Image files: 8-bit pictures, coloured depth maps, turntable films, HTML pages; environment maps, read.

Images are (height, width, 3) or grey (height, width), uint8 or float in [0, 1], sRGB.  Files are written under another
name and then renamed, so a reader never sees a partial file.

A light is read from an environment map (.hdr .exr; through mitsuba), or is one of the package's, by name.
"""

import base64
import contextlib
import io
import os
import subprocess
import tempfile
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Array, Float
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from PIL import Image

from spnr_jax.errors import UserError, first_line
from spnr_jax.kernels.records import Light
from spnr_jax.surfels import skies
from spnr_jax.surfels.lighting import light_of

ENDINGS, MOST_BYTES = (".hdr", ".exr"), 2**26  # of an environment map; 2048 x 1024 texels take a quarter
NAMES = tuple(skies.NAMED)  # of lights
OPAQUE = 0.5  # opacity from which a pixel's depth counts in the range of the colour map
PALETTE_PIXELS = 128  # least side of the frames from which the palette is chosen
PALETTE_FRAMES = 24  # frames, spread over the film, from which a GIF's palette is chosen
CENTISECOND = 0.01  # time unit of a GIF
ROUNDED = 0.05  # share by which that may change the rate of frames without a word
QUALITY = 10  # of an .mp4: constant rate factor, from 0 (the best) to 51
# of an .mp4; where it is not named, players guess it by the size, some wrongly
COLOR_SPACE = "colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1:range=tv"
# viridis (Smith, van der Walt 2015) at 20 even steps, dark to bright; interpolation is off by at most 4 / 255
VIRIDIS = (
    "440154 481467 482576 453781 404688 39558c 33638d 2d718e 287d8e 238a8d "
    "1f968b 20a386 29af7f 3dbc74 56c667 75d054 95d840 bade28 dde318 fde725"
)


def to_uint8(image: np.ndarray | Array) -> np.ndarray:
    """The image in 8 bits; values outside [0, 1], which an upsampler can produce, are clipped."""
    image = np.asarray(image)
    if image.dtype == np.uint8:
        return image
    if not np.isfinite(image).all():
        raise UserError(f"an image of shape {image.shape} holds NaN or infinity")
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)


def depth_image(depth: np.ndarray | Array, acc: np.ndarray | Array) -> np.ndarray:
    """Colours (h, w, 3) uint8 of depths (h, w), near bright and far dark, over white by the opacity (h, w).

    The colour map (viridis) spans the depths of the opaque pixels.
    """
    depth, acc = np.asarray(depth, np.float64), np.asarray(acc, np.float64)
    opaque = depth[acc > OPAQUE]
    near, far = (opaque.min(), opaque.max()) if opaque.size else (0.0, 1.0)
    nearness = np.clip((far - depth) / max(far - near, np.finfo(np.float32).tiny), 0, 1)
    opacity = np.clip(acc, 0, 1)[..., None]
    colors = np.frombuffer(bytes.fromhex(VIRIDIS), np.uint8).reshape(-1, 3) / 255
    places = np.linspace(0, 1, len(colors))
    shown = np.stack([np.interp(nearness, places, channel) for channel in colors.T], axis=-1)
    return to_uint8(opacity * shown + 1 - opacity)


def png(image: np.ndarray | Array) -> bytes:
    """The image as a PNG file."""
    stream = io.BytesIO()
    Image.fromarray(to_uint8(image)).save(stream, "png", optimize=True)
    return stream.getvalue()


def png_url(image: np.ndarray | Array) -> str:
    """The image as a data URL of a PNG, for self-contained pages."""
    return f"data:image/png;base64,{base64.b64encode(png(image)).decode()}"


def check_place(path: Path) -> None:
    """ValueError if no file can be written at a path; called before long work."""
    if path.is_dir():
        raise UserError(f"{path}: a folder; expected the name of a file")
    above = next(folder for folder in path.absolute().parents if folder.exists())
    if not above.is_dir():
        raise UserError(f"{path}: {above} is a file, not a folder; choose another place")
    if not os.access(above, os.W_OK | os.X_OK):
        raise UserError(f"{path}: nothing can be written in {above}; choose another place")


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file atomically; makes missing folders."""
    with _in_its_place(path) as unfinished:
        unfinished.write_bytes(data)


@contextlib.contextmanager
def _in_its_place(path: Path) -> Iterator[Path]:
    """Context with a temporary path beside `path`, renamed to it at the end, or removed after an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".unfinished-{os.getpid()}-{path.name}")
    try:
        yield unfinished
        os.replace(unfinished, path)
    except OSError as error:
        error.filename = error.filename or str(path)  # errors of writing name no file
        raise
    finally:
        unfinished.unlink(missing_ok=True)


def write_turntable(path: str | Path, frames: list[np.ndarray], fps: float | int) -> tuple[Path, str]:
    """(path written, reason): a looping .gif, or an .mp4 if imageio-ffmpeg is installed.

    Without it, a .gif is written instead of the .mp4, and the reason says so in one line; else the reason is empty.
    """
    path = Path(path)
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise UserError(f"{path}: a turntable is a .gif or .mp4 file, not {path.suffix!r}")
    if not frames or not fps > 0:
        raise UserError(f"{path}: a turntable needs frames and a positive rate, got {len(frames)} frames at {fps} fps")
    pictures, reason = [to_uint8(frame) for frame in frames], ""
    if path.suffix.lower() == ".mp4":
        try:
            _write_mp4(path, pictures, fps)
            return path, ""
        except (ImportError, RuntimeError):  # no package, or no ffmpeg in it for this platform
            reason = "written as .gif: .mp4 needs ffmpeg (pip install imageio-ffmpeg)"
    path, steps = path.with_suffix(".gif"), max(round(1 / (fps * CENTISECOND)), 1)
    write_whole(path, _gif(pictures, steps))
    if abs((shown := 1 / (steps * CENTISECOND)) - fps) > ROUNDED * fps:
        reason += f"{'; ' * bool(reason)}{shown:.3g} frames a second, as a .gif counts hundredths of a second"
    return path, reason


def _gif(pictures: list[np.ndarray], steps: int) -> bytes:
    """A looping GIF that shows each picture for `steps` hundredths of a second.

    All frames share one palette, so that still surfaces do not flicker; the background is exact.
    """
    chosen = np.unique(np.linspace(0, len(pictures) - 1, PALETTE_FRAMES).round().astype(int))
    step = max(min(pictures[0].shape[:2]) // PALETTE_PIXELS, 1)  # at full size 24 frames of 512 px would take 5.9 s
    strip = Image.fromarray(np.concatenate([pictures[i][::step, ::step] for i in chosen]))
    palette = strip.quantize(256, method=Image.Quantize.MEDIANCUT, kmeans=2, dither=Image.Dither.NONE)
    background, colors, place = pictures[0][0, 0], palette.getpalette() or [], int(np.asarray(palette)[0, 0])
    palette.putpalette([*colors[: 3 * place], *background.tolist(), *colors[3 * place + 3 :]])
    images = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    for image, picture in zip(images, pictures, strict=True):  # Pillow takes any close colour
        image.paste(place, None, Image.fromarray((picture == background).all(axis=-1)))
    milliseconds = steps * round(1000 * CENTISECOND)
    stream = io.BytesIO()
    images[0].save(
        stream, "gif", save_all=True, append_images=images[1:], duration=milliseconds, loop=0, optimize=False
    )
    return stream.getvalue()


def _write_mp4(path: Path, pictures: list[np.ndarray], fps: float | int) -> None:
    """Writes H.264, which needs even sides: the last row or column of an odd side is cut off."""
    import imageio_ffmpeg

    height, width = (size - size % 2 for size in pictures[0].shape[:2])
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
    colors = ["-vf", f"scale=out_color_matrix=bt709,setparams={COLOR_SPACE}"]
    wanted = [*colors, "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", str(QUALITY), "-v", "error", "-y"]
    with _in_its_place(path) as unfinished, tempfile.TemporaryFile() as said:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), *given, *wanted, str(unfinished)]
        ffmpeg = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=said, stderr=said)
        with contextlib.suppress(BrokenPipeError), ffmpeg:  # broken: it has stopped, and says why
            for picture in pictures:
                assert ffmpeg.stdin is not None
                ffmpeg.stdin.write(np.ascontiguousarray(picture[:height, :width]).tobytes())
        if ffmpeg.returncode:
            said.seek(0)
            lines = said.read().decode(errors="replace").strip().splitlines() or ["no reason given"]
            raise UserError(f"{path}: ffmpeg could not write it ({lines[-1]})")


def template(path: Path) -> Template:
    """The page template in a file; names that are used but not given are errors."""
    files = FileSystemLoader([path.parent, Path(__file__).parent])
    pages = Environment(loader=files, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return pages.get_template(path.name)


def read_light(source: Path | str, normalise: bool = True) -> Light:
    """The light in an environment map's file, or one of the package's: room, studio, sunset, overcast, night.

    Normalised, a white diffuse sphere has a mean of 0.6, as in the training data; else the file's radiance is kept.
    ValueError, in one line, for anything else.
    """
    named = skies.NAMED.get(str(source))
    envmap = named(skies.HEIGHT) if named else read_envmap(Path(source))
    return light_of(skies.normalise(envmap) if normalise else envmap)


def read_envmap(path: Path) -> Float[np.ndarray, "height width 3"]:
    """Linear radiance of a latitude-longitude map; ValueError names the file and what is wrong."""
    if not path.is_file():
        known, found = ", ".join(NAMES), "no file" if path.exists() else "no such file"
        raise UserError(f"{path}: {found}; give a latitude-longitude .hdr or .exr, or one of {known}")
    if path.suffix.lower() not in ENDINGS:
        raise UserError(f"{path}: no map of radiance, which is .hdr or .exr; 8-bit pictures have no bright lamps")
    if path.stat().st_size > MOST_BYTES:
        size = path.stat().st_size / 2**20
        raise UserError(f"{path}: {size:.0f} MB, more than {MOST_BYTES >> 20}; a map of 1024 x 512 texels is enough")
    if find_spec("mitsuba") is None:
        raise UserError(f"{path}: maps are read by the package mitsuba; pip install 'spnr-jax[data]'")
    radiance = _read_bitmap(path)
    height, width = radiance.shape[:2]
    if width != 2 * height:
        raise UserError(f"{path}: {width} x {height} texels; a latitude-longitude map is twice as wide as high")
    if not np.isfinite(radiance).all() or radiance.min() < 0 or radiance.max() <= 0:
        raise UserError(f"{path}: expected finite radiance >= 0 with some light in it")
    return radiance


def _read_bitmap(path: Path) -> np.ndarray:
    mi = import_module("mitsuba")
    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    try:
        with threads(2):  # with one thread the OpenEXR reader deadlocks
            bitmap = mi.Bitmap(str(path))
            if bitmap.component_format() in (mi.Struct.Type.UInt8, mi.Struct.Type.UInt16):
                raise UserError(f"{path}: holds an 8- or 16-bit picture, not radiance; give a real .hdr or .exr")
            bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    except RuntimeError as error:
        raise UserError(f"{path}: not a readable .hdr or .exr ({first_line(error)})") from None
    return np.array(bitmap, dtype=np.float32)


@contextlib.contextmanager
def threads(least: int) -> Iterator[None]:
    """Context in which Mitsuba uses at least `least` threads."""
    drjit = import_module("drjit")
    before = drjit.thread_count()
    drjit.set_thread_count(max(before, least))
    try:
        yield
    finally:
        drjit.set_thread_count(before)
