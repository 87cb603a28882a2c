"""Objects in memory: parts of triangles with principled materials; and what mesh readers share.

Conventions:
  axes        right-handed, y up (as in glTF), any unit; `normalise` maps an object into the unit sphere
  colours     linear RGB in [0, 1]
  textures    rows of texels; texture coordinate (u, v) = (0, 0) is the outer corner of texel [0, 0], v increases down
              the rows (as in glTF and in mitsuba's `bitmap`); box-filtered to at most MAX_SIZE a side
  faces       numbered through all parts of an object in order: global face = faces of the parts before + local face

For reference images ("refuse"), transparent parts and missing files are errors.  For a picture, a missing image is
replaced by plain values, and transparency becomes surface or nothing:
  MASK                  surface where alpha reaches the file's cut-off
  BLEND, transmission   "opaque": surface, except for texels that are nearly invisible beside the most visible one
                        "skip": surface where alpha is at least 0.5; transmissive parts are left out
"""

import base64
import contextlib
import importlib
import io
import itertools
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from PIL import Image, UnidentifiedImageError
from scipy.ndimage import map_coordinates

from spnr_jax.errors import UserError, refusing
from spnr_jax.formats.columns import LONGEST_NAME, ROUNDING
from spnr_jax.kernels.imaging import srgb_to_linear

Wrap = Literal["repeat", "mirror", "clamp"]
MODES = {"repeat": "grid-wrap", "mirror": "reflect", "clamp": "nearest"}  # SciPy's names
Values = np.ndarray | np.floating  # NumPy returns scalars for arrays without axes
ShownParts = Literal["opaque", "skip"]
TransparentParts = Literal["refuse", ShownParts]
CHANNELS = {"base_color": 1, "roughness": 0, "metallic": 0, "opacity": 0, "normal_map": 1}  # axes of a single value
BARELY_VISIBLE = 0.1  # alpha, as a share of the texture's maximum, below which a texel is empty
MOSTLY_OPAQUE = 0.5
MOST_NAMES = 3  # in a message
TEXTURES = "textures"  # Sketchfab's downloads have it beside the folder of the mesh
CODE_PAGES = ("cp1252", "cp1251", "gbk", "shift_jis")  # of names in older files
MAX_SIZE = 1024
MOST_PIXELS = 2**26  # of an image file: 8192 x 8192
MOST_HELD = 2**27  # bytes of decoded images that may be asked for again
LEVELS = np.arange(256, dtype=np.float32) / 255  # of 8 bits
CURVES: dict[str, np.ndarray] = {  # values of encoded texels; those of a normal map are components of directions
    "linear": LEVELS,
    "sRGB": srgb_to_linear(np.arange(256) / 255).astype(np.float32),
    "direction": (2 * (np.arange(256) / 255) - 1).astype(np.float32),
}
RGB = (0, 1, 2)  # channels of texels


def extra(package: str, name: str = "meshes") -> Any:
    """Imports a package of an extra; UserError if it is not installed."""
    try:
        return importlib.import_module(package)
    except ImportError:
        raise UserError(f"needs the package {package} to be read: pip install 'spnr-jax[{name}]'") from None


@dataclass(frozen=True, kw_only=True)
class Material:
    """A principled (metallic-roughness) material; each channel is one value or a texture of its own size.

    base_color: (3,) or (height, width, 3); roughness, metallic: () or (height, width). All float32 in [0, 1], linear.
    opacity (height, width) or None: surface where it is at least `cutoff`.
    normal_map (height, width, 3) or None: tangent-space normals; axes: increasing u, decreasing v, outwards.
    """

    base_color: np.ndarray
    roughness: Values
    metallic: Values
    wrap: Wrap = "repeat"
    opacity: np.ndarray | None = None
    cutoff: float | int = 0.5
    normal_map: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class Part:
    """Triangles that share one material.

    positions (v, 3) float64; faces (f, 3) int64, counter-clockwise from outside if the source is consistent;
    normals (v, 3) unit, or None for flat shading; texcoords (v, 2), needed only if the material has a texture;
    colors (v, 3) linear, multiplies the material's base colour, or None; alpha (v,) of any range, or None.
    """

    positions: np.ndarray
    faces: np.ndarray
    material: Material
    normals: np.ndarray | None = None
    texcoords: np.ndarray | None = None
    colors: np.ndarray | None = None
    alpha: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class Asset:
    """One object: its parts, which have no faces if the file holds points.

    `ignored`: names of features of the file that are not modelled.  `notes`: sentences about transparent parts, missing
    files and other decisions.
    """

    parts: tuple[Part, ...] = ()
    category: str = "object"
    ignored: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    source: dict = field(default_factory=dict)


