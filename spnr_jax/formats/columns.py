"""The meaning of a file's columns, for points and meshes alike: known names, ranges, defaults.

`useful` renames the columns in use to

    x y z                           position
    base_color_r ...                base colour, linear; red green blue: sRGB; rgb, rgba: packed sRGB
    roughness metallic              in [0, 1]
    nx ny nz                        normal, of any length
    intensity                       of a laser return, shown as grey if there is no colour
    alpha opacity splat_opacity     opacity; the last of Gaussian splats
    classification withheld         of laser scans

and drops the others.  Colours are sRGB unless their name says linear.  Their range is 255 for 8-bit integers, else the
smallest of 1, 100 (for fractions), 255, 1023, 4095 and 65535 that nearly no value exceeds.
"""

import re
from collections.abc import Callable

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.kernels.cloud_arrays import stack_columns
from spnr_jax.kernels.imaging import srgb_to_linear
from spnr_jax.surfels.gaussians import C0

Columns = dict[str, np.ndarray]
Report = Callable[[str], None]

POSITION, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
LINEAR, SRGB = ("base_color_r", "base_color_g", "base_color_b"), ("red", "green", "blue")
SPLAT = ("f_dc_0", "f_dc_1", "f_dc_2")  # the constant spherical-harmonic coefficients: sRGB = 0.5 + C0 * f_dc
# ignored in names: CloudCompare's prefix, separators, umlauts (\ufffd: of another encoding), British spelling, and
# words such as `vertex`
SILENT = re.compile(
    r"^(scalar_)?grid[\s_]+(?=east|north)|^scalar_|[\s.:_-]+|[äöüß\ufffd]|(?<=colo)u(?=r)"
    r"|^(vert(ex|ices)|points?|cloud)_?(?=colou?r|normal|rgb|xyz)"
)
ENDINGS = ("x y z", "0 1 2", "1 2 3", "r g b", "red green blue")
PLACES = "positions points xyz vertices vertex verts pc pcd pos coord coords coordinates position point pts pts3d"
PLACES += " points3d pointcloud cloud xyzrgb data location pointsmxyz worldpoints p"
PLANES = ("easting northing", "east north", "e n", "x y", "rechtswert hochwert", "ost nord", "este norte")
HEIGHTS = ("z", "height", "elevation", "altitude", "h", "elev", "up", "hhe", "hoehe", "cota")  # hhe: Höhe
COORDINATES = ["xcoord ycoord zcoord", "xcoordinate ycoordinate zcoordinate"]
COLORS = "r g b|rf gf bf|fr fg fb|r8 g8 b8|r16 g16 b16|colr colg colb|vertexr vertexg vertexb"
COLORS += "|vertexred vertexgreen vertexblue|rot grn blau|rot gruen blau|rouge vert bleu|rojo verde azul"
ALIASES = {  # our names -> groups of names in files, without separators; the first complete group is taken
    ours: [[name.replace("_", "") for name in ours]]
    + [[stem + end for end in own.split()] for stem in stems.split() for own in ENDINGS]
    + [names.split() for names in others.split("|") if names]
    for ours, stems, others in (
        (POSITION, PLACES, "|".join([f"{plane} {height}" for plane in PLANES for height in HEIGHTS] + COORDINATES)),
        (LINEAR, "basecolor albedo cd", "linearr linearg linearb|linearred lineargreen linearblue"),  # Houdini: Cd
        (SRGB, "color colors rgb rgbs rgba diffuse", COLORS),
        (NORMAL, "n norm normal normals", ""),
        (("roughness",), "", "rough|roughnessfactor|pbrroughness"),
        (("metallic",), "", "metalness|metallicfactor|metal|pbrmetallic"),
        (("intensity",), "", "reflectance|reflectivity|remission|amplitude|luminance|gray|grey"),
        (("alpha",), "", "a|af|diffusealpha|colora|rgbaa|rgb4|rgba4|color4|colors4|rgb3|rgba3|color3|colors3"),
        (("opacity",), "", "opacities"),
        *(((name,), "", "") for name in ("rgb", "rgba", "classification", "withheld", "splat_opacity")),
    )
}
# if no group is complete: columns whose names differ in one word only, and are not about other things
WORDS = ((POSITION, "x y z"), (SRGB, "r g b"), (SRGB, "red green blue"))
OTHERS = re.compile("normal|spec|ambient|emissi|scale|rot|view|tangent|camera|(words|numbers|lists)[)]$")
NAMES = {name for group in ALIASES.values() for names in group for name in names}
ARRAYS = {name.removesuffix("0") for name in NAMES}
UNSAID = ("f_dc_", "f_rest_", "scale_", "rot_", "_")  # beginnings of the names of splats' columns, and of padding
SHOWN_NAMES, LONGEST_NAME = 12, 40  # in a sentence
DEFAULTS = {"base_color": 0.5, "roughness": 0.5, "metallic": 0.0}
SCALES = (255.0, 1023.0, 4095.0, 65535.0)
ROUNDING = 1e-4  # distance outside [0, 1] that counts as rounding
STRAYS, LEAST = 1000, 100  # one outlier in STRAYS values is allowed, if there are at least LEAST
LARGEST_FLOAT = 100  # of linear colours, roughness or metallic: above it whole numbers are bytes, or of 16 bits
PERCENT = 10  # of roughness or metallic: the largest value from which all are percent
DARK, MOSTLY = 0.03, 0.98  # sRGB that looks black; share of black colours that is reported
BRIGHTEST = 0.99  # quantile of the intensities shown as white; its complement is shown as black
LEAST_GREY = 0.5 / 255
SHORTEST = 1e-30  # length of a normal below which it has no direction
FOG, INVISIBLE = 0.2, 0.02  # opacity below which splats, and other points, are left out
LARGEST_LOGIT = 50  # of splats; above it their opacities are bytes
NOISE_CLASSES = (7, 18)  # low and high noise (ASPRS LAS 1.4 R15, table 17)


