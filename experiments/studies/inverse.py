"""What one picture tells of its light, materials, camera and points: the default network, differentiated.

    python -m experiments.studies.inverse --out OUT [--data DIR] [--points 1024] [--size 96] [--steps 100] [--quick]

Four objects at once, under `vmap`: one picture of each is drawn, one thing is made wrong, and Adam (optax) finds it
again from the picture alone, by gradients through `spnr_jax.encode` and `spnr_jax.render`:

    light      nine spherical harmonics of three colours, from a light that is the same from everywhere
    materials  base colour and roughness of every point, from grey
    pose       turned by 8 degrees about the object's middle and shifted by a tenth of its radius
    points     each moved by half a spacing (standard deviation along each axis); the neighbors stay

`Unknowns` are added to the truth, so what is left of them is the error.  Errors of materials and points are those of
the points that the picture shows.  One compiled step does it all: what differs is the start, and the rates of Adam.

    OUT/results.json, table.md  errors before and after, seconds, memory; gradients beside differences in float64
    OUT/inverse.png             target, start and end
    OUT/losses.png              mean squared error over the steps
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

import spnr_jax
from experiments import entry_point
from experiments.comparison import clock, figures, results_folder
from experiments.studies import one_picture
from experiments.studies.one_picture import ADAM, Truth, Unknowns, nothing, stack
from spnr_jax import cli
from spnr_jax.devices import runtime
from spnr_jax.formats import data_sets, images
from spnr_jax.kernels.records import PointCloud
from spnr_jax.method.surfel_renderer import Plan
from spnr_jax.scoring.report import Table, number

TURN, SHIFT, MOVED = np.deg2rad(8.0), 0.1, 0.5  # of a wrong pose, in radians and radii; of points, in spacings
GREY = 0.5  # where materials begin
SHOWN = 0.01  # of the largest gradient by a point's colour, above which the picture shows the point


@dataclass(frozen=True, kw_only=True)
class InverseStudy:
    """Recover light, materials, pose and points from one picture of each of four objects."""

    out: Path
    """Folder of the results."""
    data: Path | None = None
    """Data set whose first four test objects are taken; without, four simple shapes."""
    points: int = 1024
    """Points of an object."""
    size: int = 96
    """Pixels along each side."""
    steps: int = 100
    """Steps of Adam."""
    quick: bool = False
    """Two objects, 128 points, 32 pixels and 8 steps: whether it works."""


RATES: Mapping[str, Mapping[str, float]] = {  # of Adam at the first step, falling to 0
    "light": {"light": 0.1},
    "materials": {"base_color": 0.05, "roughness": 0.05},
    "pose": {"pose": 0.01},
    "points": {"positions": 0.003},
}


def main(options: InverseStudy) -> None:
    """Recovers all, compares gradients with differences, and writes tables and pictures."""
    cli.set_up_jax()
    size, steps = (32, 8) if options.quick else (options.size, options.steps)
    params, objects = spnr_jax.load().params, read(options) if options.data else shapes(options)
    truths = [one_picture.place(cloud, i, size) for i, cloud in enumerate(objects.values())]
    plan, tables, truth = one_picture.make_plan(params, truths), jnp.asarray(one_picture.basis()), stack(truths)
    found: dict[str, Any] = {}
    sheet: list = []
    for task in RATES:
        pictures, found[task] = recover(params, truth, tables, plan, task, steps)
        sheet += pictures[1 if sheet else 0 :]
    checks = one_picture.compare_gradients(params, truths, tables, plan)
    costs = one_picture.measure(params, truth, tables, plan)
    rows = ["target", *(f"{task}, {when}" for task in RATES for when in ("start", "end"))]
    files = {"inverse.png": images.png(figures.grid(sheet, list(objects), rows, 2 * size)), "losses.png": curves(found)}
    asked = {"points": truth.cloud.mask.shape[1], "size": size, "steps": steps, "plan": plan._asdict()}
    asked |= {"hardware": runtime.hardware(), "load": runtime.load()}
    note = f"{asked['points']} points, {size} px, {steps} steps; {asked['hardware']}, load {asked['load']}."
    results = asked | {"objects": list(objects), "tasks": found, "gradients": checks, "costs": costs}
    results_folder.write(options.out, results, make_tables(found, checks, costs, list(objects)), [note], files)


# --- the truth --------------------------------------------------------------------------------------------------------


def read(options: InverseStudy) -> dict[str, PointCloud]:
    """The first four test objects of a data set, without normals."""
    dataset = data_sets.open_dataset(options.data or Path())
    items = {name: data_sets.read_object(dataset, name) for name in dataset.splits["test"][: 2 if options.quick else 4]}
    count = 128 if options.quick else options.points
    clouds = {name: data_sets.first_points(item, count) for name, item in items.items()}
    return {name: dataclasses.replace(cloud, normals=None) for name, cloud in clouds.items()}


def shapes(options: InverseStudy) -> dict[str, PointCloud]:
    """A ball, a ring, a vase and a drop, painted in waves; the upper half is smooth and partly metal."""
    count = 128 if options.quick else options.points
    u, v = ((np.arange(1, count + 1) / 1.32471795724474602596**k) % 1 for k in (1, 2))  # Roberts' R2 sequence
    height, turn = 2 * v - 1, 2 * np.pi * v
    outlines = {  # radius and height
        "ball": (0.8 * np.sqrt(1 - height**2), 0.8 * height),
        "ring": (0.65 + 0.3 * np.cos(turn), 0.3 * np.sin(turn)),
        "vase": (0.4 + 0.25 * np.sin(2.5 * np.pi * v), height),
        "drop": (0.5 * np.sqrt(1 - height**2) * (1.2 - 0.8 * v), height),
    }
    clouds: dict[str, PointCloud] = {}
    for name, (radius, y) in list(outlines.items())[: 2 if options.quick else 4]:
        positions = np.stack([radius * np.sin(2 * np.pi * u), y, radius * np.cos(2 * np.pi * u)], -1).astype(np.float32)
        color = (0.5 + 0.35 * np.sin(5 * positions + len(clouds) + np.arange(3))).astype(np.float32)
        smooth = np.where(y > 0, np.float32(0.3), np.float32(0.7))
        metal = np.where((y > 0) & (u > 0.5), np.float32(0.8), np.float32(0))
        clouds[name] = PointCloud(positions, color, smooth, metal, np.ones(count, bool))
    return clouds


# --- finding it again -------------------------------------------------------------------------------------------------


def begin(task: str, truth: Truth) -> Unknowns:
    """What is wrong at first."""
    wrong, random = nothing(truth), np.random.default_rng(0).normal
    if task == "light":
        even = jnp.zeros((9, 3)).at[0].set(np.sqrt(4 * np.pi) * 0.6)  # a white ball is 0.6 in it
        return wrong._replace(light=even[None] - truth.light)
    if task == "materials":
        color, roughness = map(jnp.asarray, (truth.cloud.base_color, truth.cloud.roughness))
        return wrong._replace(base_color=GREY - color, roughness=GREY - roughness)
    if task == "pose":
        turn, shift = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in random(size=(2, len(truth.light), 3)))
        pose = np.concatenate([2 * np.tan(TURN / 2) * turn, SHIFT * shift], axis=-1)
        return wrong._replace(pose=jnp.asarray(pose, jnp.float32))
    moved = MOVED * spacings(truth)[:, None, None] * random(size=truth.cloud.positions.shape)
    return wrong._replace(positions=jnp.asarray(moved, jnp.float32))


def spacings(truth: Truth) -> Float[Array, " objects"]:
    """Median distance of a point to its nearest neighbor."""
    near = jax.vmap(lambda positions, neighbors: positions[neighbors[:, 1]])(truth.cloud.positions, truth.neighbors)
    return jnp.median(jnp.linalg.norm(near - truth.cloud.positions, axis=-1), axis=1)


def errors_of(
    task: str, wrong: Unknowns, truth: Truth, shown: Float[Array, "objects points"]
) -> dict[str, list[float]]:
    """The error of each object, by its name in the table."""

    def rms(x: Array) -> Array:
        return jnp.sqrt(jnp.sum(shown * x**2, axis=1) / jnp.sum(shown, axis=1))

    length = partial(jnp.linalg.norm, axis=-1)
    if task == "light":
        found = {"light, %": 100 * length(length(wrong.light)) / length(length(truth.light))}
    elif task == "materials":
        found = {"base colour": rms(length(wrong.base_color) / np.sqrt(3)), "roughness": rms(wrong.roughness)}
    elif task == "pose":
        found = {"turn, degrees": jnp.rad2deg(2 * jnp.arctan(length(wrong.pose[:, :3]) / 2))}
        found |= {"shift, % of the radius": 100 * length(wrong.pose[:, 3:])}
    else:
        found = {"points, spacings": rms(length(wrong.positions)) / spacings(truth)}
    return {name: np.asarray(values, float).tolist() for name, values in found.items()}


def recover(params: dict, truth: Truth, tables: Array, plan: Plan, task: str, steps: int) -> tuple[list, dict]:
    """Pictures of target, start and end; errors before and after, losses, CPU seconds of a step, what overflowed."""
    zero, pictures, losses, seconds, overflow = nothing(truth), [], [], [], 0
    black = jnp.zeros((len(truth.light), truth.camera.height, truth.camera.width, 3))
    *_, drawn, gradient = one_picture.step(zero, ADAM.init(zero), zero, params, truth, black, tables, plan)
    strength, target = jnp.sum(jnp.abs(gradient.base_color), axis=-1), drawn.image
    shown = jnp.where(strength > SHOWN * jnp.max(strength, axis=1, keepdims=True), 1.0, 0.0)
    wrong = begin(task, truth)
    state, errors = ADAM.init(wrong), [errors_of(task, wrong, truth, shown)]
    for i in range(steps + 1):  # the last, of rate 0, draws what was found
        rates, start = [RATES[task].get(name, 0.0) * (1 - i / steps) for name in Unknowns._fields], clock.now()
        given = Unknowns(*map(jnp.float32, rates)), params, truth, target, tables, plan
        wrong, state, error, drawn, _ = one_picture.step(wrong, state, *given)
        losses.append(np.asarray(error, float).tolist())
        seconds.append(clock.now() - start)
        overflow = max(overflow, int(jnp.max(drawn.overflow)))
        pictures.append(drawn.image if i in (0, steps) else None)
    errors.append(errors_of(task, wrong, truth, shown))
    psnr = [(-10 * np.log10(losses[i])).tolist() for i in (0, -1)]
    found = {"errors": errors, "psnr": psnr, "seconds": float(np.median(seconds)), "overflow": overflow}
    return [list(np.asarray(x)) for x in (target, pictures[0], pictures[-1])], found | {"losses": losses}


def make_tables(found: dict, checks: dict[str, list], costs: dict, names: list[str]) -> list[Table]:
    """Errors and PSNR before and after (means of the objects), gradients beside differences, and costs."""
    rows = []
    for of in found.values():
        psnr = [number(float(np.mean(values)), 1) for values in of["psnr"]]
        for name in of["errors"][0]:
            ends = [number(float(np.mean(errors[name])), 3) for errors in of["errors"]]
            rows.append((name, (*ends, *psnr, number(of["seconds"], 2))))
    heads = ("error before", "after", "PSNR before, dB", "after", "CPU seconds a step of all objects")
    apart = {name: tuple(number(100 * abs(g / d - 1), 4) for g, d in pairs) for name, pairs in checks.items()}
    cost = [(name, (number(of["seconds"], 2), number(of["mb"], 0))) for name, of in costs.items()]
    return [
        Table(title="Recovered from one picture", heads=heads, rows=tuple(rows)),
        Table(title="Gradients beside central differences, % apart", heads=tuple(names), rows=tuple(apart.items())),
        Table(title="Cost of all objects", heads=("CPU seconds", "MB"), rows=tuple(cost)),
    ]


@figures.drawing
def curves(found: Mapping[str, Any]) -> Figure:
    """Mean squared errors: a panel for each task, a curve for each object."""
    figure = Figure(figsize=(12, 2.6))
    for axes, (task, of) in zip(figure.subplots(1, len(found)), found.items(), strict=True):
        axes.semilogy(np.array(of["losses"]))
        axes.set(title=task, xlabel="step")
    return figure


if __name__ == "__main__":
    entry_point.run(main, InverseStudy, "studies.inverse")
