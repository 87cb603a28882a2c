"""Training data and loss of the shader: G-buffers of a data set's clouds, made once and cached on disk.

    FOLDER/OBJECT.CLOUD.npz    views of one random cloud of an object
        doublings              (views,): how often the network doubles each view's resolution
        inputs0, inputs1, ...  network input of each view, in the window around the object, float16
        maps, light_harmonics  likewise: light maps in float16, the light's spherical harmonics
        target                 likewise: the reference in 8 bits

A file is a pure function of object, cloud and what `digest` covers, which it holds as `source`; it is written
atomically.  One that cannot be read, or was made of something else, is made again.  The code is not covered: remove the
folder after a change of the surfels or of the clouds that are drawn.  A batch is a pure function of (seed, step) and
the list of files; its crops have equal doublings.
"""

import dataclasses
import hashlib
import json
import zlib
from collections.abc import Callable, Generator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8
from tqdm import tqdm

from spnr_jax.config import TrainConfig
from spnr_jax.devices import programs
from spnr_jax.errors import UserError
from spnr_jax.formats.array_files import pack_arrays, read_arrays
from spnr_jax.formats.clouds import MOST_EVEN
from spnr_jax.formats.data_sets import Dataset, ObjectData, read_object, read_record
from spnr_jax.formats.images import to_uint8, write_whole
from spnr_jax.kernels import cameras, losses
from spnr_jax.kernels.cleaning import Cleaned, clean_columns
from spnr_jax.kernels.cloud_arrays import farthest_points
from spnr_jax.kernels.metrics import psnr
from spnr_jax.kernels.records import Camera, Crops, Key, Light, PointCloud, Surfels, SurfelScene
from spnr_jax.method import surfel_method, surfel_renderer
from spnr_jax.method.inference import opacity_loss, reconstruction_loss
from spnr_jax.method.surfel_method import encode_in_box
from spnr_jax.methods import Outcome
from spnr_jax.nn import shader
from spnr_jax.nn.shader import ShaderInputs, compose_picture
from spnr_jax.surfels import lighting, normals, splatting
from spnr_jax.surfels.constants import CONSTANTS
from spnr_jax.training.batching import read_ahead
from spnr_jax.training.scan_faults import drop_materials, random_scan
from spnr_jax.training.weights import add_companions

CLOUDS = 2  # per object
SCANNED = 0.3  # share of the clouds that are simulated scans, cleaned
UNKNOWN_MATERIALS = 0.1  # share of the other clouds whose roughness and metallic are unknown
WITHOUT_NORMALS = 0.5  # share of the other clouds without given normals
OWN_NORMALS = 0.5  # share of these whose normals are estimated from the kept points only, as in a small file
SIDES = (1, 1, 1, 1, 2, 4, 8)  # a view averages side x side pixels of its reference; drawn from these
SMALL, FEWER = 4, 8  # from this side on, a cloud has at most 1 / FEWER of the points
LEAST_PADDED = 2048  # of a padded cloud, half that of its surfels: with few sizes, little is compiled
MOST_VIEW_ENTRIES = 2**22  # of a view: one with more is dropped
LEAST_PIXELS = 8  # least pixels along the shorter side of a view
MARGIN, FAINT = 6, 0.01  # pixels around the object; opacity above which a pixel belongs to it
SIZES = (96, 72, 48, 48, 32)  # pixels along a crop, by doublings; scaled if config.crop is not the first
MARGINS = (0, 4, 8, 14, 10)  # pixels on each side of a crop that are input but not output, by doublings
SHARES = (0.3, 0.22, 0.22, 0.2, 0.06)  # of the steps, by doublings
TRIES = 4  # positions that are tried for a crop
LEAST_COVERED = 0.15  # share of a crop's pixels that show the object, with which no other position is tried
VISIBLE_OPACITY = 0.02  # opacity above which a pixel shows the object
LARGEST_FLOAT16 = 6e4  # largest value in float16; brighter light does not make a picture brighter than white
LEAST_INSIDE = 1.0  # pixels; without a pixel of the object the error inside it is 0
CLOUD_STREAM, CROP_STREAM = 3, 4  # random streams under one seed, in addition to those of `batching`

