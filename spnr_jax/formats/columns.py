"""What the columns of a file mean: names in common use, and defaults for what is missing.

`useful` renames the columns that matter to

    x y z                           position
    base_color_r ...                base colour, linear; red green blue: sRGB; rgb, rgba: packed (mesh/file_colors.py)
    roughness metallic              in [0, 1]
    nx ny nz                        normal, of any length
    intensity                       of a laser's echo, shown as grey where there is no colour
    alpha opacity splat_opacity     how much a point hides; the last of Gaussian splats
    classification withheld         of laser scans

and drops the others.
"""

from collections.abc import Callable

import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.mesh import file_colors as colors
from spnr_jax.formats.mesh.texels import srgb_to_linear
from spnr_jax.surfels.gaussians import C0

Columns = dict[str, np.ndarray]
Report = Callable[[str], None]

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
SPLAT = ("f_dc_0", "f_dc_1", "f_dc_2")  # the constant spherical-harmonic coefficients: sRGB = 0.5 + C0 * f_dc
PREFIX = "scalar_"  # CloudCompare's, for everything but positions and colours
ALIASES = (  # groups that stand for each other: the first that is there counts
    (
        POSITION,
        (
            POSITION,
            ("points:0", "points:1", "points:2"),
            ("points_0", "points_1", "points_2"),
            ("pos_x", "pos_y", "pos_z"),
            ("easting", "northing", "elevation"),
            ("easting", "northing", "height"),
        ),
    ),
    (colors.LINEAR, colors.LINEAR_NAMES),
    (colors.SRGB, colors.SRGB_NAMES),
    (("rgb",), (("rgb",),)),
    (("rgba",), (("rgba",),)),
    (NORMAL, (NORMAL, ("normal_x", "normal_y", "normal_z"), ("normalx", "normaly", "normalz"))),
    (("roughness",), (("roughness",), ("rough",), ("roughness_factor",), ("pbr_roughness",))),
    (("metallic",), (("metallic",), ("metalness",), ("metallic_factor",), ("metal",), ("pbr_metallic",))),
    (("intensity",), (("intensity",), ("reflectance",))),
    (("alpha",), (("alpha",), ("a",), ("diffuse_alpha",), ("color_a",))),
    *(((name,), ((name,),)) for name in ("opacity", "splat_opacity", "classification", "withheld")),
)
DEFAULTS = {"base_color": 0.5, "roughness": 0.5, "metallic": 0.0}
BRIGHTEST = 0.99  # quantile of the intensities that is shown white
SHORTEST = 1e-30  # normal that still has a direction
FOG, INVISIBLE = 0.2, 0.02  # least opacity of splats, below which they are fog, and of other points
NOISE_CLASSES = (7, 18)  # low and high noise (ASPRS LAS 1.4 R15, table 17)


def useful(columns: Columns) -> Columns:
    """The columns that matter, under their one name; ValueError if there are no positions."""
    plain = {name.strip().removeprefix(PREFIX): values for name, values in columns.items()} | columns
    found: Columns = {}
    for names, groups in ALIASES:
        group = colors.find(plain, groups)
        found |= {name: plain[alias] for name, alias in zip(names, group, strict=bool(group))}
    if not set(POSITION) <= found.keys():
        raise UserError(
            "needs the properties x y z (and may have red green blue, roughness, metallic); "
            f"found {' '.join(columns) or 'none'}"
        )
    if set(SPLAT) <= plain.keys():
        sharp = {
            name: 0.5 + C0 * np.asarray(plain[dc], np.float64) for name, dc in zip(colors.SRGB, SPLAT, strict=True)
        }
        found |= {name: np.clip(values, 0, 1) for name, values in sharp.items()}
        if "opacity" in found:
            found["splat_opacity"] = found.pop("opacity")
    return found


def sound(columns: Columns) -> np.ndarray:
    """Mask (points,) of rows whose position, colour, opacity and materials are numbers that float32 holds."""
    names = (*POSITION, *colors.LINEAR, *colors.SRGB, "roughness", "metallic", "alpha", "opacity", "splat_opacity")
    largest = np.finfo(np.float32).max
    mask = np.ones(len(columns["x"]), bool)
    for name in names:
        if name in columns:
            mask &= np.abs(np.asarray(columns[name], np.float64)) < largest
    return mask


