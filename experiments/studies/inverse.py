"""What one picture tells of its light, materials, camera and points: the default network, differentiated.

    python -m experiments.studies.inverse --out OUT [--data DIR] [--points 1024] [--size 96] [--steps 100] [--quick]

Four objects at once, under `vmap`: one picture of each is drawn, one thing is made wrong, and Adam (optax) finds it
again from the picture alone, by gradients through `spnr_jax.encode` and `spnr_jax.render`:

    light      nine spherical harmonics of three colours, from a light that is the same from everywhere
    materials  base colour and roughness of every point, from grey
    pose       turned by 8 degrees about the object's middle and shifted by a tenth of its radius
    points     each moved by half a spacing (standard deviation along each axis); the neighbors stay

`Truth` is what a picture is drawn of; `Unknowns` are added to it, so what is left of them is the error.  Errors of
materials and points are those of the points that the picture shows.  One compiled step does it all: what differs is
the start, and the rates of Adam.

    OUT/results.json, table.md  errors and losses; gradients beside differences in float64
    OUT/inverse.png             target, start and end
"""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

import spnr_jax
from experiments import entry_point
from experiments.comparison import figures, results_folder
from experiments.comparison.study_objects import cut, test_objects
from spnr_jax.devices import runtime
from spnr_jax.devices.runtime import QUICKEST
from spnr_jax.errors import require_at_least
from spnr_jax.formats import data_sets, images
from spnr_jax.kernels import cameras
from spnr_jax.kernels.cloud_arrays import make_cloud
from spnr_jax.kernels.records import Camera, Light, PointCloud, Rendering
from spnr_jax.method import surfel_renderer
from spnr_jax.method.model import DISTANCE, FIELD_OF_VIEW
from spnr_jax.method.surfel_renderer import Plan, fit_box
from spnr_jax.scoring.report import Table, number
from spnr_jax.surfels import lighting
from spnr_jax.surfels.lighting import solid_angles, texel_directions

TURN, SHIFT, MOVED = np.deg2rad(8.0), 0.1, 0.5  # of a wrong pose, in radians and radii; of points, in spacings
GREY = 0.5  # where materials begin
SHOWN = 0.01  # of the largest gradient by a point's colour, above which the picture shows the point
SMOOTHEST = 0.05  # the least roughness
ROOM = 1.25  # of what the true pictures need, for what moves
HELD = ("visibility", "one_sided", "mask")  # fields of surfels that have no gradient
DIFFERENCE = 1e-8  # of central differences in float64: the smaller, the fewer of them cross an edge
ADAM = optax.scale_by_adam()
RATES: Mapping[str, Mapping[str, float]] = {  # of Adam at the first step, falling to 0
    "light": {"light": 0.1},
    "materials": {"base_color": 0.05, "roughness": 0.05},
    "pose": {"pose": 0.01},
    "points": {"positions": 0.003},
}


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
    """Two objects, 128 points, 32 pixels and 3 steps: whether it works."""

    def __post_init__(self) -> None:
        require_at_least(self, 1, "points", "size", "steps")


class Unknowns(NamedTuple):
    """What is added to the truth; the pose is a rotation vector about the object's middle, and a shift in radii."""

    light: Float[Array, "9 3"]
    base_color: Float[Array, "points 3"]
    roughness: Float[Array, " points"]
    metallic: Float[Array, " points"]
    pose: Float[Array, "6"]
    positions: Float[Array, "points 3"]
    normals: Float[Array, "points 3"]


class Truth(NamedTuple):
    """An object, the camera that sees it, and the harmonics of its light; or several, stacked."""

    cloud: PointCloud
    neighbors: Int[Array, "points 20"]
    camera: Camera
    light: Float[Array, "9 3"]


def main(options: InverseStudy) -> None:
    """Recovers all, compares gradients with differences, and writes tables and pictures."""
    if options.quick:
        options = dataclasses.replace(options, points=128, size=32, steps=3)
    size, steps = options.size, options.steps
    params = spnr_jax.load().params
    objects = read(options.data, options.points) if options.data else shapes(options.points)
    objects = dict(list(objects.items())[: 2 if options.quick else 4])
    truths = [place(cloud, i, size) for i, cloud in enumerate(objects.values())]
    plan, tables, truth = make_plan(params, truths), jnp.asarray(basis()), stack(truths)
    found: dict[str, Any] = {}
    sheet: list = []
    for task in RATES:
        pictures, found[task] = recover(params, truth, tables, plan, task, steps)
        sheet += pictures[1 if sheet else 0 :]
    checks = compare_gradients(params, truths[:1] if options.quick else truths, tables, plan)
    rows = ["target", *(f"{task}, {when}" for task in RATES for when in ("start", "end"))]
    files = {"inverse.png": images.png(figures.grid(sheet, list(objects), rows, 2 * size))}
    asked = {"points": truth.cloud.mask.shape[1], "size": size, "steps": steps, "plan": plan._asdict()}
    asked |= {"hardware": runtime.describe_hardware(), "load": runtime.measure_load()}
    note = f"{asked['points']} points, {size} px, {steps} steps; {asked['hardware']}, load {asked['load']}."
    results = asked | {"objects": list(objects), "tasks": found, "gradients": checks}
    results_folder.write(options.out, results, make_tables(found, checks, list(objects)), [note], files)