Arrays = dict[str, np.ndarray]
NAMES = ("inputs", "maps", "light_harmonics", "target")


class KeptView(NamedTuple):
    """The file and index of a stored view, and how often its resolution is doubled."""

    path: Path
    number: int
    doublings: int


def prepare(
    config: TrainConfig, dataset: Dataset, run: Path, *, light: Light | None
) -> Callable[[int], Generator[Crops, None, None]]:
    """A function from a step to the training batches from there on.  It makes missing G-buffers first (slow).

    ValueError if the light of the data set is not known.
    """
    if light is None:
        dataset.check_lit_by_room()
        light = lighting.room_light()

    def batches_from(first_step: int) -> Generator[Crops, None, None]:  # no generator: a stop must reach `make_missing`
        variables = add_companions(config.model, {}, run)
        return batches(make_missing(dataset, light, config, run / "gbuffers", variables), config, first_step)

    return batches_from


def loss(
    variables: dict, crops: Crops, key: Key | None = None, *, config: TrainConfig
) -> tuple[Float[Array, ""], Outcome]:
    """(loss, outcome): errors of the picture on white and of the opacity, weighted as the config says."""
    network = surfel_renderer.make_shader(variables)
    outputs: Any = network.apply(variables, jnp.asarray(crops.inputs), crops.doublings, crops.margin)
    maps, light_harmonics = jnp.asarray(crops.maps), jnp.asarray(crops.light_harmonics)
    color, alpha = compose_picture(outputs, maps, light_harmonics, crops.doublings)
    image = color * alpha[..., None] + 1 - alpha[..., None]  # on white, as the reference is
    target = jnp.asarray(crops.target, jnp.float32) / 255
    opacity = target[..., 3]
    reference = target[..., :3] * opacity[..., None] + 1 - opacity[..., None]
    value = reconstruction_loss(config, image, None, reference)
    value += opacity_loss(config, alpha, opacity)
    squared = jnp.sum((image - reference) ** 2 * opacity[..., None])
    return value, Outcome(
        {
            "psnr": jnp.mean(psnr(image, reference)),
            "l1": losses.l1(image, reference),
            "mse_inside": squared / (3 * jnp.maximum(jnp.sum(opacity), LEAST_INSIDE)),
            "mse_opacity": losses.mse(alpha, opacity),
        }
    )


def make_missing(dataset: Dataset, light: Light, config: TrainConfig, folder: Path, variables: dict) -> list[KeptView]:
    """The views of the data set; missing, broken and other files are made first; `variables` hold the densifier."""
    views, common = [], digest(dataset, light, config, variables)
    for name in tqdm(dataset.splits["train"], "G-buffers", unit="object"):
        source = np.frombuffer(hashlib.sha256(common + read_record(dataset, name)).digest(), np.uint8)
        paths = [folder / f"{name}.{number}.npz" for number in range(CLOUDS)]
        found = [_doublings(path, source) for path in paths]
        item = read_object(dataset, name) if None in found else None
        for number, path in enumerate(paths):
            if item is not None and found[number] is None:
                programs.make_room()
                arrays = make_views(item, number, light, config, variables) | {"source": source}
                write_whole(path, pack_arrays(arrays))  # not compressed: a view is read for each crop
                found[number] = arrays["doublings"].tolist()
        views += [KeptView(path, i, d) for path, of in zip(paths, found, strict=True) for i, d in enumerate(of or ())]
    if not views:
        raise UserError(f"{dataset.folder}: no object of its train split can be learnt from; generate more objects")
    return views


