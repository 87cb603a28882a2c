"""Files opened: which kind a file is, by its first bytes where they tell, and its points as named columns.

READERS says which module reads which kind: points from row_files.py (.ply .pcd), point_tables.py (text, .npz
.npy), las.py and gaussian_files.py; meshes (meshes.py) are read as points where they have no faces.

A reader yields pieces of at most some ten megabytes (archives, meshes and compressed files come whole), so that a file
may be larger than the memory.  Columns are raw: names and types are those of the file, positions float64 where the file
has them so; what they mean is the affair of spnr_jax/formats/columns.py.
"""

import io
import re
import struct
from codecs import BOM_UTF8
from collections.abc import Iterator, Sequence
from pathlib import Path

from spnr_jax.errors import UserError
from spnr_jax.formats.columns import Columns, Report
from spnr_jax.formats.gaussian_files import decompress_columns, spz_columns
from spnr_jax.formats.las import las_pieces
from spnr_jax.formats.point_tables import encoding_of, numpy_pieces, text_pieces
from spnr_jax.formats.row_files import (
    element_pieces,
    pcd_pieces,
    read_elements,
    read_ply_header,
    report_further_rows,
)

TEXT = (".xyz", ".txt", ".csv", ".tsv", ".asc", ".pts")
READERS = {
    **{".ply": lambda path, report: _ply(path, report), ".pcd": pcd_pieces},
    **dict.fromkeys(TEXT, text_pieces),
    **dict.fromkeys((".npz", ".npy"), numpy_pieces),
    **dict.fromkeys((".las", ".laz"), lambda path, _: las_pieces(path)),
    ".spz": lambda path, _: iter([spz_columns(path)]),
}
MESHES = (".glb", ".gltf", ".obj", ".stl", ".off")
KNOWN = (*READERS, *MESHES)
NUMBER, BLANK = rb"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?", rb"(?i)(\s|#[^\n\r]*[\n\r])*"
# how a file begins, and the kind that this tells: of several the one that its own suffix names, else the first
MAGIC = (
    (rb"ply", (".ply",)),
    (rb"glTF", (".glb",)),
    (rb"LASF", (".las", ".laz")),
    (rb"\x93NUMPY", (".npy",)),
    (rb"# .PCD", (".pcd",)),
    (rb"NGSP", (".spz",)),
    (rb"\x1f\x8b|PK\x03\x04", ("", ".spz", ".npz", ".npy")),
)
TEXTS = (
    (rb"(?i)solid\b[^\0]*?\b(facet|endsolid)\b", (".stl",)),
    (BLANK + rb"(ST)?C?N?4?n?OFF(?=\d|\b)", (".off",)),
    (BLANK + rb"(mtllib\s|[og]\s[^\n\r]*[\n\r]\s*v\s|v\s+" + NUMBER + rb"\s)", (".obj",)),
    (BLANK + rb"[\s,;]+".join(3 * [NUMBER]) + rb"[\s,;]", (*TEXT, ".off")),
)
BLENDER = "convert it to .glb, e.g. with Blender (File > Import, then File > Export > glTF 2.0)"
COLMAP = "convert it to .ply with `colmap model_converter --output_type PLY`"
ARRAYS = "save its points in Python with np.savez(file, points=..., colors=...)"
PARAVIEW = "convert it to .ply, e.g. with ParaView (File > Save Data)"
CLOUDCOMPARE = "convert it to .las or .ply, e.g. with CloudCompare (File > Save)"
# first bytes or suffix -> what it is, where its version stands (as struct has it), how to convert it
FOREIGN: dict[bytes | str, tuple] = {
    b"PXR-USDC": ("USD (binary crate)", "8x3B", BLENDER),
    b"#usda": ("USD (text)", "6x3s", BLENDER),
    b"ASTM-E57": ("an E57 scan", "<8x2I", CLOUDCOMPARE),
    b"version https://git-lfs": ("a pointer to a file that Git LFS keeps", None, "fetch it with `git lfs pull`"),
    b"ncols": ("a grid of heights (ESRI ASCII)", None, "convert it with `gdal_translate -of XYZ`"),
    b"# 3D point list": ("points of COLMAP", None, COLMAP),
    **dict.fromkeys((b"<!doctype html", b"<!DOCTYPE html", b"<html"), ("a web page", None, "download the file itself")),
    **dict.fromkeys((b"\x89PNG", b"\xff\xd8\xff", b"%PDF"), ("a picture or document", None, "give points or a mesh")),
    b"Kaydara FBX Binary": ("an FBX scene", "<23xI", BLENDER),
    ".usdz": ("USD (package)", None, BLENDER),
    **dict.fromkeys((".usd", ".usda", ".usdc"), ("USD", None, BLENDER)),
    ".e57": ("an E57 scan", None, CLOUDCOMPARE),
    **dict.fromkeys((".ptx", ".rcp", ".rcs", ".fls"), ("a scan of its maker's own kind", None, CLOUDCOMPARE)),
    ".bin": (
        "a binary file of one program",
        None,
        f"of COLMAP, {COLMAP}; of CloudCompare, save it there as .las or .ply; of KITTI, "
        "np.save('a.npy', np.fromfile('a.bin', 'f4').reshape(-1, 4))",
    ),
    **dict.fromkeys((".pt", ".pth", ".pkl", ".h5", ".hdf5", ".mat", ".parquet"), ("data", None, ARRAYS)),
    ".xlsx": ("a spreadsheet", None, "save it as .csv"),
    **dict.fromkeys((".vtk", ".vtp", ".vtu"), ("data of VTK", None, PARAVIEW)),
    ".drc": ("a Draco file", None, "convert it to .ply with `draco_decoder -i a.drc -o a.ply`"),
    **dict.fromkeys((".fbx", ".dae", ".3ds", ".3mf", ".blend", ".x3d", ".wrl"), ("a scene", None, BLENDER)),
    **dict.fromkeys((".splat", ".ksplat", ".sog"), ("a file of splats", None, "convert it to .ply with SuperSplat")),
    **dict.fromkeys((".gz", ".zip", ".7z", ".rar", ".bz2", ".xz"), ("an archive", None, "unpack it first")),
    **dict.fromkeys((b"\x1f\x8b", b"PK\3\4"), ("an archive", None, "unpack it first")),
}


