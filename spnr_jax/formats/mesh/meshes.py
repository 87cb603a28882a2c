"""Mesh files as assets: which files a folder holds, and one of them read.

glTF and GLB carry principled materials (gltf.py), OBJ gets them from its MTL (obj.py); PLY, STL and
OFF have vertex or face colours at most (8-bit colours are sRGB, float ones linear), grey 0.5 otherwise.
Every reason not to use a file is a RejectedAsset with one line.
"""

import hashlib
import io
import re
import struct
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from trimesh.exchange.off import load_off
from trimesh.exchange.ply import load_ply
from trimesh.exchange.stl import load_stl
from trimesh.geometry import triangulate_quads

from spnr_jax.errors import UserError, is_bug
from spnr_jax.formats.mesh.assemble import assemble
from spnr_jax.formats.mesh.assets import Asset, Part, RejectedAsset, TransparentParts
from spnr_jax.formats.mesh.gltf import load_gltf
from spnr_jax.formats.mesh.obj import load_obj, principled
from spnr_jax.formats.mesh.texels import srgb_to_linear

TEXT_OR_BINARY = {".ply": load_ply, ".stl": load_stl, ".off": load_off}
SUFFIXES = (".glb", ".gltf", ".obj", *TEXT_OR_BINARY)
NAMED_BY_FOLDER = (".gltf", ".obj")  # files that come with companions, so that the folder is the object
# What readers raise on files that break their rules; not MemoryError and not an interrupt.
UNREADABLE: tuple[type[Exception], ...]
UNREADABLE = (ValueError, LookupError, TypeError, AttributeError, NameError, ArithmeticError, OSError, RuntimeError)
UNREADABLE += (AssertionError, struct.error, DeprecationWarning)
UNREADABLE += (ImportError,)  # trimesh looks for a package that guesses the encoding of text that is not UTF-8


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


def load_mesh(path: Path, root: Path | None = None, transparent_parts: TransparentParts = "refuse") -> Asset:
    """The object in a mesh file, parts merged by material; `source` names the file and its checksum.

    `root` is the object's folder, which may hold an .obj file's companions above it (default: the file's folder).
    RejectedAsset, with one line, for a file that cannot be used: unreadable or truncated, without faces or extent,
    with buffers missing or outside its folder.  "refuse", for references, also refuses what is transparent and images
    and libraries that are missing; "opaque" and "skip", for pictures, say in `notes` what was made of them, and read
    what the renderer of references does not know: cut-outs, normal maps, several texture coordinates (tolerance.py).
    """
    path = Path(path)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):  # assemble looks for what is not finite
            # numpy only warns where the text of a file stops being numbers
            warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
            asset = assemble(_load(path, root, transparent_parts))
        checksum = hashlib.sha256(path.read_bytes()).hexdigest()
    except RejectedAsset:
        raise
    except UNREADABLE as error:
        if is_bug(error):
            raise
        text = str(error).strip().split("\n")[0]
        raise RejectedAsset(
            f"cannot be read, the file is broken or truncated ({type(error).__name__}: {text})"
        ) from error
    return replace(asset, source={"file": path.name, "sha256": checksum})


def _load(path: Path, root: Path | None, transparent_parts: TransparentParts) -> Asset:
    """The raw asset of a file, by its suffix."""
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return load_gltf(path, transparent_parts)
    if suffix == ".obj":
        return load_obj(path, root, transparent_parts)
    if suffix not in TEXT_OR_BINARY:
        raise RejectedAsset(f"has suffix {suffix!r}; expected one of {' '.join(SUFFIXES)}")
    data = path.read_bytes()
    loaded = TEXT_OR_BINARY[suffix](io.BytesIO(data))
    meshes = loaded["geometry"].values() if "geometry" in loaded else [loaded]
    ignored = {"COFF vertex colours"} if data.startswith(b"COFF") else set()
    parts = tuple(_colored_part(mesh, ignored) for mesh in meshes if mesh.get("faces") is not None)
    return Asset(parts=parts, ignored=tuple(ignored))


def _colored_part(mesh: dict, ignored: set[str]) -> Part:
    """A part of a PLY, STL or OFF file; face colours give every face its own three vertices."""
    positions, faces = np.asarray(mesh["vertices"], np.float64), triangulate_quads(mesh["faces"]).reshape(-1, 3)
    part = Part(positions=positions, faces=faces, material=principled(), normals=mesh.get("vertex_normals"))
    vertex_colors, face_colors = mesh.get("vertex_colors"), mesh.get("face_colors")
    if "visual" in mesh:
        ignored.add("texture coordinates (of formats other than glTF and OBJ)")
    if np.any(mesh.get("face_attributes", {}).get("stl", 0)):
        ignored.add("STL attribute bytes")
    if vertex_colors is not None:
        return replace(part, colors=_linear(vertex_colors), material=principled(1.0))
    if face_colors is None:
        return part
    if len(face_colors) != len(faces):
        ignored.add("colours of faces with more than three corners")
        return part
    corners = np.arange(faces.size).reshape(-1, 3)
    colors = np.repeat(_linear(face_colors), 3, axis=0)
    return Part(positions=positions[faces.ravel()], faces=corners, material=principled(1.0), colors=colors)


def _linear(colors: np.ndarray) -> np.ndarray:
    """Linear RGB (n, 3) of file colours (n, 3 or 4): integers are sRGB in 0..255, floats linear."""
    rgb = np.asarray(colors)[:, :3]
    return rgb.astype(np.float64) if rgb.dtype.kind == "f" else srgb_to_linear(rgb / 255)


def _short_name(path: Path, alone: bool) -> str:
    """The id that a file gets if no other wants it."""
    folder_names_it = alone and path.suffix.lower() in NAMED_BY_FOLDER and path.parent.name
    return _safe(path.parent.name if folder_names_it else path.stem)


def _safe(name: str) -> str:
    """A name of letters, digits, dot, dash and underscore that is no hidden folder."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._-") or "object"