def make_material(base_color: Any = 0.5, roughness: Any = 0.5, metallic: Any = 0.0, wrap: Wrap = "repeat") -> Material:
    """A material of channels, one value or an array each, clipped to [0, 1]; grey of roughness 0.5 by default."""
    color = np.broadcast_to(base_color, (*np.shape(base_color)[:-1], 3))
    channels: dict[str, Any] = {"base_color": color, "roughness": roughness, "metallic": metallic}
    for name, values in channels.items():
        channels[name] = values = np.asarray(values, np.float32)
        if values.ndim - CHANNELS[name] not in (0, 2) or 0 in values.shape:
            raise UserError(f"has a material with {name} of shape {values.shape}: broken file")
        if not np.isfinite(values).all():
            raise UserError(f"has a material whose {name} is not finite (NaN or infinity)")
    return Material(**{name: np.clip(values, 0, 1) for name, values in channels.items()}, wrap=wrap)


class Loading:
    """The state of reading one mesh file: where its companion files are, what may be missing, and notes.

    `folder` is the mesh's; `root` is the object's, the same or one above it: ShapeNet keeps images beside the folder of
    the mesh (`../images`).  `ignored` collects features of the file that are not modelled.
    """

    def __init__(self, folder: Path, root: Path | None = None, transparent_parts: TransparentParts = "refuse"):
        self.folder, self.root, self.transparent_parts = folder, root or folder, transparent_parts
        self.strict = transparent_parts == "refuse"  # nothing may be missing or replaced
        self.ignored: set[str] = set()
        self._said: dict[str, dict[str, None]] = {}  # beginning of a sentence -> names, in order
        self._images: dict[str, Texels | None] = {}

    def read(self, uri: str, needed: bool = False) -> bytes | None:
        """Bytes of the file at `uri` (percent escapes as in glTF), or of a data URI; None if it is missing.

        Looks in the mesh's folder, then in those above it up to `root`, for the longest suffix of the path that exists,
        ignoring letter case; then in a folder `textures` in or beside the mesh's.  So absolute paths of another machine
        still work, and nothing else outside `root` is read.  UserError for a missing file if it is `needed` or the
        reading is strict.
        """
        if uri.startswith("data:"):
            head, _, payload = uri.partition(",")
            with refusing("holds a data URI that is not base64"):
                data = unquote_to_bytes(payload)
                return base64.b64decode(payload, validate=True) if head.endswith(";base64") else data
        names = dict.fromkeys(text.replace("\\", "/") for x in (uri, unquote(uri)) for text in _readings(x))
        folders: list[tuple[Path, list[str]]] = [
            (x, []) for x in (self.folder, *self.folder.parents) if x.is_relative_to(self.root)
        ]
        folders += [(x, [TEXTURES]) for x in (self.folder, self.folder.absolute().parent)]
        for (folder, below), name in itertools.product(folders, names):
            parts = [part for part in name.split("/") if part not in ("", ".")]
            for start in range(len(parts)):
                if place := _find(folder, [*below, *parts[start:]]):
                    if below:
                        self.say(f"found in a folder `{TEXTURES}`", about=repr(_printable(place.name)))
                    return place.read_bytes()
        self.go_on_without("names a file that is missing", repr(unquote(uri)), needed)
        return None

    def read_image(self, name: str, data: bytes | memoryview | None = None) -> "Texels | None":
        """The image of that name, of `data` or else of the file at this uri; None if it is missing or cannot be read.

        It is decoded once, unless the images since then fill MOST_HELD bytes.
        """
        if name not in self._images:
            if sum(image.encoded.nbytes for image in self._images.values() if image) > MOST_HELD:
                self._images.clear()
            content = self.read(name) if data is None else bytes(data)
            self._images[name] = None if content is None else self._decode_image(content, _printable(name[:80]))
        return self._images[name]

    def _decode_image(self, content: bytes, name: str) -> "Texels | None":
        try:
            with refusing(name):
                return Texels(decode_image(content))
        except UserError as error:
            self.go_on_without("names an image that cannot be read", str(error))
        return None

    def say(self, *sentences: str, about: str = "") -> None:
        """Adds sentences to the notes, or a name to the sentence that begins so."""
        for sentence in sentences:
            self._said.setdefault(sentence, {}).update({about: None} if about else {})

    def notes(self) -> tuple[str, ...]:
        """The notes, one sentence each."""
        notes = []
        for beginning, names in self._said.items():
            more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
            notes.append(f"{beginning}: {', '.join(list(names)[:MOST_NAMES])}{more}" if names else beginning)
        return tuple(notes)

    def go_on_without(self, reason: str, name: str, needed: bool = False) -> None:
        """Notes that plain values replace something missing; UserError if it is needed or the reading is strict."""
        if needed or self.strict:
            raise UserError(f"{reason}: {name}")
        self.say(f"plain values taken where it {reason}", about=name[:200])

    def cut_out(
        self, name: str, material: Material, why: str, alpha: np.ndarray, cutoff: float | int | None = None
    ) -> Material | None:
        """The material with surface only where its alpha () or (h, w) says so; None if there is none.

        `why`: the statement of the file that makes it transparent, or "".  `cutoff`: that of a mask.  UserError for
        transparency if the reading is strict.
        """
        if why and self.strict:
            raise UserError(f"is transparent: material {name!r} has {why}")
        if not why or (cutoff is None and alpha.min() >= 1):
            return material
        masked, limit = cutoff is not None, MOSTLY_OPAQUE if cutoff is None else cutoff
        if masked:
            sentence = "surface only where the alpha of the texture reaches its cut-off"
        elif self.transparent_parts == "skip":
            sentence = "transparent parts left out (--transparent-parts opaque draws them)"
        else:
            sentence = "transparent parts drawn as opaque (--transparent-parts skip leaves them out)"
            limit = BARELY_VISIBLE * float(alpha.max())
        surface = alpha >= limit
        if masked and not surface.any():
            sentence = "left out, wholly below the alpha cut-off"
        if not (masked and surface.all()):
            self.say(sentence, about=repr(name[:LONGEST_NAME]))
        if surface.all() or not surface.any():
            return material if surface.any() else None
        return replace(material, opacity=alpha.astype(np.float32), cutoff=limit)


