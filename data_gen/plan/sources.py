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
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from spnr_jax.errors import UserError


@dataclass(frozen=True, kw_only=True)
class Listed:
    """One object of a source: its mesh file, the folder that its files lie in, or why it cannot be used."""

    object_id: str
    path: Path
    folder: Path
    fault: str = ""


def describe_folder(folder: Path, most: int = 5) -> str:
    """What a folder holds, for a message to somebody who expected something else."""
    if not folder.is_dir():
        return "there is no such folder"
    names = sorted(path.name for path in folder.iterdir())
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"it holds {', '.join(names[:most])}{more}" if names else "it is empty"


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
    return [Listed(object_id=path.stem, path=path, folder=path.parent) for path in paths]
