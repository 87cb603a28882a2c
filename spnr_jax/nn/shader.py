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

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from spnr_jax.kernels.imaging import average_pool, depth_to_space, double_size, linear_to_srgb
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

# --- inputs -----------------------------------------------------------------------------------------------------------


NUM_FEATURES = 33
ODD = (14, 17, 28), (15, 18, 29)  # features that change their sign when the picture is mirrored along x, or along y
FAINT = 0.02  # opacity at which a pixel's features have half their value
WINDOWS = 2, 6  # pixels to each side over which the depth is compared
EDGE = 0.6  # coverage at the outline: discs reach beyond the surface, half of their weight
LEAST = 0.01  # opacity above which a pixel has a relief
HAZE = 0.05  # share of the opacity kept where discs hardly cover a pixel: the network may raise it
LEAST_SHARP = 1e-6  # summed narrow weights at which the sharp colour has half the confidence
SHARPEST = 0.25  # largest difference between the sharp colour and the blended one


def face_camera(surfels: Surfels, camera: Camera) -> Surfels:
    """The surfels with all normals turned to the camera."""
    view = camera.cam_to_world[:, 3][None] - surfels.position
    behind = jnp.sum(view * surfels.normal, axis=1, keepdims=True) < 0
    return dataclasses.replace(surfels, normal=jnp.where(behind, -surfels.normal, surfels.normal))


def compute_attributes(surfels: Surfels, light: Light, camera: Camera) -> Float[Array, "points 19"]:
    """Attributes of each surfel that are blended over pixels; those of the light are linear in it."""
    rotation, eye = camera.cam_to_world[:, :3], camera.cam_to_world[:, 3]
    cosines = larger(jnp.einsum("pi,di->pd", surfels.normal, DIRECTIONS, precision="highest"), 0)
    openness = jnp.sum(surfels.visibility * cosines, axis=1) / larger(jnp.sum(cosines, axis=1), 1e-6)
    bent = 4 / len(DIRECTIONS) * jnp.einsum("pd,di->pi", surfels.visibility, DIRECTIONS, precision="highest")
    view = normalize(jnp.asarray(eye[None] - surfels.position))
    along = jnp.sum(view * surfels.normal, axis=1, keepdims=True)
    mirror = 2 * jnp.abs(along) * jnp.where(along < 0, -1.0, 1.0) * surfels.normal - view
    lobe = jnp.exp(lighting.LOBE * (jnp.einsum("pi,di->pd", mirror, DIRECTIONS, precision="highest") - 1))
    reflected = jnp.sum(surfels.visibility * lobe, axis=1) / jnp.sum(lobe, axis=1)
    parts = [surfels.roughness, surfels.metallic, lighting.gather_irradiance(surfels, light), reflected, openness]
    parts += [jnp.einsum("pi,ij->pj", bent, rotation, precision="highest"), surfels.base_color, surfels.shape_ratios]
    parts += [surfels.one_sided, surfels.materials_unknown, surfels.learned, jnp.mean(surfels.base_color, axis=1) ** 2]
    return jnp.concatenate([x[:, None] if x.ndim == 1 else x for x in map(jnp.asarray, parts)], axis=1)


def compute_inputs(
    buffer: GBuffer, light: Light, camera: Camera
) -> tuple[Float[Array, "height width 33"], Float[Array, "height width 17"]]:
    """The network's inputs, which do not depend on the light, and material and light maps for `compose_picture`."""
    first, bent, blended, last = jnp.split(buffer.attributes, (7, 10, 13), axis=-1)
    (roughness, metallic, *arriving, reflected, openness), of_surface = map(split_columns, (first, last))
    planarity, linearity, one_sided, materials_unknown, learned, squared = of_surface
    confidence = (buffer.sharp_weight / (buffer.sharp_weight + LEAST_SHARP))[..., None]  # 0 far from all discs
    color = clamp(blended + confidence * clamp(buffer.color - blended, -SHARPEST, SHARPEST), 0, 1)
    normal, view = _directions(buffer, camera)
    cosine = -dot(normal, view)
    mirror = [v + 2 * cosine * n for n, v in zip(normal, view, strict=True)]
    world = [[dot(row, direction) for row in camera.cam_to_world[:, :3]] for direction in (normal, mirror)]
    factor, summand = lighting.reflectance(roughness, clamp(cosine, 0.05, 1))
    spacing = jnp.exp(buffer.log_spacing)
    in_pixels = larger(spacing, 1e-6) * camera.intrinsics[0, 0] / larger(buffer.depth, 0.1)
    numbers = [buffer.opacity, jnp.log1p(buffer.coverage), roughness, metallic, openness, reflected]
    numbers += [smaller(buffer.depth_deviation / spacing, 4), *(_relief(buffer, spacing, reach) for reach in WINDOWS)]
    numbers += [0.5 * jnp.log(in_pixels), planarity, linearity, one_sided, cosine]
    vectors = [buffer.normal, bent, linear_to_srgb(color), linear_to_srgb(blended)]
    drawn = (buffer.opacity / (buffer.opacity + FAINT))[..., None]
    pattern = [jnp.log1p(8 * buffer.sharp_weight)[..., None], clamp(buffer.centre_offset / in_pixels[..., None], -2, 2)]
    inputs = jnp.concatenate([jnp.stack(numbers, axis=-1), *vectors], axis=-1)
    covered = buffer.opacity * larger(one_minus_exp((buffer.coverage / EDGE) ** 2), HAZE)
    contrast = safe_sqrt(squared - jnp.mean(blended, axis=-1) ** 2)  # standard deviation of the blended colours
    pattern += [materials_unknown[..., None], learned[..., None], contrast[..., None]]
    inputs = jnp.concatenate([drawn * inputs, drawn, *(drawn * x for x in pattern)], axis=-1)
    unshadowed = lighting.irradiance(light, world[0]), lighting.reflect(light, world[1], roughness)
    maps = [*split_columns(color), metallic, covered, factor, summand, *arriving]
    return inputs, jnp.stack([*maps, *unshadowed[0], *unshadowed[1], reflected], axis=-1)


