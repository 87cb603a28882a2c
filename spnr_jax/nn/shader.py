"""CNN that shades a G-buffer: for each pixel, opacity, a change of the base colour, and factors of the light.

Its inputs are relative: vectors in the camera's axes, lengths in spacings or pixels.  So a picture does not depend on a
common rotation of object, camera and light, nor on the unit of the cloud.

A U-Net runs on the attributes of the front-most surfels, at the resolution at which points lie 0.8 to 3.5 pixels
apart, so its input looks alike for any number of points.  One block then doubles the resolution, as often as the
picture needs.  Its outputs are factors of light maps (`compose_picture`).  The light is not an input, so a picture is
linear in it up to the sRGB curve.
"""

import dataclasses
from functools import partial, reduce
from operator import add
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spnr_jax.kernels.cameras import compute_ray_slopes
from spnr_jax.kernels.imaging import average_pool, depth_to_space, double_size, linear_to_srgb, remove_checkerboard
from spnr_jax.kernels.numerics import (
    clamp,
    dot,
    larger,
    normalize,
    one_minus_exp,
    safe_sqrt,
    smaller,
    split_columns,
    with_gradient,
)
from spnr_jax.kernels.records import Camera, GBuffer, Light, Surfels
from spnr_jax.nn.convolution import Conv
from spnr_jax.surfels import lighting
from spnr_jax.surfels.lighting import SPECULAR
from spnr_jax.surfels.sides import DIRECTIONS

# --- channels ---------------------------------------------------------------------------------------------------------


ATTRIBUTES = {  # of a surfel, blended over pixels: name -> number of channels; those of the light are linear in it
    **{"roughness": 1, "metallic": 1, "irradiance": 3, "reflected": 1, "openness": 1, "bent_normal": 3},
    **{"base_color": 3, "shape_ratios": 2, "one_sided": 1, "materials_unknown": 1, "learned": 1, "squared_grey": 1},
}
INPUTS = {  # of the network; they do not depend on the light
    **{"opacity": 1, "log_coverage": 1, "roughness": 1, "metallic": 1, "openness": 1, "reflected": 1},
    **{"depth_deviation": 1, "relief": 2, "log_pixels": 1, "shape_ratios": 2, "one_sided": 1, "cosine": 1},
    **{"normal": 3, "bent_normal": 3, "color": 3, "blended_color": 3, "drawn": 1, "sharp_weight": 1},
    **{"centre_offset": 2, "materials_unknown": 1, "learned": 1, "contrast": 1},
}
BLENDED = (  # the ATTRIBUTES that are INPUTS as they are
    *("roughness", "metallic", "openness", "reflected", "shape_ratios", "one_sided", "bent_normal"),
    *("materials_unknown", "learned"),
)
MAPS = {  # material and light maps that the outputs are factors of
    **{"color": 3, "metallic": 1, "opacity": 1, "factor": 1, "summand": 1},
    **{"irradiance": 3, "unshadowed": 3, "mirrored": 3, "reflected": 1},
}
OUTPUTS = {  # of the network; `compose_picture` has the formulas
    **{"color_step": 3, "logit_step": 1, "shade": 1, "open_sky": 1, "shine": 1, "glow": 1},
    **{"bounced_constant": 3, "bounced_bands": 8, "metallic_step": 1, "rougher": 1},
}
NUM_FEATURES, NUM_OUTPUTS = sum(INPUTS.values()), sum(OUTPUTS.values())
FIRST = dict(zip(INPUTS, np.cumsum([0, *INPUTS.values()]).tolist(), strict=False))  # index of each input
# indices of the inputs that change their sign when the picture is mirrored along x, or along y
ODD = tuple(tuple(FIRST[name] + axis for name in ("normal", "bent_normal", "centre_offset")) for axis in (0, 1))


def stack_channels(values: dict[str, Array], channels: dict[str, int]) -> Float[Array, "*batch channels"]:
    """The named values in the order of a table; those of one channel have no axis of channels."""
    assert values.keys() == channels.keys()
    return jnp.concatenate([values[x][..., None] if n == 1 else values[x] for x, n in channels.items()], axis=-1)


def split_channels(
    stacked: Float[Array, "*batch channels"], channels: dict[str, int], *, keep_axis: bool = False
) -> dict[str, Array]:
    """The inverse of `stack_channels`; with `keep_axis`, single channels keep their axis."""
    parts = zip(channels.items(), jnp.split(stacked, np.cumsum([*channels.values()])[:-1], axis=-1), strict=True)
    return {name: part[..., 0] if count == 1 and not keep_axis else part for (name, count), part in parts}


