"""The kind of a file, by its first bytes if they tell, else by its suffix; and its points as named columns.

READERS maps each kind to its reader, in row_files.py (.ply .pcd), point_tables.py (text), array_files.py (.npz .npy),
las.py or gaussian_files.py.  Meshes (meshes.py) without faces are read as points.

A reader yields pieces of some ten megabytes, so that a file may be larger than the memory; archives, meshes and
compressed files come in one piece.  Columns have the names and types of the file; columns.py interprets them.
"""

import io
import re
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from spnr_jax.errors import UserError
from spnr_jax.formats.array_files import numpy_pieces
from spnr_jax.formats.columns import Columns, Report
from spnr_jax.formats.gaussian_files import spz_columns
from spnr_jax.formats.las import las_pieces
from spnr_jax.formats.point_tables import encoding_of, text_pieces
from spnr_jax.formats.row_files import read_elements, read_header, row_pieces

TEXT = (".xyz", ".txt", ".csv", ".tsv", ".asc", ".pts")
READERS: dict[str, Callable[[Path, Report], Iterator[Columns]]] = {
    **{kind: partial(row_pieces, kind=kind) for kind in (".ply", ".pcd")},
    **dict.fromkeys(TEXT, text_pieces),
    **dict.fromkeys((".npz", ".npy"), numpy_pieces),
    **dict.fromkeys((".las", ".laz"), las_pieces),
    ".spz": lambda path, _: iter([spz_columns(path)]),
}
MESHES = (".glb", ".gltf", ".obj", ".stl", ".off")
KNOWN = (*READERS, *MESHES)
NUMBER, BLANK = rb"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?", rb"(?i)(\s|#[^\n\r]*[\n\r])*"
# first bytes of a file, and its possible kinds: the one of its suffix if that is among them, else the first
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
    (BLANK + rb"(ST|C|N)*4?n?OFF(?=\d|\b)", (".off",)),
    (BLANK + rb"(mtllib\s|[og]\s[^\n\r]*[\n\r]\s*v\s|v\s+" + NUMBER + rb"\s)", (".obj",)),
    (BLANK + rb"[\s,;]+".join(3 * [NUMBER]) + rb"[\s,;]", (*TEXT, ".off")),
    (BLANK + rb"[\"/%]*x[\s,;\"]+y[\s,;\"]+z\b", TEXT),
)
BLENDER = "convert it to .glb, e.g. with Blender (File > Import, then File > Export > glTF 2.0)"
CLOUDCOMPARE = "convert it to .las or .ply, e.g. with CloudCompare (File > Save)"
PARAVIEW = "convert it to .ply, e.g. with ParaView"
ARRAYS = "save its points in Python with np.savez(file, points=..., colors=...)"
REAL = rb"[-+.\deE]+[ \t]*"
# columns and rows of the scan, four rows of three numbers, then of four
PTX_HEAD = rb"(?:\d+\s*\n){2}(?:(?:" + REAL + rb"){3}\r?\n){4}(?:" + REAL + rb"){4}\r?\n"
# formats that are not read: name (default: the suffix), suffixes, first bytes (groups: version), how to convert
FOREIGN = (
    ("USD (binary crate)", "", rb"PXR-USDC(.)(.)(.)", BLENDER),
    ("USD (text)", "", rb"#usda ([\d.]+)", BLENDER),
    ("USD (package)", ".usdz", b"", BLENDER),
    ("FBX", ".fbx", rb"Kaydara FBX Binary..\0\x1a\0(.{4})|; FBX ([\d.]+)", BLENDER),
    ("VRML", ".wrl", rb"#VRML V([\d.]+)", BLENDER),
    ("COLLADA", ".dae", rb"<.{,400}<COLLADA\s[^>]*version=\"([\d.]+)", BLENDER),
    ("", ".usd .usda .usdc .3ds .blend .x3d .abc", b"", BLENDER),
    ("", ".3mf .dxf .ctm .max .c4d .ma .mb", b"", "export it as a mesh (.glb .obj .stl)"),
    ("Houdini's geometry", ".bgeo", rb"\x7fNSJb|PGEOMETRY|\[\s*\"fileversion", "convert it by `gconvert a.bgeo a.ply`"),
    ("a CAD file", ".step .stp .iges .igs .3dm .skp .ifc", b"", "export it as a mesh (.glb .obj .stl)"),
    ("3D Tiles", ".b3dm .i3dm .pnts .cmpt", b"", "convert it to .glb or .las first"),
    ("E57", ".e57", rb"ASTM-E57(.{4})(.{4})", CLOUDCOMPARE),
    ("", ".ptx .fls", b"", CLOUDCOMPARE),
    ("", ".rcp .rcs .lgs .lgsx .zfs .rdbx .psx .psz", b"", "export it as .las or .ply from the program that wrote it"),
    ("a ROS bag", ".bag .mcap .db3", rb"#ROSBAG V([\d.]+)|\x89MCAP", "save a topic as .pcd with `pcl_ros bag_to_pcd`"),
    ("PTX", "", PTX_HEAD, CLOUDCOMPARE),
    ("CloudCompare's own", "", rb"CCB2", CLOUDCOMPARE),
    ("VTK", ".vtk .vtp .vtu", rb"# vtk DataFile Version ([\d.]+)|<\?xml.{,99}<VTKFile", PARAVIEW),
    ("COLMAP's points", "", rb"# 3D point list", "convert it to .ply with `colmap model_converter --output_type PLY`"),
    ("Draco", ".drc", rb"DRACO(.)(.)", "convert it to .ply with `draco_decoder -i a.drc -o a.ply`"),
    ("", ".splat .ksplat .sog", b"", "convert it to .ply with SuperSplat"),
    ("a grid of heights (ESRI ASCII)", "", rb"ncols", "convert it with `gdal_translate -of XYZ`"),
    ("COLMAP's or another program's binary", ".bin", b"", "convert it with `colmap model_converter`, or " + ARRAYS),
    ("", ".pt .pth .ckpt .pkl .h5 .hdf5 .mat .json .parquet .feather", b"", ARRAYS),
    ("", ".xlsx .xls .ods", b"", "save it as .csv"),
    ("a pointer to a file of Git LFS", "", rb"version https://git-lfs", "fetch it with `git lfs pull`"),
    ("a web page", "", rb"(?i:<(?:!doctype )?html)", "download the file itself"),
    ("a GeoTIFF or other picture", ".tif .tiff", rb"II\*\0|MM\0\*", "convert heights with `gdal_translate -of XYZ`"),
    ("a picture or document", "", rb"\x89PNG|\xff\xd8\xff|%PDF", "give points or a mesh"),
    ("an archive", ".gz .zip .7z .rar .bz2 .xz", rb"\x1f\x8b|PK\x03\x04", "unpack it first"),
)


