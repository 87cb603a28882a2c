"""A file of points in, pictures out: stills around the object, a turntable, depth and opacity."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from spnr_jax import clouds, images
from spnr_jax.model import Model, Quality, Volume, load

FRAMES_PER_SECOND = 16


def render_file(
    cloud: Path,
    run: Path,
    out: Path,
    *,
    views: int,
    elevation: float,
    resolution: int | None,
    num_points: int,
    up: str,
    turntable: str,
    frames: int,
    seed: int,
    quality: Quality,
) -> Iterator[str]:
    """Writes NAME_000.png ... (with _depth and _acc) and NAME_turntable.gif; yields a line about each step."""
    if views < 0:
        raise ValueError(f"--views must not be negative, got {views}")
    for name, value in (("frames", frames), ("num-points", num_points)):
        if value < 1:
            raise ValueError(f"--{name} must be at least 1, got {value}")
    if resolution is not None and (resolution < 16 or resolution % 4):
        raise ValueError(f"--resolution must be a multiple of 4 of at least 16, got {resolution}")
    model = load(run)
    notes: list[str] = []
    points = clouds.read_cloud(cloud, num_points=num_points, up=up, seed=seed, report=notes.append)
    yield from notes
    volume = model.encode(points)
    yield f"encoded {len(points.positions)} points of {cloud}"
    for i, azimuth in enumerate(np.arange(views) * 360 / max(views, 1)):
        stem = f"{cloud.stem}_{i:03d}"
        rendering = model.render(volume, model.camera(volume, float(azimuth) + 30, elevation, resolution), quality)
        images.write_whole(out / f"{stem}.png", images.png(np.asarray(rendering.image)))
        for kind, picture in (
            ("depth", images.depth_image(rendering.depth, rendering.acc)),
            ("acc", np.repeat(np.asarray(rendering.acc)[..., None], 3, axis=-1)),
        ):
            images.write_whole(out / f"{stem}_{kind}.png", images.png(picture))
        yield f"wrote {out / stem}.png"
    if turntable != "none":
        film = turntable_frames(model, volume, frames, elevation, resolution, quality)
        path, reason = images.write_turntable(out / f"{cloud.stem}_turntable.{turntable}", film, FRAMES_PER_SECOND)
        yield f"wrote {path}" + (f" ({reason})" if reason else "")


def turntable_frames(
    model: Model, volume: Volume, frames: int, elevation: float, resolution: int | None, quality: Quality
) -> list[np.ndarray]:
    """Images of one turn around the object."""
    azimuths = np.arange(frames) * 360 / frames
    cameras = (model.camera(volume, float(azimuth), elevation, resolution) for azimuth in azimuths)
    return [np.asarray(model.render(volume, camera, quality).image) for camera in cameras]
