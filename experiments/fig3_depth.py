"""Figure 3, and beyond: depth maps of unseen objects beside the true depth, their errors, and floaters.

    python -m experiments.fig3_depth --data DIR --out DIR --runs RUN ... [--table1 DIR] [--surfaces poisson ...]

The truth is ray casting of the very meshes that the references were rendered from, made again from the data set's
records, along the rays of each method: its own pixels, through its own pixel centres.

    OUT/truth/SIZE/ID.npz      true distances of all views, inf beside the object
    OUT/depths/METHOD/ID.npz   a method's depth and opacity
    OUT/results.json           every metric (experiments/depth_scores.py), with intervals, and the conditions
    OUT/table.md  OUT/fig3_depth.png

What is there is kept, so the same command goes on where it was stopped.  It draws no random numbers.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import tyro

from data_gen.render import depth, poisson_surface
from data_gen.render.variant import choose_variant, mitsuba_module
from experiments import claims, depth_scores, methods, sheets
from experiments.depth_scores import METRICS, OPAQUE
from experiments.methods import Sources
from experiments.source_meshes import mesh_of
from experiments.table1_poisson import SURFACES
from experiments.table1_report import LABELS
from spnr_jax import cli
from spnr_jax.devices import machine
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import depth_image, npz, png, write_whole
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, PointCloud
from spnr_jax.scoring import evaluation
from spnr_jax.training import run_record

FLOATER, MISSED = np.array([0.85, 0.1, 0.1]), np.array([0.15, 0.35, 0.85])
WORST = 0.2  # error, in half diagonals, that the picture shows black
NOTE = (
    "Distances are along the rays, in half diagonals of the object's box. Means over views with 95 % bootstrap "
    "intervals over objects. Errors where a method is opaque inside the true silhouette: of the depth as it is "
    "rendered, which counts what nothing stops at the far side of the box, and of what is opaque alone. Floaters are "
    "opaque pixels outside the silhouette, far ones farther from it than 1/32 of the picture."
)

Shown = Callable[[data_sets.ObjectData, PointCloud], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, kw_only=True)
class Fig3:
    """Depth maps of unseen objects, and how far they are from the truth."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the results; the same command goes on there."""
    sources: tyro.conf.OmitArgPrefixes[Sources] = field(default_factory=Sources)
    surfaces: tuple[Literal["poisson", "poisson_trimmed"], ...] = ()
    """Poisson surfaces to compare with: made of the same points."""
    meshes: Path | None = None
    """Folder of the mesh files that the data set was made from, if it was."""
    objects: int | None = None
    """Test objects, spread over the split (default: all)."""
    shown: int = 8
    """Objects in the picture."""
    variant: str = "auto"
    """Mitsuba variant: scalar_rgb, llvm_ad_rgb, or auto for the faster one that works here."""
    quick: bool = False
    """A check that everything works: two objects."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """How a method shows depth and opacity of an object, and what tells it from another one."""

    show: Shown
    identity: dict


def main(options: Fig3) -> None:
    """Makes what is missing of depths and truth, then scores, table and picture."""
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = methods.test_objects(dataset, 2 if options.quick else options.objects)
    claims.claim(options.out / "fig3.json", {"data": run_record.checksum(dataset)}, "depths")
    networks = methods.networks(options.sources, dataset)
    if left_out := [name for name, network in networks.items() if not network.has_depth]:
        print(f"left out, since they predict no depth: {', '.join(left_out)}")
    points = next(iter(networks.values())).config.test_points
    found = {name: of_network(network) for name, network in networks.items() if network.has_depth}
    found |= {LABELS[name]: of_surface(SURFACES[name]) for name in options.surfaces}
    if not found:
        raise ValueError("--runs: none of these predicts depth; name a run of another method, or --surfaces")
    mitsuba_module(choose_variant(options.variant)[0])
    for label, method in found.items():
        asked = method.identity | {"points": points}
        claims.claim(options.out / "depths" / label / "made.json", asked, f"depths of {label}")
    scores: dict[str, list] = {name: [] for name in found}
    rows, shown = [], evaluation.spread(names, options.shown)
    for number, name in enumerate(names, start=1):
        item = data_sets.read_object(dataset, name)
        maps = object_maps(options, dataset, item, found, points)
        for label, (seen, acc, truth) in maps.items():
            scores[label].append(depth_scores.scores(seen, acc, far_side(item.camera, truth.shape[1:]), truth))
        if name in shown:
            rows.append(picture_row(item, maps, scores))
        print(f"{number} of {len(names)}: {name}", flush=True)
    results = {
        "methods": {name: depth_scores.summarise(rows) for name, rows in scores.items()},
        "made of": {name: method.identity for name, method in found.items()},
        "points": points,
        "objects": list(names),
        "views": len(next(iter(maps.values()))[2]),
        "pixels": {method: truth.shape[-1] for method, (_, _, truth) in maps.items()},
        "hardware": machine.hardware(),
        "data": dataset.settings.get("settings", {}),
        "seed": "nothing is drawn: samples lie at the middles of their strata",
    }
    write_whole(options.out / "results.json", (json.dumps(results, indent=1, allow_nan=False) + "\n").encode())
    write_whole(options.out / "table.md", table(results).encode())
    if rows:
        heads = ["Reference", "True depth", *(f"{name}{end}" for name in found for end in (", depth", ", error"))]
        picture = sheets.grid([cells for _, cells in rows], heads, [label for label, _ in rows], 128)
        write_whole(options.out / "fig3_depth.png", png(picture))
    print(table(results))
    print(f"wrote results.json, table.md and fig3_depth.png in {options.out}")


def of_network(network: methods.Network) -> Method:
    """The depth that a network renders."""

    def show(item: data_sets.ObjectData, cloud: PointCloud) -> tuple[np.ndarray, np.ndarray]:
        pictures = evaluation.on_host(network.show()(cloud, item.camera))
        assert pictures.depth is not None
        return np.asarray(pictures.depth), np.asarray(pictures.acc)

    return Method(show=show, identity=network.identity)


def of_surface(config: poisson_surface.PoissonConfig) -> Method:
    """The depth of a surface that is made of the points; nothing where they span none."""

    def show(item: data_sets.ObjectData, cloud: PointCloud) -> tuple[np.ndarray, np.ndarray]:
        try:
            asset = poisson_surface.reconstruct(jax.tree.map(np.asarray, cloud), config)
        except poisson_surface.NoSurface:
            return (np.zeros(item.images.shape[:3], np.float32),) * 2
        found = cast_views(depth.caster(asset), item.camera)
        hit = np.isfinite(found)
        return np.where(hit, found, 0), hit.astype(np.float32)

    return Method(show=show, identity=asdict(config))


def object_maps(
    options: Fig3, dataset: data_sets.Dataset, item: data_sets.ObjectData, found: dict[str, Method], points: int
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Depth, opacity and true depth (views, h, w) of an object by method; read where they are made."""
    cloud = data_sets.first_points(item, points)
    maps = {}
    for name, method in found.items():
        seen, acc = kept(options.out / "depths" / name / f"{item.name}.npz", partial(method.show, item, cloud))
        size, place = seen.shape[1:], options.out / "truth" / f"{seen.shape[-1]}" / f"{item.name}.npz"
        (truth,) = kept(place, partial(true_depth, dataset, item, options.meshes, size))
        maps[name] = (seen, acc, truth)
    return maps