def kind_of(path: Path) -> str:
    """The kind of a file, written as a suffix: by its first bytes, else by its name.

    ValueError for files that cannot be read names the format, its version and how to convert it.
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
    if kind := _match_kind(MAGIC, head.removeprefix(BOM_UTF8), suffix):
        return kind
    for name, suffixes, sign, advice in FOREIGN:
        begin = re.match(sign, head, re.DOTALL) if sign else None
        if begin or suffix in suffixes.split():
            found = [x for x in begin.groups() if x] if begin else []
            words = [x.decode() if re.fullmatch(rb"[\d.]+", x) else str(int.from_bytes(x, "little")) for x in found]
            of_version = f" of version {'.'.join(words)}" if words else ""
            raise UserError(f"{path}: {name or f'a {suffix} file'}{of_version}, which is not read: {advice}")
    kind = _match_kind(TEXTS, text, suffix) or suffix
    if kind not in KNOWN:
        raise UserError(f"{path}: unknown kind of file {path.suffix!r}; expected {known}")
    return kind


def _match_kind(signs: Sequence[tuple[bytes, tuple[str, ...]]], head: bytes, suffix: str) -> str:
    """The kind of a file by its first bytes; empty if they do not tell."""
    kinds = next((kinds for sign, kinds in signs if re.match(sign, head)), ("",))
    return suffix if suffix in kinds else kinds[0]


def column_pieces(path: Path, kind: str, report: Report) -> Iterator[Columns] | None:
    """The columns of a point file, some points at a time; None for a mesh; `kind` from `kind_of`."""
    if kind == ".ply":
        with path.open("rb") as file:
            if read_header(file, kind).faces:
                return None
    return READERS[kind](path, report) if kind in READERS else None


def parse_ply(content: bytes) -> Columns:
    """The columns of the vertices in the bytes of a PLY file."""
    file = io.BytesIO(content)
    return read_elements(file, read_header(file, ".ply"), "vertex")["vertex"][0]