def digest(dataset: Dataset, light: Light, config: TrainConfig, variables: dict) -> bytes:
    """A checksum of everything but object and cloud that G-buffers are made of."""
    names = "seed", "min_points", "max_points", "even_share", "views_per_object"
    chosen = [getattr(config, x) for x in names]
    numbers = dataclasses.astuple(CONSTANTS), list(shader.INPUTS.items()), list(shader.MAPS.items())
    made_of = hashlib.sha256(json.dumps([chosen, dataset.settings, numbers]).encode())
    for leaf in jax.tree.leaves((light, variables)):
        made_of.update(np.asarray(leaf).tobytes())
    return made_of.digest()


def _doublings(path: Path, source: UInt8[np.ndarray, "32"]) -> list[int] | None:
    """The doublings of each view in a file; None if it is missing, unreadable or of another source."""
    try:
        with path.open("rb") as file:
            arrays = read_arrays(file, ("doublings", "source"))
        return arrays["doublings"].tolist() if np.array_equal(arrays["source"], source) else None
    except (OSError, ValueError, KeyError):
        return None


def make_views(item: ObjectData, number: int, light: Light, config: TrainConfig, variables: dict) -> Arrays:
    """The content of a file: views of the object's cloud with this index."""
    generator = np.random.default_rng((config.seed, CLOUD_STREAM, zlib.crc32(item.name.encode()), number))
    side = int(generator.choice(SIDES))
    cloud = random_cloud(item.cloud, side, config, generator)
    scene = encode_in_box(surfel_method.densify_sparse(variables, cloud, LEAST_PADDED), 2 * LEAST_PADDED)
    arrays: Arrays = {}
    doublings: list[int] = []
    for index in generator.permutation(len(item.images))[: config.views_per_object]:
        camera = jax.tree.map(lambda x, i=index: np.asarray(x[i]), item.camera)
        own = light if item.lights is None else lighting.light_of(item.lights[index])
        if view := make_view(scene, camera, item.images[index], side, own):
            arrays |= {f"{name}{len(doublings)}": view[1][name] for name in NAMES}
            doublings.append(view[0])
    return arrays | {"doublings": np.array(doublings, np.int64)}


