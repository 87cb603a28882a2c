"""ShapeNetCore: the objects of one class, in the layout of version 2 or 1.

    v2  SYNSET/ID/models/model_normalized.obj + .mtl, textures in SYNSET/ID/images (named ../images/x.jpg)
    v1  SYNSET/ID/model.obj + .mtl, textures in SYNSET/ID/images

The object's id is ID. Both versions are y up; the front is -z in v2 and +x in v1, and is left as it lies: a data set
should come from one version, for its light comes from a fixed direction. What lies in a class's folder without a
mesh (some objects of v2) is an object that is left out.
"""

from pathlib import Path
from typing import Literal, get_args

from data_gen.plan.sources.listing import Listed, described
from spnr_jax.errors import UserError

Category = Literal["car", "plane", "chair"]
SYNSETS: dict[str, str] = {"car": "02958343", "plane": "02691156", "chair": "03001627"}  # WordNet 3.0
MESHES = ("models/model_normalized.obj", "model.obj")  # v2, v1


def find_objects(root: Path, category: str) -> list[Listed]:
    """Every object of a class below a root (the folder that holds the synsets, or the synset), sorted by id."""
    if category not in SYNSETS:
        raise UserError(f"--category {category}: expected one of {', '.join(get_args(Category))}")
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
            f"({category} is {synset}); {described(root)}"
        )
    return objects
