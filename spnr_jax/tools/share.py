"""A file of points in, its object out: Gaussian splats or a mesh for viewers and engines, or one page for any browser.

Splats have y up, the units of the cloud's file and, unless float32 is too coarse there, its origin.
"""

import base64
import html
import io
import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import numpy as np
from PIL import Image

from spnr_jax.errors import UserError
from spnr_jax.formats import images
from spnr_jax.formats.gaussian_files import check_suffix, spz_of, write_splats
from spnr_jax.kernels.records import Camera, Gaussians
from spnr_jax.method.model import FIELD_OF_VIEW
from spnr_jax.tools import surfaces
from spnr_jax.tools.commands import Export, Render, Share
from spnr_jax.tools.pictures import Ready, load_network, make_note, prepare_cloud

MOST_BYTES = 6_000_000  # of a page
POSTER_QUALITY = 88  # of its JPEG

Say = Callable[[str], None]


def export_object(options: Export, note: Say, report: Say) -> None:
    """Writes a cloud's mesh or splats; `note` gets the assumptions about the cloud, `report` a line after each step."""
    asked = as_rendered(options, options.run, options.network)
    if options.mesh is None:
        assert options.splats is not None
        check_suffix(options.splats)
        ready = prepare_cloud(asked, note, load_network(asked))
        made = _splats(ready, asked, note, report)
        size = write_splats(options.splats, made, make_note(asked))
        report(f"wrote {options.splats} ({len(made.opacity):,} splats, {size / 1e6:.1f} MB)")
        return
    if options.mesh.suffix.lower() != ".glb":
        raise UserError(f"{options.mesh}: a mesh is written as .glb, not {options.mesh.suffix or 'a folder'}")
    images.check_place(options.mesh)
    ready = prepare_cloud(asked, note, load_network(asked))
    solid = surfaces.mesh_of_volume(ready.model, ready.volume, ready.placed)
    images.write_whole(options.mesh, solid.content)
    report(f"wrote {options.mesh} ({surfaces.describe(solid)}, {len(solid.content) / 1e6:.1f} MB)")


def as_rendered(options: Export | Share, cloud: Path, run: Path | None) -> Render:
    """What the options ask of a cloud, as those of `spnr render`."""
    return Render(
        cloud=cloud,
        run=run,
        num_points=options.num_points or Render.num_points,
        up=options.up,
        clean=options.clean,
        lighting=options.lighting,
        making=options.making,
    )


def share(options: Share, note: Say, report: Say) -> None:
    """Writes the page of a cloud; `note` gets the assumptions about the cloud, `report` a line after each step."""
    images.check_place(options.out)
    asked = as_rendered(options, options.cloud, options.run)
    ready = prepare_cloud(asked, note, load_network(asked))
    gaussians = _splats(ready, asked, note, report)
    camera = ready.model.camera(ready.volume, options.azimuth, options.elevation, surfaces.RESOLUTION)
    poster = np.asarray(ready.model.render(ready.volume, camera, light=ready.light).image)
    said = " · ".join(filter(None, [make_note(asked), options.credit]))
    view = (options.azimuth, options.elevation)
    content = page(gaussians, poster, camera, view, options.title or options.cloud.stem, said)
    images.write_whole(options.out, content)
    report(f"wrote {options.out} ({len(gaussians.opacity):,} splats, {len(content) / 1e6:.1f} MB)")


def _splats(ready: Ready, asked: Render, note: Say, report: Say) -> Gaussians:
    given = ready.model, ready.volume, ready.placed.cloud, ready.light
    gaussians = surfaces.splats_of(*given, report, **asked.making.asked, resolution=surfaces.RESOLUTION)
    if (origin := ready.placed.origin).any():
        note(f"splats lie around the origin; it is at {' '.join(f'{x:.0f}' for x in origin)} in the file")
    return gaussians


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
    content = (first + "".join(parts.get(piece, piece) for piece in others)).encode(errors="replace")
    if len(content) > MOST_BYTES:
        raise UserError(
            f"the page would be {len(content) / 1e6:.1f} MB, at most {MOST_BYTES / 1e6:.0f}; "
            "ask for fewer splats (--most-splats) or plainer ones (--harmonics 0)"
        )
    return content