def fits_columns(values: np.ndarray) -> bool:
    """Whether values are numbers (points,) or (points, c), c < 5."""
    return values.dtype.kind in "fiub" and values.ndim in (1, 2) and values.shape[1:] < (5,)


def name_columns(fields: dict[str, np.ndarray]) -> Columns:
    """Columns (points,) of fields that fit; those of several columns are named name:0, name:1 ... as in ParaView.

    Of wider fields, and of words, only the name is kept, with a word of what they hold.
    """
    columns: Columns = {}
    for name, values in fields.items():
        width = values.shape[1] if values.ndim == 2 else 1
        own = name.lower()
        if columns.keys() & {own, f"{own}:0"}:  # of names that differ in letters the first is read
            own = f"{name} (again)"
        if fits_columns(values):
            several = {f"{own}:{i}": values[:, i] for i in range(width)} if width > 1 else {}
            columns |= several or {own: values.reshape(-1)}
        else:
            what = f"{values[:1].size} numbers" if values.dtype.kind in "fiub" else "words"
            columns[f"{own} ({what})"] = np.zeros(len(values), bool)
    return columns


def plain_name(name: str) -> str:
    """The name in lower case without its ignored parts."""
    return SILENT.sub("", name.strip().lower())


def _differing(columns: Columns, words: str) -> list[str]:
    """Names of columns that are equal except for one word, which is each of `words`."""
    first = rf"(?<![^\W_]){words.split()[0]}(?![^\W_])"
    for name in columns:
        names = [re.sub(first, word, name) for word in words.split()]
        if re.search(first, name) and set(names) <= columns.keys() and not OTHERS.search(name):
            return names
    return []


