"""What is lost when a network's object becomes Gaussian splats, or a mesh?

    python -m experiments.studies.splat_quality --data DIR --out OUT [--objects 4] [--views 2] [--seconds 5 20]

The network draws test objects of a data set at its cameras; so do their splats (`spnr_jax.splats`), drawn by this
package (gaussians/drawing.py) after so many seconds of refining each, and the last of them by Mitsuba
(`volprim_rf_basic` on the .ply that the package writes: a reader and a renderer that share nothing with it); and the
mesh of `spnr export --mesh`, which Mitsuba draws in the data set's own light.  Each is compared with the reference, and
the others with the network.

    OUT/results.json  OUT/table.md   PSNR of whole pictures and inside the silhouettes, by size and by object
    OUT/gallery.png                            reference, network, splats, mesh at the largest size; megabytes, s, dB

An object's scores are kept in OUT/scores, so objects can be asked for one at a time (--names), and then all together.
Refining ends by the clock.  On a machine that does much else, --step-seconds says what a step is to count for: what it
takes on that machine alone.
"""

import dataclasses
import itertools
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import mitsuba
import numpy as np

from data_gen.render.variant import LLVM, choose_variant
from experiments import entry_point
from experiments.comparison import figures, poisson, results_folder, splats_by_mitsuba
from experiments.comparison.object_views import Picture, at, drawn, few, on_white, told, view_of
from experiments.studies.splat_quality_report import BY_MITSUBA, MESH, after, caption, methods_of, tables_of
from spnr_jax.devices import machine
from spnr_jax.errors import UserError
from spnr_jax.formats import data_sets, gaussian_files, images
from spnr_jax.formats.clouds import PlacedCloud
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.formats.mesh.meshes import load_mesh
from spnr_jax.gaussians import drawing
from spnr_jax.gaussians.placing import View
from spnr_jax.kernels.metrics import psnr
from spnr_jax.kernels.records import Gaussians, PointCloud, Volume
from spnr_jax.method.model import Model
from spnr_jax.scoring.picture_scores import sharpness
from spnr_jax.tools import fused_surface, mesh_export, splat_making
from spnr_jax.tools.splat_making import drawn_views, fitting_cameras, in_box
from spnr_jax.training.weights import load

SIZES = (128, 512)


@dataclass(frozen=True, kw_only=True)
class SplatStudy:
    """Splats beside the network that they come from."""

    data: Path
    """Folder of a data set."""
    out: Path
    """Folder of the results; the same command goes on there."""
    run: str = "surfels"
    """Network: of the package, a run folder or a file of weights."""
    num_points: int = 16384
    """Points of an object, the first of its file."""
    objects: int = 4
    """Test objects, evenly out of all."""
    names: tuple[str, ...] = ()
    """Test objects by their names (default: by their number)."""
    views: int = 2
    """Views of an object."""
    sizes: tuple[int, ...] = SIZES
    """Pixels along each side."""
    seconds: tuple[float, ...] = (5.0, 20.0)
    """Seconds of refining, each from the beginning."""
    step_seconds: float | None = None
    """Seconds that a step of it counts for (default: those that it takes)."""
    most: int = 80_000
    """Splats of an object at most."""
    degree: int = 1
    """Of their spherical harmonics."""
    fitting_views: int = 32
    """Pictures that splats are made from."""
    fitting_resolution: int = 512
    """Pixels of these along each side."""
    spp: int = 16
    """Rays a pixel of Mitsuba's pictures."""

    @property
    def methods(self) -> tuple[str, ...]:
        """What is compared."""
        return methods_of(self.seconds)


