"""The data sets of others, in the layouts in which they are downloaded: which objects a folder holds.

ShapeNetCore, version 2 or 1; the object's id is ID:

    v2  SYNSET/ID/models/model_normalized.obj + .mtl, textures in SYNSET/ID/images (named ../images/x.jpg)
    v1  SYNSET/ID/model.obj + .mtl, textures in SYNSET/ID/images

Both versions are y up; the front is -z in v2 and +x in v1, and is left as it lies: a data set should come from one
version, for its light comes from a fixed direction. What lies in a class's folder without a mesh (some objects of v2)
is an object that is left out.

Amazon Berkeley Objects, the 3D download (abo-3dmodels.tar, unpacked); the product's id is its 3dmodel_id:

    3dmodels/original/L/B01N2PLWIL.glb    one product a file, sorted into folders by the id's last letter

glTF is y up, metres.

Of any other folder, every mesh file in it or below.
"""

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from spnr_jax.errors import UserError
from spnr_jax.formats.meshes import SUFFIXES

NAMED_BY_FOLDER = (".gltf", ".obj")  # files that come with companions, so that the folder is the object
NAMED = 5  # files that an error message names


@dataclass(frozen=True, kw_only=True)
class Listed:
    """One object of a source: its mesh file, the folder of its files (default: the mesh's), why it cannot be used."""

    object_id: str
    path: Path
    folder: Path | None = None
    fault: str = ""


def describe_folder(folder: Path) -> str:
    """What a folder holds, for error messages."""
    if not folder.is_dir():
        return "there is no such folder"
    names = sorted(path.name for path in folder.iterdir())
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f"it holds {', '.join(names[:NAMED])}{more}" if names else "it is empty"


Category = Literal["car", "plane", "chair"]
SYNSETS: dict[Category, str] = {"car": "02958343", "plane": "02691156", "chair": "03001627"}  # WordNet 3.0
MESHES = ("models/model_normalized.obj", "model.obj")  # v2, v1


def find_objects(root: Path, category: Category) -> list[Listed]:
    """Every object of a class below a root (the folder that holds the synsets, or the synset), sorted by id."""
    synset = SYNSETS[category]
    folder = root if root.resolve().name == synset and root.is_dir() else root / synset
    objects = []
    for place in sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else ():
        path = next((place / name for name in MESHES if (place / name).is_file()), None)
        fault = "" if path else f"has neither {MESHES[0]} (ShapeNetCore v2) nor {MESHES[1]} (v1)"
        objects.append(Listed(object_id=place.name, path=path or place / MESHES[0], folder=place, fault=fault))
    if all(found.fault for found in objects):
        raise UserError(
            f"--root {root}: expected {synset}/*/{MESHES[0]} or {synset}/*/{MESHES[1]}, as in ShapeNetCore v2 or v1 "
            f"({category} is {synset}); {describe_folder(root)}"
        )
    return objects


FOLDER = "3dmodels"


def find_products(root: Path) -> list[Listed]:
    """Every product below a root (the folder that holds `3dmodels`, or `3dmodels` itself), sorted by id."""
    models = (root / FOLDER if (root / FOLDER).is_dir() else root) / "original"
    paths = sorted(models.glob("*/*.glb"), key=lambda path: path.stem)
    if not paths:
        raise UserError(
            f"--root {root}: expected {FOLDER}/original/*/*.glb, as in the ABO 3D download; {describe_folder(root)}"
        )
    return [Listed(object_id=path.stem, path=path) for path in paths]


def find_meshes(folder: Path) -> list[tuple[str, Path]]:
    """(object id, file) of every mesh file below a folder, sorted by id; ids are unique and safe as folder names.

    An id is the file's name without suffix, or the folder's name where a .gltf or .obj is alone in a subfolder; names
    that collide become the whole path. Hidden files and folders are skipped.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder: give a folder of {' '.join(SUFFIXES)} files")
    relative = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    visible = [p for p in relative if (folder / p).is_file() and not any(part.startswith(".") for part in p.parts)]
    if not visible:
        raise UserError(f"{folder} holds no mesh file: expected {' '.join(SUFFIXES)}, in it or in its subfolders")
    siblings = Counter(path.parent for path in visible)
    names = []
    for path in visible:
        alone = siblings[path.parent] == 1 and path.suffix.lower() in NAMED_BY_FOLDER and path.parent.name
        names.append(_safe(path.parent.name if alone else path.stem))
    shared = Counter(name.casefold() for name in names)
    ids: dict[str, tuple[str, Path]] = {}
    for name, path in zip(names, visible, strict=True):
        unique = wanted = name if shared[name.casefold()] == 1 else _safe("_".join(path.parts))
        number = 2
        while unique.casefold() in ids or (unique != name and unique.casefold() in shared):
            unique, number = f"{wanted}-{number}", number + 1
        ids[unique.casefold()] = unique, folder / path
    return sorted(ids.values())


def _safe(name: str) -> str:
    """A name of letters, digits, dot, dash, underscore that is no hidden folder; no two dashes, which mark variants."""
    return re.sub(r"-{2,}", "-", re.sub(r"[^A-Za-z0-9._-]+", "_", name)).strip("._-") or "object"