def rename(columns: Columns) -> Columns:
    """The columns in use under our names; packed colours need at least four bytes."""
    plain = {plain_name(name): x for name, x in reversed(columns.items())} | columns  # of equal names the first
    found: Columns = {}
    for ours, theirs in ALIASES.items():
        names = next((names for names in theirs if set(names) <= plain.keys()), [])
        found |= dict(zip(ours, (plain[name] for name in names), strict=False))
    for ours, words in WORDS:
        if ours[0] not in found:
            found |= dict(zip(ours, map(columns.__getitem__, _differing(columns, words)), strict=False))
    colored = any(set(names) <= found.keys() for names in (LINEAR, SRGB, ("rgb",)))
    # without colours only `alpha` is one, `a` may mean anything; of color_1 ... color_3 the last is none
    if found.get("alpha") is found.get("blue") if colored else "alpha" not in plain:
        found.pop("alpha", None)
    if set(SPLAT) <= columns.keys():
        for name, constant in zip(SRGB, SPLAT, strict=True):
            found[name] = np.clip(0.5 + C0 * np.asarray(columns[constant], np.float64), 0, 1)
    if "opacity" in found and columns.keys() & {SPLAT[0], "scale_0", "rot_0"}:
        found["splat_opacity"] = found.pop("opacity")
    return {name: x for name, x in found.items() if name not in ("rgb", "rgba") or x.dtype.itemsize >= 4}


def name_places(names: list[str]) -> bool:
    """Whether columns with these names hold positions, or one is x."""
    return "x" in names or set(POSITION) <= rename(dict.fromkeys(names, np.zeros(1))).keys()


def useful(columns: Columns) -> Columns:
    """The columns in use under our names; ValueError if there are no positions."""
    found = rename(columns)
    if not set(POSITION) <= found.keys():
        names = " ".join(columns) or "none"
        raise UserError(f"needs the properties x y z (and may have red green blue, roughness, metallic); found {names}")
    return found


def describe_use(columns: Columns) -> list[str]:
    """Lines about columns that are not used (not those of splats and padding), and about names that were guessed."""
    used = {id(x): ours for ours, x in rename(columns).items()}
    left = [name for name, x in columns.items() if id(x) not in used and not name.startswith(UNSAID)]
    new = [name for name, x in columns.items() if id(x) in used and plain_name(name) not in NAMES]
    guessed = [f"{name} as {used[id(columns[name])]}" for name in new]
    lines = {"columns that are not used": left, "columns taken by a word of their names": guessed}
    return [f"{line}: {list_names(names)}" for line, names in lines.items() if names]


def list_names(names: list[str]) -> str:
    """The first names, shortened, and the number of the others, for a message."""
    more = f" and {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
    return ", ".join(name[:LONGEST_NAME] for name in names[:SHOWN_NAMES]) + more


def sound(columns: Columns) -> np.ndarray:
    """Mask (points,) of the rows whose position, colour, opacity and materials are finite in float32."""
    # 0.999: text may round the largest number up
    mask, largest = np.ones(len(columns["x"]), bool), 0.999 * np.finfo(np.float32).max
    for name in columns.keys() - {*NORMAL, "intensity", "rgb", "rgba", "classification", "withheld"}:
        values = np.asarray(columns[name], np.float64)
        # splats of opacity 0 or 1 have an infinite logit
        mask &= ~np.isnan(values) if name == "splat_opacity" else np.abs(values) < largest
    return mask


def keep_visible(columns: Columns, keep_noise: bool, report: Report) -> Columns:
    """The rows without transparent points, fog of splats, and noise and withheld points of scanners.

    With `keep_noise` all rows.  `report` gets a line about each kind that is left out.
    """
    wanted = np.ones(len(columns["x"]), bool)
    left_out = {
        "opacity near 0": invisible(columns),
        "noise in their classification (7, 18)": np.isin(columns.get("classification", ~wanted), NOISE_CLASSES),
        "withheld by the scanner's software": columns.get("withheld", ~wanted) != 0,
    }
    for reason, mask in left_out.items():
        if keep_noise or not mask.any():
            continue
        if mask.all():
            report(f"all points kept, though it holds for each: {reason}")
        else:
            report(f"{int(mask.sum()):,} of {len(mask):,} points left out: {reason} (--keep-noise keeps them)")
            wanted &= ~mask
    return columns if wanted.all() else {name: column[wanted] for name, column in columns.items()}