def kind_of(path: Path) -> str:
    """The suffix that names how a file is read, by its first bytes, else its name; ValueError for what cannot be read.

    The error names the format, its version and how to convert it.
    """
    suffix, known = path.suffix.lower(), f"one of {' '.join(KNOWN)}"
    if path.is_dir():
        raise UserError(f"{path}: a folder; expected a file of {known}")
    if path.exists() and not path.is_file():
        raise UserError(f"{path}: a pipe or a device; save what comes from it as a file")
    if not path.is_file():
        raise UserError(f"{path}: there is no such file")
    with path.open("rb") as file:
        head = file.read(4096)
    if not head:
        raise UserError(f"{path}: the file is empty")
    text = head.decode(encoding_of(head), "ignore").encode()
    if kind := _told_kind(MAGIC, head.removeprefix(BOM_UTF8), suffix):
        return kind
    for sign, (name, version, convert) in FOREIGN.items():
        if sign == suffix if isinstance(sign, str) else head.startswith(sign):
            found = struct.unpack_from(version, head) if version and len(head) >= struct.calcsize(version) else ()
            words = [value.decode("ascii", "replace") if isinstance(value, bytes) else str(value) for value in found]
            of_version = f" of version {'.'.join(words)}" if words else ""
            raise UserError(f"{path}: {name}{of_version}, which is not read: {convert}")
    kind = _told_kind(TEXTS, text, suffix) or suffix
    if kind not in KNOWN:
        raise UserError(f"{path}: unknown kind of file {path.suffix!r}; expected {known}")
    return kind


def _told_kind(signs: Sequence[tuple[bytes, tuple[str, ...]]], head: bytes, suffix: str) -> str:
    """The kind that the first bytes of a file tell; empty if they tell none."""
    kinds = next((kinds for sign, kinds in signs if re.match(sign, head)), ("",))
    return suffix if suffix in kinds else kinds[0]


def column_pieces(path: Path, kind: str, report: Report) -> Iterator[Columns] | None:
    """The columns of a file of points, some points at a time; None for a mesh; `kind` as kind_of says."""
    if kind == ".ply":
        with path.open("rb") as file:
            if read_ply_header(file).faces:
                return None
    return READERS[kind](path, report) if kind in READERS else None


def parse_ply(content: bytes) -> Columns:
    """The columns of the vertices in the bytes of a PLY file."""
    file = io.BytesIO(content)
    return read_elements(file, read_ply_header(file), "vertex")["vertex"][0]


def _ply(path: Path, report: Report) -> Iterator[Columns]:
    """The columns of a .ply file, unpacked where it is one of compressed splats."""
    with path.open("rb") as file:
        header = read_ply_header(file)
        fields = {name: {field for field, *_ in properties} for name, _, properties in header.elements}
        if list(fields)[:2] == ["chunk", "vertex"] and "packed_position" in fields["vertex"]:
            (chunks, _), (packed, _) = read_elements(file, header, "chunk", "vertex").values()
            yield decompress_columns(chunks, packed)
        else:
            yield from (columns for _, columns, _ in element_pieces(file, header, "vertex"))
            name, count, properties = header.elements[-1]
            if name == "vertex":
                report_further_rows(file, count, properties, header.text, report)