def _readings(name: str) -> Iterator[str]:
    """A name as it is and, if its bytes are no UTF-8, as other code pages have it."""
    yield name
    if _printable(name) != name:
        for page in CODE_PAGES:
            with contextlib.suppress(UnicodeError):
                yield name.encode("utf-8", "surrogateescape").decode(page)


def _printable(name: str) -> str:
    """The name with question marks for bytes that are no UTF-8."""
    return name.encode("utf-8", "replace").decode()


def _find(folder: Path, names: list[str]) -> Path | None:
    """The file at this path below a folder, ignoring letter case; exact names are preferred."""
    with contextlib.suppress(OSError, UnicodeError):  # a folder that cannot be listed, a name that cannot be one
        for name in names:
            if name == ".." or ":" in name or not folder.is_dir():
                return None
            exact, plain = folder / name, name.casefold()
            alike = [] if exact.exists() else sorted(x for x in folder.iterdir() if x.name.casefold() == plain)
            folder = next(iter(alike), exact)
        return folder if folder.is_file() else None
    return None


# --- textures ---------------------------------------------------------------------------------------------------------


class Texels:
    """Encoded texels (h, w, 4) of an image; the values of channels are computed once for all materials that show it."""

    def __init__(self, encoded: np.ndarray):
        self.encoded = encoded
        self._decoded: dict[tuple, np.ndarray] = {}  # a functools.cache here would outlive the texels until gc runs

    def values(self, channels: int | tuple[int, ...], curve: str) -> np.ndarray:
        """Values (h, w) or (h, w, c) of channels by one of the CURVES."""
        if (key := (channels, curve)) not in self._decoded:
            self._decoded[key] = decode_texels(self.encoded[..., channels], CURVES[curve])
        return self._decoded[key]