# --- inputs -----------------------------------------------------------------------------------------------------------


FAINT = 0.02  # opacity at which a pixel's features have half their value
WINDOWS = 2, 6  # pixels to each side over which the depth is compared
EDGE = 0.6  # coverage at the outline: discs reach beyond the surface, half of their weight
LEAST = 0.01  # opacity above which a pixel has a relief
HAZE = 0.05  # share of the opacity kept where discs hardly cover a pixel: the network may raise it
LEAST_SHARP = 1e-6  # summed narrow weights at which the sharp colour has half the confidence
SHARPEST = 0.25  # largest difference between the sharp colour and the blended one


def face_camera(surfels: Surfels, camera: Camera) -> Surfels:
    """The surfels with all normals turned to the camera."""
    to_eye = camera.cam_to_world[:, 3][None] - surfels.position
    behind = jnp.sum(to_eye * surfels.normal, axis=1, keepdims=True) < 0
    return dataclasses.replace(surfels, normal=jnp.where(behind, -surfels.normal, surfels.normal))


def compute_attributes(surfels: Surfels, light: Light, camera: Camera) -> Float[Array, "points 19"]:
    """ATTRIBUTES of each surfel.

    With the visibilities v_d of the DIRECTIONS d and the normal n: openness sum_d v_d max(n.d, 0) / sum_d max(n.d, 0);
    bent normal 4 mean_d(v_d d), in camera axes; reflected, the mean of v_d over a lobe around the mirrored ray.
    """
    rotation, eye = camera.cam_to_world[:, :3], camera.cam_to_world[:, 3]
    cosines = larger(jnp.einsum("pi,di->pd", surfels.normal, DIRECTIONS, precision="highest"), 0)
    bent = 4 / len(DIRECTIONS) * jnp.einsum("pd,di->pi", surfels.visibility, DIRECTIONS, precision="highest")
    to_eye = normalize(jnp.asarray(eye[None] - surfels.position))
    cosine = jnp.sum(to_eye * surfels.normal, axis=1, keepdims=True)
    mirrored = 2 * cosine * surfels.normal - to_eye
    lobe = jnp.exp(lighting.LOBE * (jnp.einsum("pi,di->pd", mirrored, DIRECTIONS, precision="highest") - 1))
    own = ("roughness", "metallic", "base_color", "shape_ratios", "one_sided", "materials_unknown", "learned")
    values = {name: jnp.asarray(getattr(surfels, name)) for name in own} | {
        "irradiance": lighting.gather_irradiance(surfels, light),
        "reflected": jnp.sum(surfels.visibility * lobe, axis=1) / jnp.sum(lobe, axis=1),
        "openness": jnp.sum(surfels.visibility * cosines, axis=1) / larger(jnp.sum(cosines, axis=1), 1e-6),
        "bent_normal": jnp.einsum("pi,ij->pj", bent, rotation, precision="highest"),
        "squared_grey": jnp.mean(jnp.asarray(surfels.base_color), axis=1) ** 2,
    }
    return stack_channels(values, ATTRIBUTES)


class ShaderInputs(NamedTuple):
    """The network's INPUTS, the MAPS for `compose_picture`, and the light's spherical harmonics in camera axes."""

    inputs: Float[Array, "height width 33"]
    maps: Float[Array, "height width 17"]
    light_harmonics: Float[Array, "9 3"]