def main(options: SplatStudy) -> None:
    """Makes, draws, scores and writes."""
    dataset = data_sets.open_dataset(options.data)
    everyone = dataset.splits["test"]
    names = options.names or everyone[:: max(len(everyone) // options.objects, 1)][: options.objects]
    asked = {k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(options).items()}
    which = ("out", "names", "objects")  # those that are made in one go
    variant = choose_variant()[0]
    if variant != LLVM:
        raise UserError(f"Mitsuba draws splats in {LLVM} alone, which does not run here; install LLVM 17 or newer")
    results_folder.claim(options.out, "splat_quality", {k: v for k, v in asked.items() if k not in which}, dataset)
    mitsuba.set_variant(variant)
    renderer, rows = poisson.Renderer(dataset.settings, variant=variant), dict[str, dict]()
    model = load(options.run)
    for part, scores in ("splats", _splat_scores), ("mesh", partial(_mesh_scores, renderer)):
        for name in names:
            item = data_sets.read_object(dataset, name)
            place = options.out / "scores" / f"{name}_{part}.json"
            found = results_folder.kept(place, partial(scores, options, model, item))
            rows[name] = rows.get(name, {}) | found
            print(name, found, flush=True)
    cells = [[_shown(options, name, method) for method in ("reference", *options.methods)] for name in names]
    captions = [["", *(caption(rows[name], method, options.sizes[-1]) for method in options.methods)] for name in names]
    picture = figures.grid(cells, ("reference", *options.methods), names, size=256, below=captions)
    images.write_whole(options.out / "gallery.png", images.png(picture))
    tables = tables_of(rows, options.seconds, options.sizes, options.views)
    results_folder.write(options.out, {"objects": rows, "hardware": machine.hardware()}, tables)


def _splat_scores(options: SplatStudy, model: Model, item: data_sets.ObjectData) -> dict:
    """Decibels by size and method; splats, megabytes as .spz, steps and seconds of each making."""
    cloud = _cloud(options, item)
    volume = model.encode(cloud)
    pictures, splats, found = _pictures(options, model, volume, item.name), {}, {}
    for seconds in options.seconds:
        splats[after(seconds)], found[f"{after(seconds)}, made"] = _made(options, pictures, volume, cloud, seconds)
    last, place = splats[after(options.seconds[-1])], options.out / f"{item.name}.ply"
    for size in options.sizes:
        cameras = [view_of(item, view, size)[0] for view in range(options.views)]
        shown = {name: [drawing.draw(made, camera) for camera in cameras] for name, made in splats.items()}
        shown[BY_MITSUBA] = [splats_by_mitsuba.drawn(last, camera, options.spp, place) for camera in cameras]
        found |= _compared(options, model, volume, item, size, shown)
    place.unlink()
    return found


def _mesh_scores(renderer: poisson.Renderer, options: SplatStudy, model: Model, item: data_sets.ObjectData) -> dict:
    """Decibels of the mesh by size; its faces, megabytes as .glb and seconds."""
    cloud = _cloud(options, item)
    volume = model.encode(cloud)
    asset, found = _meshed(_pictures(options, model, volume, item.name), volume, cloud)
    # where the network shows no surface the pictures are empty
    nothing = np.zeros(item.images[: options.views].shape, np.uint8)
    pictures = renderer.drawn(asset, few(item, options.views)) if asset else nothing
    for size in options.sizes:
        found |= _compared(options, model, volume, item, size, {MESH: [on_white(at(rgba, size)) for rgba in pictures]})
    return found


def _cloud(options: SplatStudy, item: data_sets.ObjectData) -> PointCloud:
    return told(data_sets.first_points(item, options.num_points), normals=False)


def _compared(
    options: SplatStudy,
    model: Model,
    volume: Volume,
    item: data_sets.ObjectData,
    size: int,
    made: dict[str, list[Picture]],
) -> dict:
    """Decibels of pictures at the object's first cameras, and of the network's there; the first of each is written."""
    cameras, references = zip(*(view_of(item, view, size) for view in range(options.views)), strict=True)
    network = drawn(model, volume, cameras)
    reference = data_sets.on_white(images.to_uint8(references[0]))
    images.write_whole(options.out / item.name / "reference.png", images.png(reference))
    found = {}
    for method, shown in {"network": network, **made}.items():
        found[f"{method}, {size}"] = _scored(shown, list(references), network)
        images.write_whole(options.out / item.name / f"{method}.png", images.png(shown[0][0]))
    return found


def _made(
    options: SplatStudy, pictures: list[View], volume: Volume, cloud: PointCloud, seconds: float
) -> tuple[Gaussians, dict]:
    """The splats in the box, their number, the megabytes as .spz, steps of refining and the seconds of all that."""
    begin = time.perf_counter()
    made, steps = splat_making.placed(pictures, volume, cloud, options.degree, options.most), 0
    placed = time.perf_counter() - begin
    if seconds > 0:
        each = options.step_seconds
        clock = time.monotonic if each is None else partial(next, itertools.count(0, each))
        made, steps = splat_making.refined(made, pictures, seconds, clock)
    spz = len(gaussian_files.spz_of(made)) / 1e6
    took = {"placing_seconds": placed, "seconds": time.perf_counter() - begin}
    return made, {"splats": len(made.opacity), "spz_mb": spz, "steps": steps} | took


def _meshed(views: Sequence[View], volume: Volume, cloud: PointCloud) -> tuple[Asset | None, dict]:
    """The mesh that `spnr export --mesh` writes, read from its file, and what it is; None without a surface."""
    begin, placed = time.perf_counter(), PlacedCloud(cloud=cloud, up="y", rotation=np.eye(3), origin=np.zeros(3))
    try:
        solid = mesh_export.mesh_of(fused_surface.solidity(views, volume, placed), placed)
    except UserError as error:
        return None, {"faces": 0, "glb_mb": 0.0, "watertight": False, "empty": str(error), "mesh_seconds": 0.0}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.glb"
        path.write_bytes(solid.content)
        asset = load_mesh(path)
    found = {"faces": solid.faces, "glb_mb": len(solid.content) / 1e6, "watertight": solid.watertight, "empty": ""}
    return asset, found | {"mesh_seconds": time.perf_counter() - begin}


def _scored(shown: list[Picture], references: list[np.ndarray], of_network: list[Picture]) -> dict[str, float]:
    """Mean decibels of some views: whole, inside the silhouettes, and against the network's pictures."""
    scores = [sharpness(*picture, reference) for picture, reference in zip(shown, references, strict=True)]
    own, networks = (jnp.stack([image for image, _ in of]) for of in (shown, of_network))
    return {
        "psnr": float(np.mean([s.psnr for s in scores])),
        "inside": float(np.nanmean([s.psnr_inside for s in scores])),
        "network": float(jnp.mean(psnr(own, networks))),
    }


def _pictures(options: SplatStudy, model: Model, volume: Volume, name: str) -> list[View]:
    """The network's pictures that splats are made from; they take longest, so they are kept."""
    cameras = fitting_cameras(model, volume, options.fitting_views, options.fitting_resolution)

    def made() -> tuple[np.ndarray, ...]:
        views = drawn_views(model, volume, cameras, None)
        return tuple(np.stack(x) for x in zip(*((v.image, v.opacity, v.depth) for v in views), strict=True))

    arrays = results_folder.kept(options.out / name / "pictures.npz", made)
    inside = [in_box(camera, volume) for camera in cameras]
    return [View(*each) for each in zip(inside, *arrays, strict=True)]


def _shown(options: SplatStudy, name: str, method: str) -> np.ndarray:
    return results_folder.kept(options.out / name / f"{method}.png", lambda: None)


if __name__ == "__main__":
    entry_point.run(main, SplatStudy, "studies.splat_quality")
