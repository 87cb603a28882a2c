"""What the columns of a point file mean: names in common use, colour ranges, and defaults for what is missing.

`useful` renames the columns that matter to

    x y z                                             position
    base_color_r base_color_g base_color_b            base colour, linear
    red green blue                                    colour, sRGB
    roughness metallic                                in [0, 1]
    nx ny nz                                          normal, of any length
    intensity                                         of a laser's echo, shown as grey where there is no colour

and drops the others.  Colours, roughness and metallic are 0..1, or 0..255 (0..65535): unsigned integers by their type,
other numbers by their size.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from spnr_jax.errors import UserError
from spnr_jax.formats.splat_points import NAMES as SPLAT_NAMES
from spnr_jax.formats.splat_points import points_of_splats
from spnr_jax.kernels.colors import srgb_to_linear

Columns = dict[str, np.ndarray]
Report = Callable[[str], None]

POSITION = ("x", "y", "z")
LINEAR = ("base_color_r", "base_color_g", "base_color_b")
SRGB = ("red", "green", "blue")
NORMAL = ("nx", "ny", "nz")
PREFIX = "scalar_"  # CloudCompare's, for everything but positions and colours
ALIASES = (  # groups that stand for each other: the first that is there counts
    (POSITION, (POSITION, ("points:0", "points:1", "points:2"), ("points_0", "points_1", "points_2"))),
    (
        LINEAR,
        (
            LINEAR,
            ("base_color_red", "base_color_green", "base_color_blue"),
            ("basecolor_r", "basecolor_g", "basecolor_b"),
            ("albedo_r", "albedo_g", "albedo_b"),
        ),
    ),
    (
        SRGB,
        (
            SRGB,
            ("r", "g", "b"),
            ("diffuse_red", "diffuse_green", "diffuse_blue"),
            ("diffuse_r", "diffuse_g", "diffuse_b"),
            ("rf", "gf", "bf"),
            ("color_r", "color_g", "color_b"),
            ("color_red", "color_green", "color_blue"),
        ),
    ),
    (NORMAL, (NORMAL, ("normal_x", "normal_y", "normal_z"))),
    (("roughness",), (("roughness",), ("rough",), ("roughness_factor",), ("pbr_roughness",))),
    (("metallic",), (("metallic",), ("metalness",), ("metallic_factor",), ("metal",), ("pbr_metallic",))),
    (("intensity",), (("intensity",), ("reflectance",))),
)
DEFAULTS = {"base_color": 0.5, "roughness": 0.5, "metallic": 0.0}
ROUNDING = 1e-4  # values this far outside [0, 1] are taken for rounded ones
BRIGHTEST = 0.99  # quantile of the intensities that is shown white
SHORTEST = 1e-30  # normal that still has a direction


def useful(columns: Columns) -> Columns:
    """The columns that matter, under their one name; ValueError if there are no positions."""
    plain = {name.strip().removeprefix(PREFIX): values for name, values in columns.items()} | columns
    found = {name: plain[name] for name in SPLAT_NAMES if name in plain}
    for names, groups in ALIASES:
        group = next((group for group in groups if set(group) <= plain.keys()), ())
        found |= {name: plain[alias] for name, alias in zip(names, group, strict=bool(group))}
    if not set(POSITION) <= found.keys():
        raise UserError(
            "needs the properties x y z (and may have red green blue, roughness, metallic); "
            f"found {' '.join(columns) or 'none'}"
        )
    if set(SPLAT_NAMES[:3]) <= found.keys():
        found = points_of_splats(found)
    return found


def materials(columns: Columns, report: Report) -> dict[str, np.ndarray]:
    """base_color (points, 3) linear, roughness and metallic (points,); `report` gets a line for each assumption.

    `materials_known` (points,) is 0 where the file has neither of the latter.
    """
    count, complete = len(columns["x"]), {}
    for name, default in DEFAULTS.items():
        if name == "base_color":
            values = _base_color(columns, report)
        else:
            values = _unit_interval(columns[name] / _full(columns[name]), name) if name in columns else None
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
    for names in (LINEAR, SRGB):
        if not set(names) <= columns.keys():
            continue
        channels = np.stack([columns[name] for name in names], axis=-1)
        if not channels.any() and "intensity" in columns:  # a lidar's record has colours whether or not it saw them
            continue
        white = _full(channels, linear=names == LINEAR)
        colors = _unit_interval(channels / white, " ".join(names))
        if names == LINEAR:
            return colors
        report(f"{' '.join(names)} taken as sRGB in 0..{white:g}")
        return _linear(colors)
    if "intensity" not in columns:
        return None
    intensity = np.asarray(columns["intensity"], np.float64)
    if not np.isfinite(intensity).all():
        return None
    dark, bright = intensity.min(), np.quantile(intensity, BRIGHTEST)
    if not (bright > dark and np.isfinite(bright - dark)):
        return None
    report(f"no colour in the file: intensity {dark:g}..{bright:g} shown as grey")
    return _linear(np.repeat(np.clip((intensity - dark) / (bright - dark), 0, 1)[:, None], 3, axis=-1))


def _linear(colors: np.ndarray) -> np.ndarray:
    whole = jax.jit(srgb_to_linear)  # its operations alone would be compiled one by one
    return np.asarray(whole(jnp.asarray(colors, jnp.float32)))


def _full(values: np.ndarray, linear: bool = True) -> float:
    """The value that means full: by its type for integers of 8 or 16 bits, else 1, or 255 for sRGB that exceeds 1."""
    if values.dtype.kind == "u" and values.dtype.itemsize <= 2:
        # many writers put 8-bit colours into 16-bit fields
        return 255.0 if values.max(initial=0) <= 255 else 65535.0
    highest = values.max(initial=0)
    if linear or highest <= 1 + ROUNDING:
        return 1.0
    if highest < 2:
        raise UserError(f"has colours up to {highest:g}: neither 0 to 1 nor 0 to 255")
    return 255.0


def _unit_interval(values: np.ndarray, name: str) -> np.ndarray:
    """The values, rounding errors removed; ValueError if they are not in [0, 1]."""
    low, high = values.min(), values.max()
    if not (low >= -ROUNDING and high <= 1 + ROUNDING):
        raise UserError(f"has {name} from {low:g} to {high:g}; expected 0 to 1 (colours: or 0 to 255)")
    return np.clip(values, 0, 1)
