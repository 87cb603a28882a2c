"""What a data set is to hold, decided before anything is rendered: the options and the objects.

A procedural object is `category_000012`, its number counted through all categories; a mesh's id comes from its file, or
from the data set that it is part of (`sources`). A colour variant of a product is `ID--1`, `ID--2`, ...: it lies
beside its product in every sorted list.

Products (objects as their source holds them) are split, never variants: a colour variant is made of a training product
only and is in the training split with it. Products are ranked by a hash of (seed, id); the first are the test split,
or those of a test list, the next the validation split, the rest train. Only usable products are ranked: what cannot be
rendered is in no split and takes nobody's place.
"""

import hashlib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Literal

import tyro

from data_gen import procedural
from data_gen.plan import sources
from data_gen.plan.sources import Category
from spnr_jax.errors import UserError, require_at_least
from spnr_jax.formats.columns import list_names
from spnr_jax.formats.surface_points import Spread

DEFAULT_OBJECTS = 200
SAFE_ID = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*")

Source = Literal["procedural", "meshes", "abo", "shapenet"]
Preset = Literal["abo", "shapenet_car", "shapenet_plane", "shapenet_chair"]
CATEGORY_OF: dict[str, Category] = {"shapenet_car": "car", "shapenet_plane": "plane", "shapenet_chair": "chair"}