def invisible(columns: Columns) -> np.ndarray:
    """Mask (points,) of nearly transparent points; none if the file has no opacity, or only zeros."""
    if "alpha" not in columns and "rgba" in columns:
        columns["alpha"] = _unpack(columns["rgba"])[:, 3]
    name = next((name for name in ("splat_opacity", "alpha", "opacity") if name in columns), "")
    values, of_splats = columns.get(name, np.zeros(len(columns["x"]))), name == "splat_opacity"
    low, high = (float(end(initial=0)) for end in (values.min, values.max))
    # logits, as Kerbl et al. write them, unless all are 0 to 1, or bytes; an opacity of 1 has an infinite one
    if name != "alpha" and (low < 0 or (of_splats and high > 1 and (high <= LARGEST_LOGIT or (values % 1 != 0).any()))):
        return values < np.log(FOG / (1 - FOG))
    # packed colours have an alpha of 0 if none was written
    white = full_scale(values.dtype, max(1.0, high), high < 2) if high > 0 else -np.inf
    return values < white * (FOG if of_splats else INVISIBLE)


def materials(columns: Columns, report: Report) -> dict[str, np.ndarray]:
    """base_color (points, 3) linear, roughness and metallic (points,); `report` gets a line for each assumption.

    If the file has neither roughness nor metallic, also `materials_known` (points,), all 0.
    """
    count, found = len(columns["x"]), {"base_color": base_color(columns, report)}
    found |= {name: _unit_interval(columns[name], name, report) for name in [*DEFAULTS][1:] if name in columns}
    complete = {} if len(found) > 1 else {"materials_known": np.zeros(count)}
    for name, default in DEFAULTS.items():
        if (values := found.get(name)) is None:
            report(f"no {name} in the file: {default:g} taken for all points")
            values = np.full((count, 3) if name == "base_color" else count, default)
        complete[name] = values
    return complete


def normals(columns: Columns) -> np.ndarray | None:
    """Unit normals (points, 3), 0 in rows without a valid one; None if no row has one."""
    if not set(NORMAL) <= columns.keys() or any(columns[name].dtype.kind == "u" for name in NORMAL):
        return None  # unsigned numbers: an encoding that is not known
    vectors = stack_columns(columns, NORMAL)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    usable = np.isfinite(length) & (length > SHORTEST)
    return np.where(usable, vectors / np.where(usable, length, 1), 0) if usable.any() else None


def base_color(columns: Columns, report: Report) -> np.ndarray | None:
    """Linear base colours (points, 3), from colours or intensities; None if there are none."""
    intensity = np.asarray(columns.get("intensity", [np.nan]), np.float64)
    colors, lines = colors_of(columns) or (None, [])
    # LAS records have colour fields even if the scanner saw none
    if colors is not None and (colors.any() or "intensity" not in columns):
        for line in lines:
            report(line)
        return colors
    known = np.isfinite(intensity)
    if not known.any():
        return None
    dark, bright = np.quantile(intensity[known], (1 - BRIGHTEST, BRIGHTEST))
    if not 0 < bright - dark < np.inf:
        return None
    unknown = f", {int((~known).sum()):,} without one as 0.5" if not known.all() else ""
    report(f"no colour in the file: intensity {dark:g}..{bright:g} shown as grey{unknown}")
    # never 0, which means no colour
    grey = np.where(known, np.clip((intensity - dark) / (bright - dark), LEAST_GREY, 1), 0.5)
    return srgb_to_linear(np.repeat(grey[:, None], 3, axis=-1))


def _unit_interval(values: np.ndarray, name: str, report: Report) -> np.ndarray:
    """Roughness or metallic in [0, 1], or of percent or whole bytes; ValueError if they lie outside."""
    highest = float(values.max(initial=0))
    percent = values.dtype.kind != "u" and PERCENT < highest <= 100 and not ((values > 0) & (values < 1)).any()
    whole = LARGEST_FLOAT < highest <= 255 and not (values % 1).any()
    scale = 100.0 if percent else full_scale(values.dtype, highest, linear=not whole)
    if scale > 1:
        report(f"{name} taken to be in 0..{scale:g}")
    scaled = values / scale
    if not (scaled.min() >= -ROUNDING and scaled.max() <= 1 + ROUNDING):
        raise UserError(f"has {name} from {scaled.min():g} to {scaled.max():g}; expected 0 to 1")
    return np.clip(scaled, 0, 1)


# --- colours ----------------------------------------------------------------------------------------------------------