def _directions(buffer: GBuffer, camera: Camera) -> tuple[list[Array], list[Array]]:
    """Unit normals and rays' directions, camera axes, as columns; the camera's axis where there is no normal."""
    size = safe_sqrt(jnp.sum(buffer.normal**2, axis=-1))
    known = size > 1e-3
    normal = [n / larger(size, 1e-4) for n in split_columns(buffer.normal)]
    normal = [jnp.where(known, n, c) for n, c in zip(normal, (0.0, 0.0, 1.0), strict=True)]
    across, down = jnp.arange(camera.width) + 0.5, jnp.arange(camera.height) + 0.5
    right = jnp.broadcast_to(((across - camera.intrinsics[0, 2]) / camera.intrinsics[0, 0])[None], size.shape)
    up = jnp.broadcast_to(-((down - camera.intrinsics[1, 2]) / camera.intrinsics[1, 1])[:, None], size.shape)
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


NUM_OUTPUTS = 21
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
        return nn.Dense(NUM_OUTPUTS, kernel_init=nn.initializers.zeros, name="out")(nn.LayerNorm(name="norm")(x))


def logit(opacity: Float[Array, "*pixels"]) -> Float[Array, "*pixels"]:
    """Logits of opacities; finite also for 0 and 1."""
    return jnp.log(opacity + LOGIT_MARGIN) - jnp.log(1 + LOGIT_MARGIN - opacity)


def compose_picture(
    outputs: Float[Array, "batch h w 21"],
    maps: Float[Array, "batch height width 17"],
    ambient: Float[Array, "batch 9 3"],
    doublings: int,
) -> tuple[Float[Array, "batch h w 3"], Float[Array, "batch h w"]]:
    """sRGB colour and opacity: materials lit by the light maps, times the factors of the network.

    `maps` are those of `compute_inputs`, `ambient` the light's spherical harmonics in camera axes.
    """
    for _ in range(doublings):
        maps = double_size(maps)
    color, metallic, opacity, factor, summand, arriving, unshadowed, mirrored, reflected = jnp.split(
        maps, (3, 4, 5, 6, 7, 10, 13, 16), axis=-1
    )
    step, logit_step, shade, open_sky, shine, glow, bounce, bounces, metal_step, rougher = jnp.split(
        outputs, (3, 4, 5, 6, 7, 8, 11, 19, 20), axis=-1
    )
    base = clamp(color + COLOR_STEP * step, 0, 1)
    alpha = nn.sigmoid(logit(opacity) + LOGIT_STEP * logit_step) * one_minus_exp(opacity / NOTHING)
    bounced = bounce * ambient[:, None, None, 0]
    bounced += jnp.einsum("bhwk,bkc->bhwc", bounces, ambient[:, 1:], precision="highest")
    metallic = clamp(metallic + COLOR_STEP * metal_step, 0, 1)
    mirrored += clamp(rougher, 0, 1) * (unshadowed - mirrored)
    diffuse = (1 + shade) * arriving + open_sky * unshadowed + bounced
    specular = (1 + shine) * reflected + glow
    normal_incidence = SPECULAR * (1 - metallic) + base * metallic
    linear = base * (1 - metallic) * diffuse + (normal_incidence * factor + summand) * mirrored * specular
    return smaller(linear_to_srgb(larger(linear, 0)), 1), alpha[..., 0]