def compute_inputs(buffer: GBuffer, light: Light, camera: Camera) -> ShaderInputs:
    """What the network and `compose_picture` need of a G-buffer and a light."""
    of = split_channels(buffer.attributes, ATTRIBUTES)
    blended = of["base_color"]
    confidence = (buffer.sharp_weight / (buffer.sharp_weight + LEAST_SHARP))[..., None]  # 0 far from all discs
    color = clamp(blended + confidence * clamp(buffer.color - blended, -SHARPEST, SHARPEST), 0, 1)
    normal, ray = _directions(buffer, camera)
    cosine = -dot(normal, ray)
    mirrored = [v + 2 * cosine * n for n, v in zip(normal, ray, strict=True)]
    normal_in_world, mirrored_in_world = (
        [dot(row, direction) for row in camera.cam_to_world[:, :3]] for direction in (normal, mirrored)
    )
    factor, summand = lighting.reflectance(of["roughness"], clamp(cosine, 0.05, 1))
    spacing = jnp.exp(buffer.log_spacing)
    in_pixels = larger(spacing, 1e-6) * camera.intrinsics[0, 0] / larger(buffer.depth, 0.1)
    drawn = buffer.opacity / (buffer.opacity + FAINT)
    inputs = {
        "opacity": buffer.opacity,
        "log_coverage": jnp.log1p(buffer.coverage),
        **{name: of[name] for name in BLENDED},
        "depth_deviation": smaller(buffer.depth_deviation / spacing, 4),
        "relief": jnp.stack([_relief(buffer, spacing, reach) for reach in WINDOWS], axis=-1),
        "log_pixels": 0.5 * jnp.log(in_pixels),
        "cosine": cosine,
        "normal": buffer.normal,
        "color": linear_to_srgb(color),
        "blended_color": linear_to_srgb(blended),
        "drawn": jnp.ones_like(drawn),  # all are multiplied by it below
        "sharp_weight": jnp.log1p(8 * buffer.sharp_weight),
        "centre_offset": clamp(buffer.centre_offset / in_pixels[..., None], -2, 2),
        # standard deviation of the grey values of the blended colours
        "contrast": safe_sqrt(of["squared_grey"] - jnp.mean(blended, axis=-1) ** 2),
    }
    maps = {
        "color": color,
        "metallic": of["metallic"],
        "opacity": buffer.opacity * larger(one_minus_exp((buffer.coverage / EDGE) ** 2), HAZE),
        "factor": factor,
        "summand": summand,
        "irradiance": of["irradiance"],
        "unshadowed": jnp.stack(lighting.irradiance(light, normal_in_world), axis=-1),
        "mirrored": jnp.stack(lighting.reflect(light, mirrored_in_world, of["roughness"]), axis=-1),
        "reflected": of["reflected"],
    }
    return ShaderInputs(
        inputs=drawn[..., None] * stack_channels(inputs, INPUTS),
        maps=stack_channels(maps, MAPS),
        light_harmonics=lighting.project_harmonics(light, jnp.asarray(camera.cam_to_world)[:, :3]),
    )


def _directions(buffer: GBuffer, camera: Camera) -> tuple[list[Array], list[Array]]:
    """Unit normals and rays' directions, camera axes, as columns; the camera's axis where there is no normal."""
    size = safe_sqrt(jnp.sum(buffer.normal**2, axis=-1))
    known = size > 1e-3
    normal = [n / larger(size, 1e-4) for n in split_columns(buffer.normal)]
    normal = [jnp.where(known, n, c) for n, c in zip(normal, (0.0, 0.0, 1.0), strict=True)]
    across, down = (jnp.arange(n, dtype=size.dtype) + 0.5 for n in (camera.width, camera.height))
    right, up = jnp.broadcast_arrays(*compute_ray_slopes(camera.intrinsics, across[None], down[:, None]))
    length = jnp.sqrt(right**2 + up**2 + 1)
    return normal, [right / length, up / length, -1 / length]


def _relief(buffer: GBuffer, spacing: Float[Array, "height width"], reach: int) -> Float[Array, "height width"]:
    """Depth of each pixel behind the mean around it, in spacings, mapped to (-1, 1)."""
    mean = _box(buffer.opacity * buffer.depth, reach) / larger(_box(buffer.opacity, reach), 1e-3)
    return jnp.where(buffer.opacity > LEAST, jnp.tanh((buffer.depth - mean) / (4 * spacing)), 0)


def _plain_box(values: Float[Array, "height width"], reach: int) -> Float[Array, "height width"]:
    height, width = values.shape
    padded = jnp.pad(values, reach)
    down = reduce(add, [padded[i : i + height] for i in range(2 * reach + 1)])
    return reduce(add, [down[:, i : i + width] for i in range(2 * reach + 1)])


def _box(values: Float[Array, "height width"], reach: int) -> Float[Array, "height width"]:
    """Sums over squares of pixels, 0 beyond the picture; its own transpose."""
    plain = partial(_plain_box, reach=reach)
    summed = with_gradient(lambda x: (plain(x),), lambda primals, given: (plain(*given),))
    return summed(values)[0]


# --- network ----------------------------------------------------------------------------------------------------------


COLOR_STEP, LOGIT_STEP = 0.3, 2.0  # change of the base colour, and of the opacity's logit, by an output of 1
LOGIT_MARGIN = 1e-2  # keeps the logits of 0 and 1 finite
NOTHING = 2e-4  # opacity below which a pixel stays transparent


