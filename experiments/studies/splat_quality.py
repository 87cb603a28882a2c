"""What is lost when a network's object becomes Gaussian splats?

    python -m experiments.studies.splat_quality --data DIR --out OUT [--objects 4] [--views 2] [--seconds 20]

The network draws test objects of a data set at its cameras; so do their splats (`spnr_jax.splats`), once drawn by this
package (gaussians/drawing.py) and once by Mitsuba (`volprim_rf_basic` on the .ply that the package writes: a reader and
a renderer that share nothing with it).  Each is compared with the reference, and the splats with the network.

    OUT/results.json  OUT/table.md .csv .tex   PSNR of whole pictures and inside the silhouettes, by size
    OUT/gallery.png                            reference, network, both pictures of the splats, at the largest size

Mitsuba draws the scene a hundred times as large: it steps 1e-4 past each hit, and thin splats of a unit scene are
skipped.  It gives no opacity: that is what the same splats in white show.
"""

import dataclasses
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import mitsuba
import numpy as np

from data_gen.render.variant import choose_variant
from experiments import entry_point
from experiments.comparison import figures, results_folder
from experiments.comparison.result_tables import Cell, Table, number
from experiments.studies.sharpness import told, view_of
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets, gaussian_files, images
from spnr_jax.gaussians import drawing
from spnr_jax.gaussians.harmonics import C0
from spnr_jax.gaussians.placing import View
from spnr_jax.kernels.records import Camera, Gaussians
from spnr_jax.method.model import Model, Volume
from spnr_jax.scoring.picture_scores import sharpness
from spnr_jax.tools.splat_making import drawn_views, fitting_cameras, in_box, splats_in_box
from spnr_jax.training.weights import load

LARGER = 100.0  # times, the scene for Mitsuba
METHODS = ("network", "splats", "splats, by Mitsuba")
HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # y up <-> the axes of a .ply of splats
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
    seconds: float = 20.0
    """Seconds of refining."""
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