# --- the truth --------------------------------------------------------------------------------------------------------


def read(folder: Path, count: int) -> dict[str, PointCloud]:
    """The first four test objects of a data set, without normals."""
    dataset = data_sets.open_dataset(folder)
    names = test_objects(dataset, None, count)[:4]
    return {name: cut(data_sets.read_object(dataset, name), count).cloud for name in names}


def shapes(count: int) -> dict[str, PointCloud]:
    """A ball, a ring, a vase and a drop, painted in waves; the upper half is smooth and partly metal."""
    u, v = ((np.arange(1, count + 1) / 1.32471795724474602596**k) % 1 for k in (1, 2))  # Roberts' R2 sequence
    height, turn = 2 * v - 1, 2 * np.pi * v
    outlines = {  # radius and height
        "ball": (0.8 * np.sqrt(1 - height**2), 0.8 * height),
        "ring": (0.65 + 0.3 * np.cos(turn), 0.3 * np.sin(turn)),
        "vase": (0.4 + 0.25 * np.sin(2.5 * np.pi * v), height),
        "drop": (0.5 * np.sqrt(1 - height**2) * (1.2 - 0.8 * v), height),
    }
    clouds: dict[str, PointCloud] = {}
    for name, (radius, y) in outlines.items():
        positions = np.stack([radius * np.sin(2 * np.pi * u), y, radius * np.cos(2 * np.pi * u)], axis=-1)
        color = 0.5 + 0.35 * np.sin(5 * positions + len(clouds) + np.arange(3))
        smooth, metal = np.where(y > 0, 0.3, 0.7), np.where((y > 0) & (u > 0.5), 0.8, 0)
        clouds[name] = make_cloud(positions, color, smooth, metal)
    return clouds


def place(cloud: PointCloud, number_of: int, size: int) -> Truth:
    """The truth of an object: seen from a side of its own, in the harmonics of the room."""
    cloud = jax.tree.map(jnp.asarray, cloud)
    centre, scale = fit_box(cloud.positions, cloud.mask)
    pose = cameras.orbit(jnp.float32(0.5 + 0.4 * number_of), jnp.float32(0.45), DISTANCE / scale, centre)
    room, area = lighting.room_light().tables[1], solid_angles(lighting.HEIGHT).reshape(lighting.HEIGHT, -1)
    light = np.einsum("hwb,hwc,hw->bc", harmonics(), room, np.broadcast_to(area, room.shape[:2]))
    camera = cameras.pinhole(pose, FIELD_OF_VIEW, size, size)
    return Truth(cloud, jnp.asarray(spnr_jax.neighbors(cloud)), camera, jnp.asarray(light, jnp.float32))


def harmonics() -> Float[np.ndarray, "32 64 9"]:
    """The first nine real spherical harmonics at the texels of a light's map."""
    towards = np.moveaxis(texel_directions(lighting.HEIGHT).astype(np.float32), -1, 0)
    return np.stack([np.asarray(x) for x in lighting.harmonics(*map(jnp.asarray, towards))], axis=-1)


def basis() -> Float[np.ndarray, "9 7 32 64"]:
    """Tables of the lights whose maps are the harmonics: every light is linear in its map."""
    lights = [lighting.light_of(maps) for maps in np.split(harmonics(), 3, axis=-1)]
    return np.concatenate([np.moveaxis(np.asarray(light.tables), -1, 0) for light in lights])


def make_plan(params: dict, truths: Sequence[Truth]) -> Plan:
    """Sizes for all objects, with room for what moves."""
    scenes = stack([_encode(params, truth.cloud, truth.neighbors) for truth in truths])
    plan = spnr_jax.plan(scenes, stack([truth.camera for truth in truths]))
    most = surfel_renderer.bound_window(truths[0].camera.width, plan.doublings, plan.side)
    width, height = (min(n + surfel_renderer.STEP, max(n, most)) for n in (plan.width, plan.height))
    entries, slots = int(ROOM * plan.entries), min(int(ROOM * plan.slots), width * height)
    return plan._replace(width=width, height=height, entries=entries, slots=slots)


