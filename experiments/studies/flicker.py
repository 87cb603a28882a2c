"""Does the picture hold still while the camera moves?  Flicker of each method over a turntable, beside the references'.

    python -m experiments.studies.flicker --data DIR --out DIR --runs RUN ... [--meshes DIR]

A pixel of frame t + 1 that meets the true mesh shows a place of it; where frame t sees the same place, the two should
have one colour, but for highlights, which move.  Flicker is the mean absolute difference of sRGB over such pixels and
all pairs of neighbouring frames; the references' own is what light, noise and resampling leave.

    OUT/frames/ID.npz     references (frames, h, w, 3) and true distances, made once
    OUT/results.json      flicker of each method by object, and its ratio to the references', with intervals
    OUT/table.md  OUT/flicker.png  OUT/ID.gif   the table, flicker by frame, the turntables side by side
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure
from scipy.ndimage import map_coordinates

from data_gen.render import depth, light, views
from data_gen.render.variant import choose_variant, mitsuba_module
from experiments import entry_point
from experiments.comparison import figures, results_folder, trained_networks
from experiments.comparison.poisson import unscaled_light, view_config
from experiments.comparison.source_meshes import cast_views, mesh_of
from experiments.comparison.trained_networks import Network, Sources
from spnr_jax import cli
from spnr_jax.devices import machine
from spnr_jax.errors import UserError, at_least
from spnr_jax.formats import data_sets
from spnr_jax.formats.images import to_uint8, write_turntable
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera
from spnr_jax.scoring import evaluation, intervals
from spnr_jax.scoring.score_tables import Table, number, text

SAME_PLACE = 0.01  # half diagonals that what frame t sees there may be nearer or farther than the place
REFERENCE = "references"
ALLOWED = 1.2  # of the references' flicker


@dataclass(frozen=True, kw_only=True)
class Flicker:
    """Flicker of networks over turntables of unseen objects, beside that of the references."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder of the results; the same command goes on there."""
    sources: tyro.conf.OmitArgPrefixes[Sources] = field(default_factory=Sources)
    meshes: Path | None = None
    """Folder of the mesh files that the data set was made from, if it was."""
    envmap: Path | None = None
    """Environment map that lit the data set, if it was a file."""
    objects: int = 4
    """Test objects, spread over the split."""
    frames: int = 120
    """Frames of a whole turn."""
    elevation: float = 20.0
    """Degrees of the cameras above the horizon."""
    spp: int = 256
    """Samples per pixel of the references; their noise flickers too."""
    variant: str = "auto"
    """Mitsuba variant: scalar_rgb, llvm_ad_rgb, or auto for the faster one that works here."""


def main(options: Flicker) -> None:
    """Makes what is missing of the references, then frames, scores and pictures."""
    at_least(options, 3, "frames")
    cli.set_up_jax()
    dataset = data_sets.open_dataset(options.data)
    names = trained_networks.test_objects(dataset, options.objects)
    trained = trained_networks.networks(options.sources, dataset)
    asked = {name: getattr(options, name) for name in ("frames", "elevation", "spp")}
    results_folder.claim(options.out, "turntables", asked, dataset)
    mitsuba_module(choose_variant(options.variant)[0])
    camera = turntable(data_sets.read_object(dataset, names[0]).camera, options.frames, options.elevation)
    curves: dict[str, list[np.ndarray]] = {name: [] for name in (REFERENCE, *trained)}
    for count, name in enumerate(names, start=1):
        for label, curve in object_curves(options, dataset, name, trained, camera).items():
            curves[label].append(curve)
        print(f"{count} of {len(names)}: {name}", flush=True)
    found = summarise(curves, names) | asked | {"hardware": machine.hardware(), "pixels": camera.width}
    results_folder.write(options.out, found, [table(found)], [], {"flicker.png": plot(curves, names)})


def object_curves(
    options: Flicker, dataset: data_sets.Dataset, name: str, trained: dict[str, Network], camera: Camera
) -> dict[str, np.ndarray]:
    """Flicker from frame to frame of one object by method; its turntables are written side by side."""
    item = data_sets.read_object(dataset, name)
    place = options.out / "frames" / f"{name}.npz"
    references, distances = results_folder.kept(place, partial(true_frames, options, dataset, item, camera))
    shown = {REFERENCE: references.astype(np.float32) / 255}
    shown |= {label: frames_of(network, item, camera) for label, network in trained.items()}
    found = {label: flicker(frames, distances, camera) for label, frames in shown.items()}
    if np.isnan(found[REFERENCE]).all():
        raise UserError(f"--frames {options.frames}: neighbouring ones see no place of {name} in common; take more")
    strip = [np.concatenate([frames[i] for frames in shown.values()], axis=1) for i in range(options.frames)]
    write_turntable(options.out / f"{name}.gif", strip, fps=24)
    return found


def turntable(like: Camera, frames: int, elevation: float) -> Camera:
    """Cameras of a whole turn at equal angles about the y axis, at the data set's distance and field of view."""
    distance = float(np.linalg.norm(np.asarray(like.cam_to_world)[0, :, 3]))
    angles = jnp.linspace(0, 2 * np.pi, frames, endpoint=False)
    pose = jax.vmap(lambda angle: cameras.orbit(angle, jnp.deg2rad(elevation), distance, jnp.zeros(3)))(angles)
    intrinsics = np.broadcast_to(np.asarray(like.intrinsics)[0], (frames, 3, 3))
    return replace(like, cam_to_world=np.asarray(pose), intrinsics=intrinsics)


