"""A file of points in, Gaussian splats out: as a file for viewers and engines, or as one page for any browser.

What is written has y up, the units of the cloud's file and, unless float32 is too coarse there, its origin.
"""

import base64
import html
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from spnr_jax.errors import UserError
from spnr_jax.formats import clouds, images
from spnr_jax.formats.gaussian_files import check_suffix, spz_of, write_splats
from spnr_jax.kernels.records import Camera, Gaussians, Light, PointCloud, Volume
from spnr_jax.method.model import FIELD_OF_VIEW, Model
from spnr_jax.tools.chosen_light import check_takes_light, light_of_options
from spnr_jax.tools.light_options import Lighting
from spnr_jax.tools.share_command import Share
from spnr_jax.tools.splat_making import RESOLUTION, splats_of
from spnr_jax.tools.splat_options import SplatMaking
from spnr_jax.training.weights import SHIPPED, load

MOST_BYTES = 6_000_000  # of a page
POSTER_QUALITY = 88  # of its JPEG


@dataclass(frozen=True, kw_only=True)
class Made:
    """Splats, what they were made by, and the line that names cloud, network and light."""

    gaussians: Gaussians
    model: Model
    volume: Volume
    light: Light | None
    note: str


def export_splats(
    cloud: Path,
    out: Path,
    *,
    run: Path | None,
    lighting: Lighting,
    making: SplatMaking,
    num_points: int,
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"],
    clean: Literal["auto", "off", "strong"],
    note: Callable[[str], None],
    report: Callable[[str], None],
) -> None:
    """Writes a cloud's splats; `note` gets the assumptions about the cloud, `report` a line after each step."""
    check_suffix(out)
    made = _made(cloud, run, lighting, making, num_points, up, clean, note, report)
    size = write_splats(out, made.gaussians, made.note)
    report(f"wrote {out} ({len(made.gaussians.opacity):,} splats, {size / 1e6:.1f} MB)")


def share(options: Share, note: Callable[[str], None], report: Callable[[str], None]) -> None:
    """Writes the page of a cloud; `note` gets the assumptions about the cloud, `report` a line after each step."""
    images.check_place(options.out)
    arguments = options.lighting, options.making, options.num_points, options.up, options.clean
    made = _made(options.cloud, options.run, *arguments, note, report)
    camera = made.model.camera(made.volume, options.azimuth, options.elevation, RESOLUTION)
    poster = np.asarray(made.model.render(made.volume, camera, light=made.light).image)
    said = " · ".join(filter(None, [made.note, options.credit]))
    view = (options.azimuth, options.elevation)
    content = page(made.gaussians, poster, camera, view, options.title or options.cloud.stem, said)
    images.write_whole(options.out, content)
    report(f"wrote {options.out} ({len(made.gaussians.opacity):,} splats, {len(content) / 1e6:.1f} MB)")


def page(
    gaussians: Gaussians, poster: np.ndarray, camera: Camera, view: tuple[float, float], title: str, note: str
) -> bytes:
    """The page: splats, a picture from `camera`, which stands at `view`, azimuth and elevation in degrees."""
    pose = np.asarray(camera.cam_to_world, np.float64)
    target = np.asarray(gaussians.position, np.float64).mean(axis=0)
    distance = float((pose[:, 3] - target) @ pose[:, 2])
    target = pose[:, 3] - distance * pose[:, 2]  # on the line of sight
    start = {"azimuth": view[0], "elevation": view[1], "distance": distance, "target": target.tolist()}
    jpeg = io.BytesIO()
    Image.fromarray(images.to_uint8(poster)).save(jpeg, "jpeg", quality=POSTER_QUALITY)
    parts = {
        "TITLE": html.escape(title),
        "NOTE": html.escape(note),
        "NAME": html.escape(Path(title).stem or "splats"),
        "POSTER": "data:image/jpeg;base64," + base64.b64encode(jpeg.getvalue()).decode(),
        "CAMERA": json.dumps(start | {"view": float(np.rad2deg(FIELD_OF_VIEW))}),
        "DATA": base64.b64encode(spz_of(gaussians)).decode(),
    }
    text = resources.files("spnr_jax.tools").joinpath("share_page.html").read_text("utf-8")
    first, *others = text.split("@")  # what stands between two is a name: the parts hold any characters
    content = (first + "".join(parts.get(piece, piece) for piece in others)).encode()
    if len(content) > MOST_BYTES:
        raise UserError(
            f"the page would be {len(content) / 1e6:.1f} MB, at most {MOST_BYTES / 1e6:.0f}; "
            "ask for fewer splats (--most-splats) or plainer ones (--harmonics 0)"
        )
    return content


def _made(
    cloud: Path,
    run: Path | None,
    lighting: Lighting,
    making: SplatMaking,
    num_points: int,
    up: str,
    clean: Literal["auto", "off", "strong"],
    note: Callable[[str], None],
    report: Callable[[str], None],
) -> Made:
    """Reads the cloud, loads the network, makes the splats."""
    model = load(run)
    if run:
        check_takes_light(model, lighting.asked, run)
    light = light_of_options(lighting) if lighting.asked else None
    placed = clouds.place_cloud(cloud, num_points=num_points, up=up, clean=clean, report=note)
    volume = model.encode(placed.cloud)
    gaussians = splats_of_volume(model, volume, placed.cloud, light, making, report)
    if placed.origin.any():
        note(f"splats lie around the origin; it is at {' '.join(f'{x:.0f}' for x in placed.origin)} in the file")
    return Made(gaussians=gaussians, model=model, volume=volume, light=light, note=note_of(cloud, run, lighting))


def splats_of_volume(
    model: Model,
    volume: Volume,
    cloud: PointCloud,
    light: Light | None,
    making: SplatMaking,
    report: Callable[[str], None] = lambda line: None,
) -> Gaussians:
    """Splats of a cloud that is encoded already, as the options ask for them."""
    sizes = making.harmonics, making.most_splats, making.fitting_views, RESOLUTION
    return splats_of(model, volume, cloud, light, *sizes, making.seconds, report)


def note_of(cloud: Path, run: Path | None, lighting: Lighting) -> str:
    """The line that names cloud, network and light."""
    return f"{cloud.name}, drawn by spnr_jax ({run.name if run else SHIPPED[0]}), light: {light_name(lighting)}"


def light_name(lighting: Lighting) -> str:
    """The light in words, without folders."""
    parts = [Path(lighting.light).name] if lighting.light else ([] if lighting.sun else ["room"])
    parts += [f"sun {lighting.sun[0]:g} {lighting.sun[1]:g}"] if lighting.sun else []
    options = {"yaw": lighting.light_yaw, "exposure": lighting.exposure}
    return " + ".join(parts) + "".join(f", {name} {value:g}" for name, value in options.items() if value)
