"""One picture of an object whose light, materials, pose and points are given, and its gradient by all of them.

`Truth` is what a picture is drawn of, `Unknowns` what is added to it; `step` moves them, for all objects at once, to
a target picture.  `compare_gradients` and `measure` say whether gradients are right, and what they cost.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

import spnr_jax
from experiments.comparison import clock
from spnr_jax.devices.runtime import QUICKEST
from spnr_jax.kernels import cameras
from spnr_jax.kernels.records import Camera, Light, PointCloud, Rendering
from spnr_jax.method import surfel_renderer
from spnr_jax.method.model import DISTANCE, FIELD_OF_VIEW
from spnr_jax.method.surfel_renderer import Plan
from spnr_jax.surfels import lighting
from spnr_jax.surfels.envmaps import directions, solid_angles
from spnr_jax.surfels.surfel_scenes import fit_box

SMOOTHEST = 0.05  # the least roughness
ROOM = 1.25  # of what the true pictures need, for what moves
HELD = ("visible", "sided", "mask")  # fields of surfels that have no gradient
DIFFERENCE = 1e-8  # of central differences in float64: the smaller, the fewer of them cross an edge
ADAM = optax.scale_by_adam()


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
    towards = np.moveaxis(directions(lighting.HEIGHT).astype(np.float32), -1, 0)
    return np.stack([np.asarray(x) for x in lighting.harmonics(*map(jnp.asarray, towards))], axis=-1)


def basis() -> Float[np.ndarray, "9 7 32 64"]:
    """Tables of the lights whose maps are the harmonics: every light is linear in its map."""
    lights = [lighting.light_of(maps) for maps in np.split(harmonics(), 3, axis=-1)]
    return np.concatenate([np.moveaxis(np.asarray(light.tables), -1, 0) for light in lights])


def make_plan(params: dict, truths: Sequence[Truth]) -> Plan:
    """Sizes for all objects, with room for what moves."""
    scenes = stack([_encode(params, truth.cloud, truth.neighbors) for truth in truths])
    plan = spnr_jax.plan(scenes, stack([truth.camera for truth in truths]))
    most = surfel_renderer.round_up(truths[0].camera.width + surfel_renderer.MARGIN)
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


# --- gradients, and what they cost ------------------------------------------------------------------------------------


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
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64) if x.dtype == jnp.float32 else x, tree)


def measure(params: dict, truth: Truth, tables: Array, plan: Plan) -> dict[str, dict[str, float]]:
    """CPU seconds and MB of all pictures, of a step, and of gradients with `jax.checkpoint`."""
    zero, target = nothing(truth), jnp.zeros((len(truth.light), truth.camera.height, truth.camera.width, 3))
    given = zero, ADAM.init(zero), zero, params, truth, target, tables
    planned = partial(loss, plan=plan)

    def error(*given: Any) -> Array:
        return planned(*given)[0]

    def compiled(one: Any) -> Any:
        every = jax.vmap(one, (0, None, 0, 0, None))
        whole = jax.jit(lambda wrong, _state, _rates, *rest: every(wrong, *rest), compiler_options=QUICKEST)
        return whole.lower(*given)

    made = {"pictures": compiled(error), "a step": step.lower(*given, plan=plan)}
    made["gradients, checkpointed"] = compiled(jax.grad(jax.checkpoint(error)))
    programs = {name: lowered.compile() for name, lowered in made.items()}
    seconds = clock.in_turns({name: partial(program, *given) for name, program in programs.items()}, 3)
    memory = {name: program.memory_analysis().temp_size_in_bytes / 2**20 for name, program in programs.items()}
    return {name: {"seconds": float(np.median(seconds[name])), "mb": memory[name]} for name in programs}