def true_frames(
    options: Flicker, dataset: data_sets.Dataset, item: data_sets.ObjectData, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """References on white (frames, h, w, 3) uint8 and distances to the mesh (frames, h, w), inf beside it."""
    asset = mesh_of(dataset, item, options.meshes)
    scene = views.build_scene(asset, light_of(dataset, options.envmap))
    config = replace(view_config(dataset.settings), spp=options.spp)
    poses = np.tile(np.eye(4), (len(camera.cam_to_world), 1, 1))
    poses[:, :3] = camera.cam_to_world
    pictures = [views.straight_srgb(views.render_view(scene, pose, config, i)) for i, pose in enumerate(poses)]
    references = to_uint8(np.stack([data_sets.on_white(picture) for picture in pictures]))
    return references, cast_views(depth.caster(asset), camera)


def light_of(dataset: data_sets.Dataset, envmap: Path | None) -> np.ndarray:
    """The scaled environment map (height, width, 3) of the data set."""
    return light.scaled_to_white(unscaled_light(dataset.settings["environment_map"], envmap))


def frames_of(network: Network, item: data_sets.ObjectData, camera: Camera) -> np.ndarray:
    """The network's pictures (frames, h, w, 3) of the object's first points, ten frames at a time."""
    cloud, show = data_sets.first_points(item, network.config.test_points), network.show()
    parts = []
    for start in range(0, len(camera.cam_to_world), 10):
        few = jax.tree.map(lambda x, start=start: x[start : start + 10], camera)
        parts.append(evaluation.on_host(show(cloud, few)).image)
    return np.concatenate(parts)


def flicker(frames: np.ndarray, distances: np.ndarray, camera: Camera) -> np.ndarray:
    """Mean absolute difference (frames - 1,) between each frame and the one before, at places that both see."""
    rays = jax.tree.map(np.asarray, cameras.camera_rays(camera))
    found = []
    for t in range(len(frames) - 1):
        hit = np.isfinite(distances[t + 1])
        places = rays.origins[t + 1][hit] + distances[t + 1][hit][:, None] * rays.directions[t + 1][hit]
        before = jax.tree.map(lambda x, t=t: np.asarray(x)[t], camera)
        pixels, away = jax.tree.map(np.asarray, cameras.project(before, jnp.asarray(places)))
        at = pixels[:, ::-1].T - 0.5  # rows, columns of pixel centres
        same = np.abs(farthest_around(distances[t], at) - away) < SAME_PLACE
        earlier = np.stack([map_coordinates(frames[t][..., c], at, order=1, mode="nearest") for c in range(3)], axis=1)
        found.append(np.abs(frames[t + 1][hit] - earlier)[same].mean() if same.any() else np.nan)
    return np.array(found)


def farthest_around(distances: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The largest of the four distances around each place (2, n) in rows and columns: inf at the object's outline."""
    corners = np.floor(at).astype(int)[:, None] + np.array([[0, 0, 1, 1], [0, 1, 0, 1]])[:, :, None]
    rows, columns = np.clip(corners, 0, len(distances) - 1)
    return distances[rows, columns].max(axis=0)


def summarise(curves: dict[str, list[np.ndarray]], names: Sequence[str]) -> dict:
    """Mean flicker of every method by object and over all, and its ratio to the references', with intervals."""
    means = {label: np.array([np.nanmean(curve) for curve in found]) for label, found in curves.items()}
    rows = {}
    for label, found in means.items():
        ratios = found / means[REFERENCE]
        ends = intervals.interval([np.array([ratio]) for ratio in ratios])
        rows[label] = {
            "flicker": float(found.mean()),
            "ratio": float(ratios.mean()),
            "interval": ends,
            "objects": dict(zip(names, found.tolist(), strict=True)),
        }
    return {"methods": rows}


def table(found: dict) -> Table:
    """Flicker of every method, and how it compares with the references'."""
    rows = []
    for label, row in found["methods"].items():
        held = "" if label == REFERENCE else "yes" if row["ratio"] <= ALLOWED else "no"
        cells = number(row["flicker"], 2, factor=255), number(row["ratio"], 2, row["interval"]), text(held)
        rows.append((label, cells))
    count = len(found["methods"][REFERENCE]["objects"])
    note = f"References with {found['spp']} samples a pixel; mean and 95 % intervals over objects; {found['hardware']}."
    return Table(
        title=f"{count} unseen objects x {found['frames']} frames, {found['pixels']} pixels",
        heads=("flicker, of 255", "over the references'", f"at most {ALLOWED:g}"),
        rows=tuple(rows),
        note=note,
    )


@figures.drawing
def plot(curves: dict[str, list[np.ndarray]], names: Sequence[str]) -> Figure:
    """Flicker over the turn, a panel for each object."""
    top = 1.05 * 255 * max(np.nanmax(curve) for found in curves.values() for curve in found)
    figure = Figure(figsize=(3.2 * len(names), 2.6))
    for i, axes in enumerate(np.atleast_1d(figure.subplots(1, len(names), sharey=True))):
        for label, found in curves.items():
            turn = np.linspace(0, 360, len(found[i]), endpoint=False)
            axes.plot(turn, 255 * found[i], label=label, linewidth=1.2)
        axes.set(title=names[i], xlabel="azimuth, degrees", ylim=(0, top))
    axes.legend()
    figure.supylabel("flicker, of 255")
    return figure


if __name__ == "__main__":
    entry_point.run(main, Flicker, "studies.flicker")