@dataclass(frozen=True, kw_only=True)
class GenerateConfig:
    """Generate a data set of rendered objects: procedural ones, mesh files, or a data set of others."""

    out: tyro.conf.Positional[Path]
    """Folder of the data set. An unfinished run there is completed."""
    preset: Preset | None = None
    """Settings of the paper for one of its data sets: defaults of the other options, which --help then shows."""
    root: Path | None = None
    """Folder of the preset's meshes: the ABO 3D download (holds 3dmodels), or ShapeNetCore v2 or v1."""
    objects: int | None = None
    """Number of procedural objects (default: 200, or 0 if there are others)."""
    categories: tuple[str, ...] = ()
    """Categories of procedural objects (default: all)."""
    meshes: Path | None = None
    """Folder of .glb, .gltf, .obj, .ply, .stl and .off files."""
    colour_variants: int = 0
    """Variants of each training object with its base colours rotated in RGB space; test objects have none."""
    reshape_variants: bool = False
    """Also rotate, mirror and scale the variants, and change their roughness: more data from a few meshes."""
    train_objects: int | None = None
    """Most training objects, variants included: variants are drawn until there are as many (default: all variants)."""
    test_objects: int | None = None
    """Objects of the test split, drawn by the seed (default: the share --test-fraction)."""
    test_list: Path | None = None
    """Text file with the ids, one per line, of the objects that go to the test split."""
    resolution: int = 64
    """Width and height of the images in pixels."""
    views: int = 10
    """Views per object, from random directions."""
    points: int = 4096
    """Surface points per object."""
    spread: Spread = "random"
    """Distribution of the points: by area, or farthest-point sampling, as spnr render thins bigger clouds."""
    spp: int = 64
    """Samples per pixel; Mitsuba rounds it up to a product of two near-equal numbers."""
    max_depth: int = 6
    """Longest light path in segments; 2 is direct light only."""
    fov: float = 40.0
    """Field of view in degrees."""
    distance: float = 3.0
    """Distance of the cameras from the object's centre; the object fits into the unit sphere."""
    visibility_grid: int = 4
    """Rays per pixel side that look for visible faces."""
    envmap: Path | None = None
    """Environment map, .hdr or .exr (default: a procedural room). Scaled: a white sphere averages 0.6."""
    lights: tuple[str, ...] = ()
    """A light for each view, turned at random, from these kinds: room, random (skies and lamps), or folders of maps."""
    seed: int = 0
    """Seed of shapes, points, viewpoints, noise and splits."""
    workers: int | None = None
    """Local processes that render (default: one per CPU core)."""
    val_fraction: float = 0.05
    """Share of the objects that goes to the validation split."""
    test_fraction: float = 0.1
    """Share of the objects that goes to the test split; not used with a number or a list of test objects."""
    variant: str = "auto"
    """Mitsuba variant: scalar_rgb, llvm_ad_rgb, or auto for the faster one that works here."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One object to make: a mesh file (with its path as it is reported), or a procedural category.

    `folder` is the widest that a mesh's companions may lie in (default: the mesh's own); `fault` is why it cannot be
    made, known before it is tried. A colour variant names its product and its number, from 1, and may be reshaped too.
    """

    object_id: str
    category: str = ""
    path: Path | None = None
    shown_path: str = ""
    folder: Path | None = None
    fault: str = ""
    variant_of: str = ""
    colour_variant: int = 0
    reshaped: bool = False

    @property
    def product(self) -> str:
        """The id of the object whose shape this one has: its own, or that of the variant's original."""
        return self.variant_of or self.object_id


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The products of a data set, the test split that a file names, and how many products the others are to hold."""

    config: GenerateConfig
    tasks: tuple[Task, ...]
    listed: tuple[str, ...] | None
    num_test: int
    num_val: int

    def split(self, usable: Sequence[str]) -> dict[str, list[str]]:
        """The sorted ids of each split of the products that can be rendered."""
        order = rank(usable, self.config.seed, "split")
        test = set(usable) & set(order[: self.num_test] if self.listed is None else self.listed)
        rest = [name for name in order if name not in test]
        val, train = rest[: self.num_val], rest[self.num_val :]
        return {"train": sorted(train), "val": sorted(val), "test": sorted(test)}

    def variants(self, train_ids: Sequence[str]) -> list[Task]:
        """The colour variants of the training products, sorted by id; where there are too many, they are drawn."""
        config, products = self.config, {task.object_id: task for task in self.tasks}
        most = None if config.train_objects is None else max(config.train_objects - len(train_ids), 0)
        names = {f"{name}/{k}": (name, k) for name in train_ids for k in range(1, config.colour_variants + 1)}
        reshaped = config.reshape_variants
        return [
            replace(products[name], object_id=f"{name}--{k}", variant_of=name, colour_variant=k, reshaped=reshaped)
            for name, k in sorted(names[name] for name in rank(list(names), config.seed, "variants")[:most])
        ]


def rank(ids: Sequence[str], seed: int, purpose: str) -> list[str]:
    """The ids in an order that depends on nothing but (purpose, seed, id)."""
    return sorted(ids, key=lambda name: hashlib.sha256(f"{purpose}/{seed}/{name}".encode()).digest())


def check_options(config: GenerateConfig) -> None:
    """ValueError, naming the option, for a value that no data set can be made with."""
    require_at_least(config, 2, "max_depth")
    require_at_least(config, 1, "resolution", "views", "points", "spp", "visibility_grid", "train_objects", "workers")
    require_at_least(config, 0, "objects", "colour_variants", "test_objects", "seed")
    if not 0 < config.fov < 180:
        raise UserError(f"--fov: expected degrees between 0 and 180, got {config.fov:g}")
    if not 1 < config.distance < math.inf:
        raise UserError(f"--distance: expected more than 1, outside the object's unit sphere, got {config.distance:g}")
    if not (min(config.val_fraction, config.test_fraction) >= 0 and config.val_fraction + config.test_fraction < 1):
        raise UserError("--val-fraction, --test-fraction: expected shares that leave some objects to train on")
    if config.envmap and not config.envmap.is_file():
        raise UserError(f"--envmap {config.envmap}: no such file; give a latitude-longitude .hdr or .exr")
    if config.envmap and config.lights:
        raise UserError(f"--lights {config.lights[0]}: not together with --envmap, one light for all; give one of them")
    if unknown := set(config.categories) - set(procedural.CATEGORIES):
        known = ", ".join(procedural.CATEGORIES)
        raise UserError(f"--categories: no category {', '.join(sorted(unknown))}; there are {known}")
    if config.reshape_variants and not config.colour_variants:
        raise UserError("--reshape-variants: give --colour-variants, the number of variants of each object")
    if config.categories and (config.objects == 0 or (config.objects is None and (config.meshes or config.root))):
        raise UserError("--categories: of procedural objects; give --objects, their number")
    if config.meshes and config.preset:
        raise UserError(f"--meshes {config.meshes}: not together with --preset {config.preset}; give one of them")
    if config.root and not config.preset:
        raise UserError(f"--root {config.root}: only with --preset; --meshes takes a folder of mesh files")
    if config.preset and not config.root:
        raise UserError(f"--preset {config.preset}: give --root, the folder that holds its meshes")


def source_of(config: GenerateConfig) -> tuple[Source, Category | None]:
    """Where the objects come from, and the class of ShapeNet."""
    if config.preset == "abo":
        return "abo", None
    if config.preset:
        return "shapenet", CATEGORY_OF[config.preset]
    return "meshes" if config.meshes else "procedural", None


def plan_objects(config: GenerateConfig) -> list[Task]:
    """Every product of the data set, sorted by id. A procedural object's id does not depend on --categories."""
    root = config.meshes or config.root
    num_objects = config.objects if config.objects is not None else 0 if root else DEFAULT_OBJECTS
    wanted = set(config.categories or procedural.CATEGORIES)
    numbered = ((index, procedural.category_of(index)) for index in count())
    chosen = islice(((index, category) for index, category in numbered if category in wanted), num_objects)
    tasks = [Task(object_id=f"{category}_{index:06d}", category=category) for index, category in chosen]
    if root:
        tasks += mesh_tasks(config, root)
    if not tasks:
        raise UserError("nothing to do: give --objects above 0, or --meshes with mesh files")
    tasks.sort(key=lambda task: task.object_id)
    for task, after in zip(tasks, tasks[1:], strict=False):
        if task.object_id == after.object_id:
            raise UserError(f"{task.object_id} is the id of two objects; rename the mesh file")
    if unsafe := [task.object_id for task in tasks if not SAFE_ID.fullmatch(task.object_id)]:
        raise UserError(f"{unsafe[0]!r} cannot be an object's id; expected letters, digits, dot, dash and underscore")
    return tasks