def decode_image(data: bytes) -> np.ndarray:
    """Encoded texels (height, width, 4) uint8 of an image file; alpha is 255 if it has none.

    ValueError if it is no image or too large; Pillow's exceptions if it is damaged.
    """
    if data.startswith(b"\xabKTX 20\xbb\r\n\x1a\n"):
        raise ValueError("KTX2, which is not read: convert it to PNG, e.g. with `ktx extract`")
    try:
        with warnings.catch_warnings(action="error", category=Image.DecompressionBombWarning):
            image: Image.Image = Image.open(io.BytesIO(data))
    except UnidentifiedImageError:
        raise ValueError("is not an image") from None
    if image.width * image.height > MOST_PIXELS:  # before allocating them
        raise ValueError(f"{image.width} x {image.height} pixels, more than {MOST_PIXELS}")
    if image.mode[0] in "IF":  # Pillow clips grey of 16 bits or floats to 255 instead of scaling it
        levels = np.nan_to_num(np.asarray(image))
        white = 65535 if image.mode != "F" else 1 if levels.max() <= 1 + ROUNDING else 255
        image = Image.fromarray(np.round(np.clip(levels * (255 / white), 0, 255)).astype(np.uint8))
    return np.asarray(image.convert("RGBA"))


def decode_texels(encoded: np.ndarray, table: np.ndarray = LEVELS) -> np.ndarray:
    """Values float32 of texels (h, w) or (h, w, c) uint8 by a table (256,), box-filtered to at most MAX_SIZE a side."""
    height, width, *channels = encoded.shape
    ratio = min(1, MAX_SIZE / max(height, width))
    size = max(1, round(height * ratio)), max(1, round(width * ratio))
    flat = encoded.reshape(height, width, -1)  # channel by channel, to save memory
    values = [resize(table[flat[..., channel]], *size) for channel in range(flat.shape[-1])]
    return np.stack(values, axis=-1).reshape(*size, *channels)


def resize(texels: np.ndarray, height: int, width: int) -> np.ndarray:
    """The texels (h, w) or (h, w, c) resampled with a box filter, float32."""
    if texels.ndim > 2:
        return np.stack([resize(channel, height, width) for channel in np.moveaxis(texels, -1, 0)], axis=-1)
    channel = Image.fromarray(np.ascontiguousarray(texels, np.float32))
    return np.asarray(channel.resize((width, height), Image.Resampling.BOX))


def lookup(texels: np.ndarray, texcoords: np.ndarray, wrap: Wrap) -> np.ndarray:
    """Bilinear values (n,) or (n, c) of a texture (height, width) or (height, width, c) at texcoords (n, 2).

    Texel centres lie at half-integers / size, as in mitsuba's `bitmap`.
    """
    height, width, *channels = texels.shape
    places = (np.asarray(texcoords, np.float64) * [width, height] - 0.5)[:, ::-1].T
    flat = np.moveaxis(texels.reshape(height, width, -1), -1, 0)
    values = [map_coordinates(channel, places, np.float64, order=1, mode=MODES[wrap]) for channel in flat]
    return np.stack(values, axis=-1).reshape(-1, *channels)