_encode = jax.jit(spnr_jax.encode, compiler_options=QUICKEST)


def stack(trees: Sequence[Any]) -> Any:
    """Records of equal shapes as one with an axis of objects first."""
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


# --- the picture and its gradient -------------------------------------------------------------------------------------


def draw(
    wrong: Unknowns, params: dict, truth: Truth, tables: Array, plan: Plan, held: dict[str, Array] | None = None
) -> Rendering:
    """The picture of one object of which this much is wrong; `held` are fields of its surfels that do not change."""
    cloud, names = truth.cloud, ["base_color", "roughness", "metallic", "positions"]
    names += [] if cloud.normals is None else ["normals"]
    cloud = dataclasses.replace(cloud, **{name: getattr(cloud, name) + getattr(wrong, name) for name in names})
    scene = spnr_jax.encode(params, cloud, truth.neighbors)
    scene = dataclasses.replace(scene, surfels=dataclasses.replace(scene.surfels, **(held or {})))
    camera = move(truth.camera, wrong.pose, *fit_box(truth.cloud.positions, truth.cloud.mask))
    light = Light(tables=jnp.einsum("bc,bthw->thwc", truth.light + wrong.light, tables))
    return spnr_jax.render(params, scene, camera, light, plan=plan)


def move(camera: Camera, pose: Float[Array, "6"], centre: Float[Array, "3"], scale: Float[Array, ""]) -> Camera:
    """The camera turned about the object's middle (Cayley's map, smooth at 0) and shifted by so many radii."""
    x, y, z = pose[:3] / 2
    skew = jnp.stack([0 * x, -z, y, z, 0 * x, -x, -y, x, 0 * x]).reshape(3, 3)
    turn = jnp.eye(3) + 2 / (1 + x * x + y * y + z * z) * (skew + skew @ skew)
    eye = centre + turn @ (camera.cam_to_world[:, 3] - centre) + pose[3:] / scale
    pose = jnp.concatenate([turn @ camera.cam_to_world[:, :3], eye[:, None]], axis=1)
    return dataclasses.replace(camera, cam_to_world=pose)


def loss(
    wrong: Unknowns, params: dict, truth: Truth, target: Float[Array, "h w 3"], tables: Array, plan: Plan
) -> tuple[Float[Array, ""], Rendering]:
    """Mean squared error of the picture, and the picture."""
    drawn = draw(wrong, params, truth, tables, plan)
    return jnp.mean((drawn.image - target) ** 2), drawn


@partial(jax.jit, static_argnames="plan", compiler_options=QUICKEST)
def step(
    wrong: Unknowns, state: Any, rates: Unknowns, params: dict, truth: Truth, target: Array, tables: Array, plan: Plan
) -> tuple[Unknowns, Any, Array, Rendering, Unknowns]:
    """One step of Adam for all objects at once: what is wrong then; errors, pictures and gradients before it."""
    one = jax.value_and_grad(partial(loss, plan=plan), has_aux=True)
    (errors, drawn), gradient = jax.vmap(one, (0, None, 0, 0, None))(wrong, params, truth, target, tables)
    update, state = ADAM.update(gradient, state)
    wrong = jax.tree.map(lambda x, u, rate: x - rate * u, wrong, update, rates)
    color = jnp.clip(truth.cloud.base_color + wrong.base_color, 0, 1) - truth.cloud.base_color
    roughness = jnp.clip(truth.cloud.roughness + wrong.roughness, SMOOTHEST, 1) - truth.cloud.roughness
    return wrong._replace(base_color=color, roughness=roughness), state, errors, drawn, gradient


def nothing(truth: Truth) -> Unknowns:
    """No error at all."""
    cloud, pose = truth.cloud, jnp.zeros((*truth.light.shape[:-2], 6), truth.light.dtype)
    zeros = (truth.light, cloud.base_color, cloud.roughness, cloud.metallic, pose, cloud.positions, cloud.positions)
    return Unknowns(*map(jnp.zeros_like, zeros))


# --- gradients beside differences ------------------------------------------------------------------------------------