def mesh_tasks(config: GenerateConfig, root: Path) -> list[Task]:
    """The objects of a source of files, in any order; paths are relative to its root: no private one is shown."""
    source, category = source_of(config)
    if source == "meshes":
        listed = [sources.Listed(object_id=name, path=path) for name, path in sources.find_meshes(root)]
    else:
        listed = sources.find_objects(root, category) if category else sources.find_products(root)
    return [Task(**vars(x), category=category or "", shown_path=x.path.relative_to(root).as_posix()) for x in listed]


def plan_data_set(config: GenerateConfig) -> Plan:
    """The products to render and the sizes of the splits; ValueError if the options do not fit the objects."""
    tasks = plan_objects(config)
    listed = read_test_list(config.test_list, {task.object_id for task in tasks}) if config.test_list else None
    num_free = len(tasks) - len(listed or ())
    num_test = round(config.test_fraction * len(tasks)) if config.test_objects is None else config.test_objects
    if listed is None and num_test >= len(tasks):
        raise UserError(f"--test-objects {num_test}: leaves none of the {len(tasks)} objects to train on")
    num_val = round(config.val_fraction * num_free)
    plan = Plan(config=config, tasks=tuple(tasks), listed=listed, num_test=num_test, num_val=num_val)
    if config.train_objects is None:
        return plan
    split_ids = plan.split([task.object_id for task in tasks])
    surplus = set(rank(split_ids["train"], config.seed, "split")[config.train_objects :])
    return replace(plan, tasks=tuple(task for task in tasks if task.object_id not in surplus))


def read_test_list(path: Path, known: set[str]) -> tuple[str, ...]:
    """The sorted ids of a text file with one id per line; ValueError if it names an object that is not there."""
    try:
        ids = sorted({line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines()} - {""})
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--test-list {path}: not a readable text file ({error})") from None
    if unknown := [name for name in ids if name not in known]:
        found = f"no object {unknown[0]!r} ({len(unknown)} of {len(ids)} ids unknown)"
        raise UserError(f"--test-list {path}: {found}; ids are {list_names(sorted(known))}")
    return tuple(ids)


# --- the paper's data sets --------------------------------------------------------------------------------------------

# Image size, views and test objects are the paper's; samples per pixel and the number of validation objects (none: the
# paper names none) are choices. Where a folder holds another number of usable objects than the paper used, the test
# split keeps its size and the rest train; `--train-objects` caps them.

# (training objects with their colour variants, test objects) of the paper
PAPER_COUNTS: dict[Preset, tuple[int, int]] = {
    "abo": (16161, 200),
    "shapenet_car": (1127, 128),
    "shapenet_plane": (3627, 406),
    "shapenet_chair": (4882, 105),
}
# 128 samples: 40 dB against 4096 over the object's own pixels (median; docs/lab/making_data.md)
COMMON = GenerateConfig(out=tyro.MISSING, val_fraction=0.0, views=10, spp=128)


def abo(out: Path) -> GenerateConfig:
    """Amazon Berkeley Objects at 128 x 128.

    Of 7,953 products 200 test and the others train, with as many colour variants of theirs, drawn by the seed from
    five each, as make 16,161. (All five of each would be 46,518; how the paper came to 16,161 it does not say.)
    """
    train, test = PAPER_COUNTS["abo"]
    made = replace(COMMON, out=out, preset="abo", colour_variants=5, resolution=128)
    return replace(made, train_objects=train, test_objects=test)


def shapenet(out: Path, preset: Preset) -> GenerateConfig:
    """A class of ShapeNetCore at 200 x 200, without colour variants."""
    return replace(COMMON, out=out, preset=preset, test_objects=PAPER_COUNTS[preset][1], resolution=200)


PRESETS: dict[str, Callable[[Path], GenerateConfig]] = {
    "abo": abo,
    **{name: partial(shapenet, preset=name) for name in PAPER_COUNTS if name != "abo"},
}