def main(options: SplatStudy) -> None:
    """Makes, draws, scores and writes."""
    dataset = data_sets.open_dataset(options.data)
    everyone = dataset.splits["test"]
    names = options.names or everyone[:: max(len(everyone) // options.objects, 1)][: options.objects]
    asked = {k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(options).items()}
    results_folder.claim(options.out, "splat_quality", asked | {"out": "", "objects": list(names)}, dataset)
    mitsuba.set_variant(choose_variant()[0])
    model, rows = load(options.run), {}
    for name in names:
        item = data_sets.read_object(dataset, name)
        place = options.out / "scores" / f"{name}.json"
        rows[name] = results_folder.kept(place, partial(_scores, options, model, item))
        print(name, rows[name], flush=True)
    cells = [[_shown(options, name, method) for method in ("reference", *METHODS)] for name in names]
    images.write_whole(
        options.out / "gallery.png",
        images.png(figures.grid(cells, ("reference", *METHODS), names, size=256)),
    )
    results_folder.write(options.out, {"objects": rows, "hardware": machine.hardware()}, [_table(options, rows)])


def _scores(options: SplatStudy, model: Model, item: data_sets.ObjectData) -> dict:
    """Decibels by size and method, the number of splats, the megabytes as .spz, and seconds."""
    cloud = told(jax.tree.map(lambda x: x[: options.num_points], item.cloud), normals=False)
    volume, said = model.encode(cloud), list[str]()
    pictures = _pictures(options, model, volume, item.name)
    begin = time.perf_counter()
    made = splats_in_box(pictures, volume, cloud, options.degree, options.most, options.seconds, said.append)
    spz = gaussian_files.spz_of(made)
    found = {
        "splats": len(made.opacity),
        "spz_mb": len(spz) / 1e6,
        "seconds": time.perf_counter() - begin,
        "said": said,
    }
    for size in options.sizes:
        pairs = [view_of(item, view, size) for view in range(options.views)]
        drawn: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {method: [] for method in METHODS}
        for rendering in model.render_each(volume, [camera for camera, _ in pairs]):
            drawn["network"].append((np.asarray(rendering.image), np.asarray(rendering.acc)))
        for camera, _ in pairs:
            drawn["splats"].append(drawing.draw(made, camera))
            drawn["splats, by Mitsuba"].append(by_mitsuba(made, camera, options.spp, options.out / "mitsuba.ply"))
        for method, shown in drawn.items():
            scores = [sharpness(*picture, reference) for picture, (_, reference) in zip(shown, pairs, strict=True)]
            beside = [_decibels(a[0], b[0]) for a, b in zip(shown, drawn["network"], strict=True)]
            found[f"{method}, {size}"] = {
                "psnr": float(np.mean([s.psnr for s in scores])),
                "inside": float(np.nanmean([s.psnr_inside for s in scores])),
                "network": float(np.mean(beside)),
            }
            images.write_whole(options.out / item.name / f"{method}.png", images.png(shown[0][0]))
        reference = data_sets.on_white(images.to_uint8(pairs[0][1]))
        images.write_whole(options.out / item.name / "reference.png", images.png(reference))
    return found


def _pictures(options: SplatStudy, model: Model, volume: Volume, name: str) -> list[View]:
    """The network's pictures that splats are made from; they take longest, so they are kept."""
    cameras = fitting_cameras(model, volume, options.fitting_views, options.fitting_resolution)

    def drawn() -> tuple[np.ndarray, ...]:
        views = drawn_views(model, volume, cameras, None)
        return tuple(np.stack(x) for x in zip(*((v.image, v.opacity, v.depth) for v in views), strict=True))

    arrays = results_folder.kept(options.out / name / "pictures.npz", drawn)
    inside = [in_box(camera, volume) for camera in cameras]
    return [View(*each) for each in zip(inside, *arrays, strict=True)]


def by_mitsuba(gaussians: Gaussians, camera: Camera, spp: int, place: Path) -> tuple[np.ndarray, np.ndarray]:
    """Picture on white (sRGB) and opacity by Mitsuba, which reads the splats from a .ply at `place`."""
    white = np.zeros_like(gaussians.harmonics)
    white[:, 0] = 0.5 / C0
    light, opacity = (
        _composited(dataclasses.replace(gaussians, harmonics=harmonics), camera, spp, place)
        for harmonics in (gaussians.harmonics, white)
    )
    return light + 1 - opacity, opacity.mean(axis=-1)


def _composited(gaussians: Gaussians, camera: Camera, spp: int, place: Path) -> np.ndarray:
    """Colours (sRGB) weighted by the opacity, (height, width, 3)."""
    larger = dataclasses.replace(gaussians, position=gaussians.position * LARGER, scale=gaussians.scale * LARGER)
    gaussian_files.write_splats(place, larger)
    pose = np.eye(4)
    pose[:3] = camera.cam_to_world
    pose[:3, 3] *= LARGER
    size, focal = camera.width, float(camera.intrinsics[0, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    sensor = {
        "type": "perspective",
        "fov": float(np.rad2deg(2 * np.arctan(0.5 * size / focal))),
        "near_clip": 0.1,
        "far_clip": 1e5,
        "to_world": mitsuba.ScalarTransform4f((HALF_TURN @ pose @ np.diag([-1.0, 1.0, -1.0, 1.0])).astype(np.float32)),
        "film": film | {"component_format": "float32"},
        "sampler": {"type": "multijitter", "sample_count": spp},
    }
    splats_of_file = {"type": "ellipsoids", "filename": str(place)}
    scene = {"type": "scene", "integrator": {"type": "volprim_rf_basic"}, "splats": splats_of_file, "sensor": sensor}
    linear = np.maximum(np.array(mitsuba.render(mitsuba.load_dict(scene), spp=spp)), 0)
    return np.where(linear > 0.0031308, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055, 12.92 * linear)


def _decibels(one: np.ndarray, other: np.ndarray) -> float:
    squared = float(np.mean((one - other) ** 2))
    return 100.0 if squared == 0 else float(-10 * np.log10(squared))


def _shown(options: SplatStudy, name: str, method: str) -> np.ndarray:
    return results_folder.kept(options.out / name / f"{method}.png", lambda: None)


def _table(options: SplatStudy, rows: dict) -> Table:
    """A row for each method and size, means over the objects."""
    made: list[tuple[str, tuple[Cell, ...]]] = []
    for size in options.sizes:
        for method in METHODS:
            found = [row[f"{method}, {size}"] for row in rows.values()]
            means = [float(np.mean([scores[name] for scores in found])) for name in ("psnr", "inside", "network")]
            of_network = number(None if method == "network" else means[2], 1)
            made.append((f"{method}, {size} px", (number(means[0], 2), number(means[1], 2), of_network)))
    mean = {name: np.mean([row[name] for row in rows.values()]) for name in ("splats", "spz_mb")}
    return Table(
        title=f"Splats, {len(rows)} objects x {options.views} views",
        heads=("PSNR, dB", "inside, dB", "against the network, dB"),
        rows=tuple(made),
        note=f"{mean['splats']:,.0f} splats, {mean['spz_mb']:.1f} MB as .spz on average.",
    )


if __name__ == "__main__":
    entry_point.run(main, SplatStudy, "studies.splat_quality")