def true_depth(
    dataset: data_sets.Dataset, item: data_sets.ObjectData, meshes: Path | None, size: tuple[int, ...]
) -> tuple[np.ndarray]:
    """Distances (views, *size) to the mesh that the object was made from."""
    cast = depth.caster(mesh_of(dataset, item, meshes))
    return (cast_views(cast, cameras.resize(item.camera, *size)),)


def kept(path: Path, make: Callable[[], tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    """The arrays of a file, which is made if it is not there."""
    if not path.is_file():
        write_whole(path, npz(*make()))
    with np.load(path, allow_pickle=False) as arrays:
        return tuple(arrays[name] for name in arrays.files)


def cast_views(cast: depth.Caster, camera: Camera) -> np.ndarray:
    """Distances (views, h, w) along the camera's rays, inf where they miss."""
    rays = jax.tree.map(np.asarray, cameras.camera_rays(camera))
    return cast(rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3)).reshape(rays.origins.shape[:3])


def far_side(camera: Camera, size: tuple[int, ...]) -> np.ndarray:
    """Distances (views, *size) to the far side of the box, where rendered depths count what nothing stops."""
    rays = cameras.camera_rays(cameras.resize(camera, *size))
    return np.asarray(cameras.intersect_box(rays.origins, rays.directions)[1])


def picture_row(item: data_sets.ObjectData, maps: dict, scores: dict[str, list]) -> tuple[str, list[np.ndarray]]:
    """Reference, truth, and depth and error of each method, in the view whose error is the first method's median."""
    first = np.nan_to_num(next(iter(scores.values()))[-1]["error"], nan=np.inf)
    view = evaluation.median_view(first)
    finest = max((truth[view] for _, _, truth in maps.values()), key=len)
    inside = np.isfinite(finest)
    span = (float(finest[inside].min()), float(finest[inside].max())) if inside.any() else (0.0, 1.0)
    cells = [data_sets.on_white(item.images[view])]
    cells.append(depth_image(np.where(inside, finest, 0), inside, span))
    for seen, acc, truth in maps.values():
        cells += [depth_image(seen[view], acc[view], span), error_image(seen[view], acc[view], truth[view])]
    return f"{item.name}, view {view}", cells


def error_image(seen: np.ndarray, acc: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The error in grey (h, w, 3), black from WORST on; floaters red, what is missed blue."""
    inside, opaque = np.isfinite(truth), acc > OPAQUE
    grey = 1 - np.clip(np.abs(seen - np.where(inside, truth, 0)) / WORST, 0, 1)
    picture = np.where((inside & opaque)[..., None], grey[..., None], np.ones(3))
    picture[inside & ~opaque] = MISSED
    picture[~inside & opaque] = FLOATER
    return picture


def table(results: dict) -> str:
    """Markdown of the metrics, and how they were measured."""
    heads = ["method", "pixels", *(head for head, _, _ in METRICS.values())]
    lines = [f"| {' | '.join(heads)} |", "|---|" + "---:|" * (len(heads) - 1)]
    for name, found in results["methods"].items():
        cells = [number(found[metric], decimals, factor) for metric, (_, decimals, factor) in METRICS.items()]
        lines.append(f"| {name} | {results['pixels'][name]} | {' | '.join(cells)} |")
    place = (
        f"{len(results['objects'])} unseen objects x {results['views']} views, {results['points']} points; "
        f"{results['hardware']}."
    )
    return (
        "\n".join(
            [
                *lines,
                "",
                NOTE,
                place,
                f"In the picture: errors in grey, black from {WORST:g} on; floaters red, missed pixels blue.",
            ]
        )
        + "\n"
    )


def number(found: dict, decimals: int, factor: float) -> str:
    """A mean and its interval as a cell."""
    if found["mean"] is None:
        return "n/a"
    ends = (
        ""
        if found["interval"] is None
        else " [{}, {}]".format(*(f"{factor * end:.{decimals}f}" for end in found["interval"]))
    )
    return f"{factor * found['mean']:.{decimals}f}{ends}"


if __name__ == "__main__":
    sys.exit(cli.guarded(lambda: main(tyro.cli(Fig3, prog="python -m experiments.fig3_depth")), "fig3_depth"))