def colors_of(columns: Columns) -> tuple[np.ndarray, list[str]] | None:
    """Linear colours (n, 3) of renamed columns, and lines about how they were read; None without columns of colours.

    ValueError for values that cannot be colours.
    """
    for names in (LINEAR, SRGB):
        if set(names) <= columns.keys():
            channels = np.stack([columns[name] for name in names], axis=-1)
            return linear_colors(channels, " ".join(names), linear=names == LINEAR)
    packed = next((name for name in ("rgb", "rgba") if name in columns), None)
    if packed is None:
        return None
    colors, lines = linear_colors(_unpack(columns[packed])[:, :3], packed)
    # NaN of 32 bits is a colour
    lost = np.count_nonzero(np.isnan(columns[packed])) if columns[packed].dtype == np.float64 else 0
    lines += [f"{lost:,} of {len(colors):,} colours are no number or #rrggbb, and taken as black"] if lost else []
    return colors, lines


def _unpack(packed: np.ndarray) -> np.ndarray:
    """Red, green, blue and alpha (n, 4) uint8 of numbers (n,) 0xAARRGGBB, or of floats with these bits (PCL)."""
    if packed.dtype == np.float64:  # holds all 32-bit integers, signed or not
        packed = np.nan_to_num(packed)
    whole = bool(((packed % 1 == 0) & (np.abs(packed) < 2**32)).all())  # floats made of a colour's bits are tiny or NaN
    if packed.dtype.kind != "f" or whole:
        bits = packed.astype(np.int64).astype(np.uint32)
    else:
        bits = packed.astype(np.float32).view(np.uint32)
    return np.stack([(bits >> shift & 255).astype(np.uint8) for shift in (16, 8, 0, 24)], axis=-1)


def linear_colors(channels: np.ndarray, name: str, *, linear: bool = False) -> tuple[np.ndarray, list[str]]:
    """Linear colours (n, 3) in [0, 1] from a file's numbers (n, 3), and lines about how they were read."""
    if not len(channels):
        return np.zeros(channels.shape), []
    strays = max(1, len(channels) // STRAYS) if len(channels) >= LEAST else 0
    highest = np.partition(channels.max(axis=-1), -1 - strays)[-1 - strays]
    whole = linear and highest > LARGEST_FLOAT and not (channels % 1).any()
    percent = not linear and channels.dtype.kind == "f" and 2 < highest <= 100 and (channels[:LEAST] % 1).any()
    white = 100.0 if percent else full_scale(channels.dtype, float(highest), linear and not whole)
    low, high = np.partition(channels.min(axis=-1), strays)[strays] / white, highest / white
    if not (low >= -ROUNDING and high <= 1 + max(ROUNDING, 1.5 / 255 if white == 255 else 0)):
        others = "; sRGB colours are named red green blue" if linear else " or 0 to 255"
        raise UserError(f"has {name} from {low:g} to {high:g}; expected 0 to 1{others}")
    values = channels / white
    curve = "linear" if linear else "sRGB"
    lines = [f"{name} taken as {curve} in 0..{white:g}"] if not linear or white > 1 else []
    if outside := int(np.count_nonzero((values > 1 + ROUNDING).any(axis=-1) | (values < -ROUNDING).any(axis=-1))):
        lines.append(f"{outside:,} of {len(values):,} colours lie outside of 0..{white:g} and are cut off there")
    values = np.clip(values, 0, 1)
    if not linear and len(values) >= LEAST and (share := np.mean(values.max(axis=-1) < DARK)) > MOSTLY:
        lines.append(f"{share:.0%} of {name} are nearly black: the picture will be black")
    return values if linear else srgb_to_linear(values), lines


def full_scale(kind: np.dtype, highest: float, linear: bool = False) -> float:
    """The value that means 1, for colours of this type whose highest value is `highest`."""
    if kind == np.uint8:
        return 255.0
    whole = kind.kind == "u" and kind.itemsize == 2
    if not whole and (linear or highest <= 1 + ROUNDING):
        return 1.0
    if kind.kind == "f" and highest < 2:
        raise UserError(f"has colours up to {highest:g}: neither 0 to 1 nor 0 to 255")
    # + 1: some writers multiply by 256
    return next((scale for scale in SCALES if highest <= scale + 1), SCALES[-1])