def keep_visible(columns: Columns, keep_noise: bool, report: Report) -> Columns:
    """The rows that are to be seen: without noise and withheld points of scanners, fog, and what is transparent.

    With `keep_noise` all of them; a line about each kind that is left out.
    """
    left_out = {
        "opacity near 0": _invisible(columns, report),
        "noise in their classification (7, 18)": np.isin(columns["classification"], NOISE_CLASSES)
        if "classification" in columns
        else None,
        "withheld by the scanner's software": columns["withheld"] != 0 if "withheld" in columns else None,
    }
    wanted = np.ones(len(columns["x"]), bool)
    for reason, mask in left_out.items():
        if mask is None or keep_noise or not mask.any():
            continue
        if mask.all():
            report(f"all points are {reason}: kept")
            continue
        report(f"{int(mask.sum()):,} of {len(mask):,} points left out: {reason} (--keep-noise keeps them)")
        wanted &= ~mask
    return columns if wanted.all() else {name: column[wanted] for name, column in columns.items()}


def _invisible(columns: Columns, report: Report) -> np.ndarray | None:
    """True for points that hide next to nothing; None where the file does not say so, or says it of all."""
    if "splat_opacity" in columns:
        values = np.asarray(columns["splat_opacity"], np.float64)
        if values.min(initial=0) >= 0 and values.max(initial=0) <= 1:
            return values < FOG
        return values < np.log(FOG / (1 - FOG))  # as Kerbl et al. write it, before the logistic function
    if "alpha" not in columns and "rgba" in columns:
        columns["alpha"] = colors.unpack(columns["rgba"])[:, 3]
    name = next((name for name in ("alpha", "opacity") if name in columns), None)
    if name is None or not len(columns[name]):
        return None
    highest = float(columns[name].max())
    if not highest > 0:  # as packed colours have it where nobody wrote one
        return None
    return columns[name] < INVISIBLE * colors.full_scale(columns[name].dtype, max(1.0, highest), highest < 2)


def materials(columns: Columns, report: Report) -> dict[str, np.ndarray]:
    """base_color (points, 3) linear, roughness and metallic (points,); `report` gets a line for each assumption.

    `materials_known` (points,) is 0 where the file has neither of the latter.
    """
    count, complete = len(columns["x"]), {}
    for name, default in DEFAULTS.items():
        if name == "base_color":
            values = _base_color(columns, report)
        else:
            values = _unit_interval(columns[name], name) if name in columns else None
        if values is None:
            report(f"no {name} in the file: {default:g} taken for all points")
            values = np.full((count, 3) if name == "base_color" else count, default)
        complete[name] = values
    if not {"roughness", "metallic"} & columns.keys():
        complete["materials_known"] = np.zeros(count)
    return complete


def normals(columns: Columns) -> np.ndarray | None:
    """Normals (points, 3) of unit length, 0 where a row has none that can be used; None if no row has one."""
    if not set(NORMAL) <= columns.keys() or any(columns[name].dtype.kind == "u" for name in NORMAL):
        return None  # numbers without a sign encode a normal in some way of their own
    vectors = np.stack([np.asarray(columns[name], np.float64) for name in NORMAL], axis=-1)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    usable = np.isfinite(length) & (length > SHORTEST)
    return np.where(usable, vectors / np.where(usable, length, 1), 0) if usable.any() else None


def _base_color(columns: Columns, report: Report) -> np.ndarray | None:
    """Linear base colours (points, 3) from the columns that hold some, None if there are none."""
    group = colors.find(columns, (colors.LINEAR, colors.SRGB))
    # a lidar's record has colours whether or not it saw them
    unseen = group == colors.SRGB and "intensity" in columns and not any(columns[name].any() for name in group)
    if not unseen and (found := colors.colors_of(columns)) is not None:
        for line in found[1]:
            report(line)
        return found[0]
    if "intensity" not in columns:
        return None
    intensity = np.asarray(columns["intensity"], np.float64)
    if not np.isfinite(intensity).all():
        return None
    dark, bright = intensity.min(), np.quantile(intensity, BRIGHTEST)
    if not (bright > dark and np.isfinite(bright - dark)):
        return None
    report(f"no colour in the file: intensity {dark:g}..{bright:g} shown as grey")
    return srgb_to_linear(np.repeat(np.clip((intensity - dark) / (bright - dark), 0, 1)[:, None], 3, axis=-1))


def _unit_interval(values: np.ndarray, name: str) -> np.ndarray:
    """Roughness or metallic in [0, 1], rounding errors removed; ValueError if they are not."""
    scaled = values / colors.full_scale(values.dtype, float(values.max(initial=0)), linear=True)
    low, high = scaled.min(), scaled.max()
    if not (low >= -colors.ROUNDING and high <= 1 + colors.ROUNDING):
        raise UserError(f"has {name} from {low:g} to {high:g}; expected 0 to 1")
    return np.clip(scaled, 0, 1)