class Block(nn.Module):
    """Two convolutions beside the identity."""

    @nn.compact
    def __call__(self, x: Float[Array, "batch height width features"]) -> Float[Array, "batch height width features"]:
        """The features, changed."""
        y = nn.LayerNorm(name="norm")(x)
        y = nn.relu(Conv(x.shape[-1], name="a")(y))
        return x + Conv(x.shape[-1], name="b")(y)


class Double(nn.Module):
    """Features at twice the resolution."""

    @nn.compact
    def __call__(self, x: Float[Array, "batch height width features"]) -> Float[Array, "batch h w features"]:
        """Bilinear, plus four new pixels from each, plus two convolutions."""
        features = x.shape[-1]
        x = double_size(x) + depth_to_space(nn.Dense(4 * features, name="expand")(x), 2)
        y = nn.relu(Conv(features, name="a")(x))
        return x + Conv(features, name="b")(y)


class Shader(nn.Module):
    """Factors of a picture's light maps (`compose_picture`) from a G-buffer (`compute_inputs`)."""

    widths: tuple[int, ...]
    top: int

    @nn.compact
    def __call__(
        self, inputs: Float[Array, "batch height width features"], doublings: int, margin: int = 0
    ) -> Float[Array, "batch h w 21"]:
        """Outputs at 2^doublings times the resolution, without a margin of pixels that is only context."""
        height, width = inputs.shape[1:3]
        square = 2 ** (len(self.widths) - 1)
        x = jnp.pad(inputs, ((0, 0), (0, -height % square), (0, -width % square), (0, 0)))
        skips = []
        for level, features in enumerate(self.widths):
            x = Conv(features, name=f"in{level}")(average_pool(x, 2) if level else x)
            x = Block(name=f"down{level}")(x)
            skips.append(x)
        for level in reversed(range(len(self.widths) - 1)):
            x = skips[level] + double_size(nn.Dense(self.widths[level], name=f"up{level}")(x))
            x = Block(name=f"dec{level}")(x)
        x = nn.Dense(self.top, name="top")(x[:, margin : height - margin, margin : width - margin])
        double = Double(name="double")
        for _ in range(doublings):
            x = double(x)
        x = nn.Dense(NUM_OUTPUTS, kernel_init=nn.initializers.zeros, name="out")(nn.LayerNorm(name="norm")(x))
        return remove_checkerboard(x) if doublings else x


def logit(opacity: Float[Array, "*pixels"]) -> Float[Array, "*pixels"]:
    """Logits of opacities; finite also for 0 and 1."""
    return jnp.log(opacity + LOGIT_MARGIN) - jnp.log(1 + LOGIT_MARGIN - opacity)


def compose_picture(
    outputs: Float[Array, "batch h w 21"],
    maps: Float[Array, "batch height width 17"],
    light_harmonics: Float[Array, "batch 9 3"],
    doublings: int,
) -> tuple[Float[Array, "batch h w 3"], Float[Array, "batch h w"]]:
    """sRGB colour and opacity: materials lit by the light MAPS, times factors of the network's OUTPUTS.

    `light_harmonics` are the spherical harmonics of the light in camera axes.
    """
    for _ in range(doublings):
        maps = double_size(maps)
    by_map, by_output = split_channels(maps, MAPS, keep_axis=True), split_channels(outputs, OUTPUTS, keep_axis=True)
    base = clamp(by_map["color"] + COLOR_STEP * by_output["color_step"], 0, 1)
    metallic = clamp(by_map["metallic"] + COLOR_STEP * by_output["metallic_step"], 0, 1)
    coverage = by_map["opacity"]
    alpha = nn.sigmoid(logit(coverage) + LOGIT_STEP * by_output["logit_step"]) * one_minus_exp(coverage / NOTHING)
    bounced = by_output["bounced_constant"] * light_harmonics[:, None, None, 0]
    bounced += jnp.einsum("bhwk,bkc->bhwc", by_output["bounced_bands"], light_harmonics[:, 1:], precision="highest")
    unshadowed, mirrored = by_map["unshadowed"], by_map["mirrored"]
    mirrored += clamp(by_output["rougher"], 0, 1) * (unshadowed - mirrored)
    diffuse = (1 + by_output["shade"]) * by_map["irradiance"] + by_output["open_sky"] * unshadowed + bounced
    specular = (1 + by_output["shine"]) * by_map["reflected"] + by_output["glow"]
    reflectance = (SPECULAR * (1 - metallic) + base * metallic) * by_map["factor"] + by_map["summand"]
    linear = base * (1 - metallic) * diffuse + reflectance * mirrored * specular
    return smaller(linear_to_srgb(larger(linear, 0)), 1), alpha[..., 0]
