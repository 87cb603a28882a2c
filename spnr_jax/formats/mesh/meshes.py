"""Mesh files as assets: which files a folder holds, and one of them read.

glTF and GLB carry principled materials (gltf.py), OBJ gets them from its MTL (obj.py); PLY, STL and
OFF (plain.py) have vertex or face colours at most, read as those of points are (file_colors.py), grey 0.5 otherwise.
Every reason not to use a file is a RejectedAsset with one line.
"""

import hashlib
import logging
import re
import struct
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from spnr_jax.errors import UserError, is_bug
from spnr_jax.formats.mesh.assemble import assemble
from spnr_jax.formats.mesh.assets import Asset, RejectedAsset, TransparentParts
from spnr_jax.formats.mesh.gltf import gltf_points, load_gltf
from spnr_jax.formats.mesh.obj import load_obj, obj_points
from spnr_jax.formats.mesh.plain import PLAIN, off_points

SUFFIXES = (".glb", ".gltf", ".obj", *PLAIN)
NAMED_BY_FOLDER = (".gltf", ".obj")  # files that come with companions, so that the folder is the object
Result = TypeVar("Result")
# What readers raise on files that break their rules; not MemoryError and not an interrupt.
UNREADABLE: tuple[type[Exception], ...]
UNREADABLE = (ValueError, LookupError, TypeError, AttributeError, NameError, ArithmeticError, OSError, RuntimeError)
UNREADABLE += (AssertionError, struct.error, DeprecationWarning)
UNREADABLE += (ImportError,)  # trimesh looks for a package that guesses the encoding of text that is not UTF-8
# it shows the call stacks of errors that it gets over, unless somebody takes care of them
logging.getLogger("trimesh").addHandler(logging.NullHandler())


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
    names = [_short_name(path, alone=siblings[path.parent] == 1) for path in visible]
    shared = Counter(name.casefold() for name in names)
    ids: dict[str, Path] = {}
    taken: set[str] = set()
    for name, path in zip(names, visible, strict=True):
        unique = wanted = name if shared[name.casefold()] == 1 else _safe("_".join(path.parts))
        number = 2
        while unique.casefold() in taken or (unique != name and unique.casefold() in shared):
            unique, number = f"{wanted}-{number}", number + 1
        taken.add(unique.casefold())
        ids[unique] = folder / path
    return sorted(ids.items())


def load_mesh(
    path: Path, root: Path | None = None, transparent_parts: TransparentParts = "refuse", kind: str | None = None
) -> Asset:
    """The object in a mesh file, parts merged by material; `source` names the file and its checksum.

    `root` is the object's folder, which may hold an .obj file's companions above it (default: the file's folder).
    RejectedAsset, with one line, for a file that cannot be used: unreadable or truncated, without faces or extent,
    with buffers missing or outside its folder.  "refuse", for references, also refuses what is transparent and images
    and libraries that are missing; "opaque" and "skip", for pictures, say in `notes` what was made of them, leave out
    faces whose vertices are not finite, and read what the renderer of references does not know: cut-outs, normal maps,
    several texture coordinates (tolerance.py).  `kind` is a suffix to go by instead of the file's.
    """
    path = Path(path)
    kind = kind or path.suffix.lower()

    def read() -> Asset:
        asset = _load(path, kind, root, transparent_parts)
        return assemble(asset if transparent_parts == "refuse" else _finite(asset))

    asset = _guarded(read)
    return replace(asset, source={"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()})


def points_of(path: Path, kind: str) -> dict[str, np.ndarray] | None:
    """The columns of the points of a mesh file that has no faces, for pictures; None where it has some."""
    readers = {".obj": obj_points, ".off": off_points, ".glb": gltf_points, ".gltf": gltf_points}
    return _guarded(lambda: readers[kind](path)) if kind in readers else None


def _guarded(read: Callable[[], Result]) -> Result:
    """What `read` makes of a file; RejectedAsset where its libraries stumble over it."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):  # assemble looks for what is not finite
            # numpy only warns where the text of a file stops being numbers
            warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
            return read()
    except RejectedAsset:
        raise
    except UserError as error:  # colours that are none, say
        raise RejectedAsset(str(error)) from error
    except UNREADABLE as error:
        if is_bug(error):
            raise
        text = str(error).strip().split("\n")[0]
        raise RejectedAsset(
            f"cannot be read, the file is broken or truncated ({type(error).__name__}: {text})"
        ) from error


def _finite(asset: Asset) -> Asset:
    """The asset without faces that name a vertex which is not finite, and a note about how many these are."""
    parts, lost = [], 0
    for part in asset.parts:
        sound = np.isfinite(part.positions).all(axis=-1)
        if (
            part.faces.ndim == 2
            and part.faces.size
            and not sound.all()
            and part.faces.min() >= 0
            and (part.faces.max() < len(sound))
        ):
            whole = sound[part.faces].all(axis=1)
            lost += int((~whole).sum())
            part = replace(part, faces=part.faces[whole], positions=np.where(sound[:, None], part.positions, 0))
        parts.append(part)
    if not lost:
        return asset
    note = f"{lost:,} {'face' if lost == 1 else 'faces'} left out for a vertex that is NaN or infinity"
    return replace(asset, parts=tuple(parts), notes=(*asset.notes, note))


def _load(path: Path, kind: str, root: Path | None, transparent_parts: TransparentParts) -> Asset:
    """The raw asset of a file of a kind."""
    if kind in (".glb", ".gltf"):
        return load_gltf(path, transparent_parts)
    if kind == ".obj":
        return load_obj(path, root, transparent_parts)
    if kind not in PLAIN:
        raise RejectedAsset(f"has suffix {kind!r}; expected one of {' '.join(SUFFIXES)}")
    return PLAIN[kind](path.read_bytes())


def _short_name(path: Path, alone: bool) -> str:
    """The id that a file gets if no other wants it."""
    folder_names_it = alone and path.suffix.lower() in NAMED_BY_FOLDER and path.parent.name
    return _safe(path.parent.name if folder_names_it else path.stem)


def _safe(name: str) -> str:
    """A name of letters, digits, dot, dash and underscore that is no hidden folder."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._-") or "object"