def random_cloud(cloud: PointCloud, side: int, config: TrainConfig, generator: np.random.Generator) -> PointCloud:
    """A training cloud: a random or farthest-point sample of the object's points, or of a simulated scan of them.

    Of the clouds that are no scans, half have given normals, a quarter normals estimated from all points, and a quarter
    none: those are estimated later, from the kept points alone.
    """
    most = max(config.max_points // (FEWER if side >= SMALL else 1), config.min_points)
    count = min(int(np.exp(generator.uniform(np.log(config.min_points), np.log(most)))), len(cloud.mask))
    even = generator.random() < config.even_share and count <= MOST_EVEN
    columns = {name: np.asarray(x) for name, x in vars(cloud).items() if x is not None and name != "mask"}
    points = Cleaned(columns.pop("positions"), columns, [], 0.0)
    own_normals = False
    if generator.random() < SCANNED:
        points, count = simulate_scan(points, generator), min(count, MOST_EVEN)
    else:
        if generator.random() < UNKNOWN_MATERIALS:
            points = points._replace(values=drop_materials(*points[:2], generator)[1])
        if generator.random() < WITHOUT_NORMALS:
            own_normals = generator.random() < OWN_NORMALS
            if not own_normals:
                points.values.pop("normals", None)
    chosen = generator.permutation(len(points.positions))[:count]
    if even:
        chosen = farthest_points(points.positions, len(chosen), int(chosen[0]))
    cloud = normals.thin_cloud(points, chosen)
    return dataclasses.replace(cloud, normals=None) if own_normals else cloud


def simulate_scan(points: Cleaned, generator: np.random.Generator) -> Cleaned:
    """A simulated scan of the cloud, cleaned: without normals, in the box of the original cloud."""
    positions, values = random_scan(*points[:2], generator)
    values.pop("normals", None)
    left = clean_columns(positions, values)
    return left._replace(positions=np.clip(left.positions, -1, 1))


def make_view(
    scene: SurfelScene,
    camera: Camera,
    image: UInt8[np.ndarray, "height width 4"],
    side: int,
    light: Light,
) -> tuple[int, Arrays] | None:
    """Doublings and arrays of a view with `side` times fewer pixels along a side; None if it shows too little."""
    small = cameras.resize(camera, camera.height // side, camera.width // side)
    doublings, finer = surfel_renderer.choose_resolution(scene, small)
    # supersampled by `finer`: compared at that resolution, but never above the reference's
    side, scale = max(side // finer, 1), 2**doublings
    if any(n % (side * scale) or n // (side * scale) < LEAST_PIXELS for n in image.shape[:2]):
        return None
    drawn = cameras.resize(camera, *(n // (side * scale) for n in image.shape[:2]))
    needed = jax.device_get(surfel_renderer.count_sizes(scene, drawn, doublings=0, side=1))
    if not 0 < needed.entries <= MOST_VIEW_ENTRIES:
        return None
    whole = drawn.height * drawn.width
    capacity, slots = _round_size(int(needed.entries), 2**16), min(_round_size(int(needed.slots), whole // 16), whole)
    given = jax.device_get(prepare_view(scene.surfels, drawn, light, capacity=capacity, slots=slots))
    target = average_squares(image, side)
    shown = target[..., 3].reshape(drawn.height, scale, drawn.width, scale).max(axis=(1, 3))
    inside = (given.inputs[..., 0] > FAINT) | (shown > 0)
    if not inside.any():
        return None
    rows, columns = _find_bounds(inside.any(axis=1)), _find_bounds(inside.any(axis=0))
    return doublings, {
        "inputs": given.inputs[rows, columns].astype(np.float16),
        "maps": np.clip(given.maps[rows, columns], -LARGEST_FLOAT16, LARGEST_FLOAT16).astype(np.float16),
        "light_harmonics": given.light_harmonics,
        "target": target[scale * rows.start : scale * rows.stop, scale * columns.start : scale * columns.stop],
    }


@partial(jax.jit, static_argnames=("capacity", "slots"))
def prepare_view(surfels: Surfels, camera: Camera, light: Light, *, capacity: int, slots: int) -> ShaderInputs:
    """What the shader gets of a whole view."""
    foot = splatting.project_discs(surfels, camera)
    buffer, _ = surfel_renderer.rasterize(surfels, foot, camera, light, capacity=capacity, slots=slots)
    return shader.compute_inputs(buffer, light, camera)


def _round_size(count: int, least: int) -> int:
    """The least `least` times a power of four that is not below the count: few sizes, few compilations."""
    return least * 4 ** max(-(-((count - 1) // least).bit_length() // 2), 0)


def average_squares(image: UInt8[np.ndarray, "height width 4"], side: int) -> UInt8[np.ndarray, "h w 4"]:
    """The picture `side` times smaller: mean opacity of each square, and mean colour weighted by opacity."""
    alpha = image[..., 3:].astype(np.float32) / 255
    premultiplied = np.concatenate([image[..., :3] / np.float32(255) * alpha, alpha], axis=-1)
    height, width = (n // side for n in image.shape[:2])
    means = premultiplied.reshape(height, side, width, side, 4).mean(axis=(1, 3))
    return to_uint8(np.concatenate([means[..., :3] / np.maximum(means[..., 3:], 1e-4), means[..., 3:]], axis=-1))


def _find_bounds(inside: np.ndarray) -> slice:
    """From the first to the last True entry, with a margin."""
    first, last = np.flatnonzero(inside)[[0, -1]].tolist()
    return slice(max(first - MARGIN, 0), min(last + 1 + MARGIN, len(inside)))


def batches(views: list[KeptView], config: TrainConfig, first_step: int) -> Generator[Crops, None, None]:
    """Training batches from `first_step` on, prepared ahead."""
    by_doublings: dict[int, list[KeptView]] = {}
    for view in views:
        by_doublings.setdefault(view.doublings, []).append(view)
    assemble: Callable[[int], Crops] = partial(make_batch, by_doublings, config)
    yield from read_ahead(assemble, first_step, config)


def make_batch(views: dict[int, list[KeptView]], config: TrainConfig, step: int) -> Crops:
    """The batch of a step: crops of random views with equal doublings, randomly mirrored."""
    generator = np.random.default_rng((config.seed, CROP_STREAM, step))
    shares = np.array([SHARES[doublings] for doublings in sorted(views)])
    doublings = int(generator.choice(sorted(views), p=shares / shares.sum()))
    size, margin = (-(-config.crop * n[doublings] // SIZES[0]) for n in (SIZES, MARGINS))
    crops = []
    for _ in range(config.batch_objects):
        view = views[doublings][generator.integers(len(views[doublings]))]
        crop = crop_square(read_view(view), size, margin, 2**doublings, generator)
        for axis in (0, 1):
            crop = mirror(crop, axis) if generator.random() < 0.5 else crop
        crops.append(crop)
    stacked = {name: np.stack([crop[name] for crop in crops]) for name in NAMES}
    return Crops(**stacked, doublings=doublings, margin=margin)


def read_view(view: KeptView) -> Arrays:
    """The arrays of a view; ValueError if its file cannot be read."""
    try:
        with view.path.open("rb") as file:
            arrays = read_arrays(file, [f"{name}{view.number}" for name in NAMES])
    except ValueError as error:
        raise UserError(f"{view.path}: {error}; remove it, and the same command makes it again") from None
    return {name: arrays[f"{name}{view.number}"] for name in NAMES}


def crop_square(view: Arrays, size: int, margin: int, scale: int, generator: np.random.Generator) -> Arrays:
    """A crop of a view that shows some of the object; padded with zeros beyond the view."""
    inputs, inner = view["inputs"], size - 2 * margin
    for _ in range(TRIES):
        top, left = (int(generator.integers(0, max(n - inner, 0) + 1)) for n in inputs.shape[:2])
        if np.mean(inputs[top : top + inner, left : left + inner, 0] > VISIBLE_OPACITY) > LEAST_COVERED:
            break

    def cut(values: np.ndarray, margin: int, scale: int) -> np.ndarray:
        bounds = [(scale * (first - margin), scale * (first + inner + margin)) for first in (top, left)]
        rows, columns = (slice(max(first, 0), max(end, 0)) for first, end in bounds)
        part = values[rows, columns]
        lacking = [(max(-f, 0), max(e - n, 0)) for (f, e), n in zip(bounds, values.shape, strict=False)]
        return np.pad(part, [*lacking, (0, 0)])

    return {
        "inputs": cut(inputs, margin, 1).astype(np.float32),
        "maps": cut(view["maps"], 0, 1).astype(np.float32),
        "light_harmonics": view["light_harmonics"],
        "target": cut(view["target"], 0, scale),
    }


def mirror(view: Arrays, axis: int) -> Arrays:
    """The view with object, camera and light mirrored along x (axis 0) or y (axis 1) of the camera."""
    flipped = {name: np.flip(view[name], 1 - axis) for name in ("inputs", "maps", "target")}
    return {
        **flipped,
        "inputs": flipped["inputs"] * _signs(shader.NUM_FEATURES, shader.ODD[axis]),
        "light_harmonics": view["light_harmonics"] * _signs(lighting.SH_BANDS, lighting.ODD[axis])[:, None],
    }


def _signs(count: int, odd: Sequence[int]) -> Float[np.ndarray, " count"]:
    return np.where(np.isin(np.arange(count), odd), -1, 1).astype(np.float32)