def compare_gradients(params: dict, truths: Sequence[Truth], tables: Array, plan: Plan) -> dict[str, list]:
    """Of each object gradient and central difference, in float64, of a random sum of pixels along a random direction.

    With the normals of its surfels given, so that there is a gradient by them.  What has no gradient, visibility and
    sides (HELD), is held in the differences, too.
    """
    rows: dict[str, list] = {name: [] for name in Unknowns._fields}
    with jax.enable_x64(True):
        for truth in truths:
            normals = _encode(params, truth.cloud, truth.neighbors).surfels.normal
            given = widen((params, truth._replace(cloud=dataclasses.replace(truth.cloud, normals=normals)), tables))
            random = np.random.default_rng(0).normal
            weights, zero = jnp.asarray(random(size=(truth.camera.height, truth.camera.width, 3))), nothing(given[1])
            surfels = _encode(given[0], given[1].cloud, given[1].neighbors).surfels
            given = *given, {name: getattr(surfels, name) for name in HELD}, weights
            _, gradient = _sum_of_pixels(zero, *given, plan)
            for name, found in rows.items():
                along = jnp.asarray(random(size=getattr(zero, name).shape))
                ends = [zero._replace(**{name: t * along}) for t in (DIFFERENCE, -DIFFERENCE)]
                ahead, behind = (_sum_of_pixels(end, *given, plan)[0] for end in ends)
                found.append(
                    [float(jnp.vdot(getattr(gradient, name), along)), float(ahead - behind) / (2 * DIFFERENCE)]
                )
    return rows


@partial(jax.jit, static_argnames="plan", compiler_options=QUICKEST)
@jax.value_and_grad
def _sum_of_pixels(
    wrong: Unknowns, params: dict, truth: Truth, tables: Array, held: dict, weights: Array, plan: Plan
) -> Array:
    return jnp.sum(weights * draw(wrong, params, truth, tables, plan, held).image)


def widen(tree: Any) -> Any:
    """The arrays in float64."""
    return jax.tree.map(lambda x: jax.device_put(np.float64(x)) if x.dtype == jnp.float32 else x, tree)


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
    """Pictures of target, start and end; errors before and after, losses, seconds of a step, what overflowed."""
    zero, pictures, losses, seconds, overflow = nothing(truth), [], [], [], 0
    black = jnp.zeros((len(truth.light), truth.camera.height, truth.camera.width, 3))
    *_, drawn, gradient = step(zero, ADAM.init(zero), zero, params, truth, black, tables, plan)
    strength, target = jnp.sum(jnp.abs(gradient.base_color), axis=-1), drawn.image
    shown = jnp.where(strength > SHOWN * jnp.max(strength, axis=1, keepdims=True), 1.0, 0.0)
    wrong = begin(task, truth)
    state, errors = ADAM.init(wrong), [errors_of(task, wrong, truth, shown)]
    for i in range(steps + 1):  # the last, of rate 0, draws what was found
        rates, start = [RATES[task].get(name, 0.0) * (1 - i / steps) for name in Unknowns._fields], time.perf_counter()
        given = Unknowns(*map(jnp.float32, rates)), params, truth, target, tables, plan
        wrong, state, error, drawn, _ = step(wrong, state, *given)
        losses.append(np.asarray(error, float).tolist())
        seconds.append(time.perf_counter() - start)
        overflow = max(overflow, int(jnp.max(drawn.overflow)))
        pictures.append(drawn.image if i in (0, steps) else None)
    errors.append(errors_of(task, wrong, truth, shown))
    psnr = [(-10 * np.log10(losses[i])).tolist() for i in (0, -1)]
    found = {"errors": errors, "psnr": psnr, "seconds": float(np.median(seconds)), "overflow": overflow}
    return [list(np.asarray(x)) for x in (target, pictures[0], pictures[-1])], found | {"losses": losses}


def make_tables(found: dict, checks: dict[str, list], names: list[str]) -> list[Table]:
    """Errors and PSNR before and after (means of the objects), and gradients beside differences."""
    rows = []
    for of in found.values():
        psnr = [number(float(np.mean(values)), 1) for values in of["psnr"]]
        for name in of["errors"][0]:
            ends = [number(float(np.mean(errors[name])), 3) for errors in of["errors"]]
            rows.append((name, (*ends, *psnr, number(of["seconds"], 2))))
    heads = ("error before", "after", "PSNR before, dB", "after", "seconds a step of all objects")
    apart = {name: tuple(number(100 * abs(g / d - 1), 4) for g, d in pairs) for name, pairs in checks.items()}
    compared = tuple(names[: max(map(len, apart.values()))])
    return [
        Table(title="Recovered from one picture", heads=heads, rows=tuple(rows)),
        Table(title="Gradients beside central differences, % apart", heads=compared, rows=tuple(apart.items())),
    ]


if __name__ == "__main__":
    entry_point.run(main, InverseStudy, "studies.inverse")
