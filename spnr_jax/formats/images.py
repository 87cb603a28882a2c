"""Arrays as image files: 8-bit values, a depth map in colours, a turntable as a film.

Images are (height, width, 3) or grey (height, width), uint8 or float in [0, 1], sRGB.  Files are written beside their
place and renamed into it: a reader sees the old content or the new, never half of it.
"""

import base64
import contextlib
import io
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Array
from PIL import Image

from spnr_jax.errors import UserError

OPAQUE = 0.5  # opacity from which a pixel's depth counts for the range of the colours
PALETTE_PIXELS = 128  # along a side of a frame that the palette is chosen from, at least
PALETTE_FRAMES = 24  # frames, spread over the film, that choose the colours of a GIF
CENTISECOND = 0.01  # the clock of a GIF
# viridis (Smith, van der Walt 2015) at 20 even places, dark to bright; lines between are off by at most 4 / 255
VIRIDIS = (
    "440154 481467 482576 453781 404688 39558c 33638d 2d718e 287d8e 238a8d "
    "1f968b 20a386 29af7f 3dbc74 56c667 75d054 95d840 bade28 dde318 fde725"
)


def to_uint8(image: np.ndarray | Array) -> np.ndarray:
    """The image in 8 bits; values outside [0, 1], which an upsampler can produce, are shown as black or white."""
    image = np.asarray(image)
    if image.dtype == np.uint8:
        return image
    if not np.isfinite(image).all():
        raise UserError(f"an image of shape {image.shape} holds NaN or infinity")
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)


def depth_image(
    depth: np.ndarray | Array, acc: np.ndarray | Array, span: tuple[float, float] | None = None
) -> np.ndarray:
    """Colours (h, w, 3) uint8 of distances (h, w), near bright and far dark, fading to white with the opacity (h, w).

    The colours (viridis, perceptually uniform) go from the nearest to the farthest distance of the span, or of the
    opaque pixels of this one image.
    """
    depth, acc = np.asarray(depth, np.float64), np.asarray(acc, np.float64)
    opaque = depth[acc > OPAQUE]
    near, far = span or ((opaque.min(), opaque.max()) if opaque.size else (0.0, 1.0))
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
    """The image as an address that holds it as PNG, for pages that load nothing."""
    return f"data:image/png;base64,{base64.b64encode(png(image)).decode()}"


def check_place(path: Path) -> None:
    """ValueError if no file can be written at a path: it is asked before the work, not after it."""
    if path.is_dir():
        raise UserError(f"{path}: a folder; expected the name of a file")
    above = next(folder for folder in path.absolute().parents if folder.exists())
    if not above.is_dir():
        raise UserError(f"{path}: {above} is a file, not a folder; choose another place")
    if not os.access(above, os.W_OK | os.X_OK):
        raise UserError(f"{path}: nothing can be written in {above}; choose another place")


def write_whole(path: Path, data: bytes) -> None:
    """Write a file in one piece; folders that are missing are made."""
    with _in_its_place(path) as unfinished:
        unfinished.write_bytes(data)


@contextlib.contextmanager
def _in_its_place(path: Path) -> Iterator[Path]:
    """The path beside it where a file is written, which is renamed when that is done, or removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".unfinished-{os.getpid()}-{path.name}")
    try:
        yield unfinished
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def write_turntable(path: str | Path, frames: list[np.ndarray], fps: float | int) -> tuple[Path, str]:
    """(file written, reason): an endless .gif, or an .mp4 where imageio-ffmpeg is installed.

    Without it a .mp4 becomes the .gif of the same name, and the reason says so in one line; else it is empty.
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
        except (ImportError, RuntimeError):  # the latter on a platform that the package brings no program for
            reason = "written as .gif: .mp4 needs ffmpeg (pip install imageio-ffmpeg)"
    path = path.with_suffix(".gif")
    write_whole(path, _gif(pictures, fps))
    return path, reason


def _gif(pictures: list[np.ndarray], fps: float | int) -> bytes:
    """A GIF that loops; all frames share one palette, or still surfaces would flicker."""
    chosen = np.unique(np.linspace(0, len(pictures) - 1, PALETTE_FRAMES).round().astype(int))
    step = max(min(pictures[0].shape[:2]) // PALETTE_PIXELS, 1)  # of 24 frames of 512 pixels whole, 5.9 s
    strip = Image.fromarray(np.concatenate([pictures[i][::step, ::step] for i in chosen]))
    palette = strip.quantize(256, method=Image.Quantize.MEDIANCUT, kmeans=2, dither=Image.Dither.NONE)
    images = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    milliseconds = round(1 / (fps * CENTISECOND)) * round(1000 * CENTISECOND)
    stream = io.BytesIO()
    images[0].save(
        stream, "gif", save_all=True, append_images=images[1:], duration=milliseconds, loop=0, optimize=False
    )
    return stream.getvalue()


def _write_mp4(path: Path, pictures: list[np.ndarray], fps: float | int) -> None:
    """Write H.264 that every player opens, which wants even sides: an odd one loses its last pixel row."""
    import imageio_ffmpeg

    height, width = (size - size % 2 for size in pictures[0].shape[:2])
    with _in_its_place(path) as unfinished:
        writer = imageio_ffmpeg.write_frames(
            str(unfinished), (width, height), fps=fps, quality=8, macro_block_size=2, ffmpeg_log_level="error"
        )
        with warnings.catch_warnings():  # of JAX: the child starts ffmpeg at once and touches nothing of it
            warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
            writer.send(None)
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture[:height, :width]))
        writer.close()
