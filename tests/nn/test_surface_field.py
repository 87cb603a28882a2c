"""The field that sees the surface: light on materials, and nothing where no point is near."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference
from support.laws import close, numbers

from spnr_jax.kernels import colors
from spnr_jax.kernels.numerics import normalize
from spnr_jax.kernels.records import SurfaceSample
from spnr_jax.nn.surface_field import DIELECTRIC, SHARPNESS, STRENGTH, SurfaceField

N = 12


def sample(seed=0):
    return SurfaceSample(
        exists=jnp.arange(N) % 5 > 0,
        height=numbers(seed, N),
        beside=numbers(seed + 1, N, low=0.0),
        nearest=numbers(seed + 2, N, low=0.0),
        ahead=numbers(seed + 8, N),
        miss=numbers(seed + 9, N, low=0.0),
        outside=numbers(seed + 10, N),
        flatness=numbers(seed + 11, N, low=0.0),
        narrowness=numbers(seed + 12, N, low=0.0),
        spacing=numbers(seed + 3, N, low=0.01, high=0.1),
        normal=normalize(numbers(seed + 4, N, 3)),
        base_color=numbers(seed + 5, N, 3, low=0.0),
        roughness=numbers(seed + 6, N, low=0.0),
        metallic=numbers(seed + 7, N, low=0.0),
    )


X, DIRECTIONS = numbers(20, N, 4), normalize(numbers(21, N, 3))


def field(lit, sees_direction=True):
    return SurfaceField(width=6, direction_frequencies=2, sees_direction=sees_direction, lit=lit)


def evaluate(module, x, directions, surface):
    """Density of samples, and the picture of rays of which each meets one sample: that of full opacity."""
    view = module.view(directions)
    density, emitted = module(x, directions, surface)
    return density, module.finish(emitted, jnp.ones(len(x)), view)


@functools.cache
def weights(module):
    variables = jax.jit(lambda key: module.init(key, X, DIRECTIONS, sample(), method=evaluate))(jax.random.key(0))
    return jax.tree.map(lambda x: x + 0.3 * numbers(2, *x.shape), variables)


@functools.partial(jax.jit, static_argnums=0)
def apply(module, variables, surface, directions=DIRECTIONS):
    return module.apply(variables, X, directions, surface, method=evaluate)


@pytest.mark.parametrize("lit", [True, False])
def test_density_and_colour_are_those_of_the_layers_written_out(lit):
    module, surface = field(lit), jax.tree.map(np.float64, sample())
    variables = weights(module)
    density, color = apply(module, variables, sample())
    params, d = jax.tree.map(np.float64, variables["params"]), np.float64(DIRECTIONS)

    def dense(name, x):
        return x @ params[name]["kernel"] + params[name].get("bias", 0)

    facing = -np.sum(surface.normal * d, axis=1)
    lengths = (surface.height, surface.beside, surface.nearest, surface.ahead, surface.miss, surface.outside)
    scalars = [*lengths, surface.flatness, surface.narrowness]
    scalars = np.stack([*scalars, 10 * surface.spacing, facing, surface.roughness, surface.metallic], axis=1)
    mirrored = d + 2 * facing[:, None] * surface.normal
    inputs = np.concatenate([np.float64(X), scalars, surface.normal, surface.base_color, mirrored], axis=1)
    shape = reference.softplus(dense("shape", reference.softplus(dense("near", inputs))))
    strength, shift = dense("density", shape).T
    fog = STRENGTH * reference.softplus(strength) / (1 + np.exp(SHARPNESS * surface.height - shift))
    close(density, np.where(sample().exists, fog * np.maximum(facing, 0) / surface.spacing, 0), rtol=1e-4)
    encoded = np.concatenate([d] + [f(d * 2**k) for k in range(2) for f in (np.sin, np.cos)], axis=1)
    light = dense("light", reference.softplus(dense("deep", shape) + dense("direction", encoded)))
    if lit:
        light, metal = reference.softplus(light), surface.metallic[:, None]
        diffuse = surface.base_color * (1 - metal) * light[:, :3]
        radiance = diffuse + (DIELECTRIC * (1 - metal) + surface.base_color * metal) * light[:, 3:]
        close(color, colors.linear_to_srgb(jnp.clip(radiance, 0, 1)))
    else:
        close(color, 1 / (1 + np.exp(-light)))


def test_the_mirrored_direction_leaves_a_mirror_as_the_view_came():
    d, n = np.float64(DIRECTIONS), np.float64(sample().normal)
    mirrored = d + 2 * -np.sum(n * d, axis=1, keepdims=True) * n
    close(np.linalg.norm(mirrored, axis=1), np.ones(N))
    close(np.sum(mirrored * n, axis=1), -np.sum(d * n, axis=1))


def test_a_black_dielectric_reflects_light_and_a_black_metal_none():
    module = field(lit=True)
    variables, surface = weights(module), sample().replace(base_color=jnp.zeros((N, 3)))
    _, plastic = apply(module, variables, surface.replace(metallic=jnp.zeros(N)))
    _, metal = apply(module, variables, surface.replace(metallic=jnp.ones(N)))
    assert (plastic > 0).all()
    assert (metal == 0).all()


def test_the_deeper_behind_the_surface_the_denser_and_a_ray_along_it_meets_nothing():
    module, surface = field(lit=True), sample()
    variables = weights(module)
    told = jax.tree.map(lambda x: x, variables)
    told["params"]["near"]["kernel"] = (
        told["params"]["near"]["kernel"].at[len(X[0])].set(0)
    )  # the network sees no height
    facing = -jnp.ones(N) * 0.5
    towards = surface.replace(exists=jnp.ones(N, bool), normal=facing[:, None] * DIRECTIONS)
    densities = [apply(module, told, towards.replace(height=jnp.full(N, h)))[0] for h in (3.0, 0.5, 0.0, -0.5, -3.0)]
    assert all((behind > before).all() for before, behind in zip(densities, densities[1:], strict=False))
    across = jnp.cross(DIRECTIONS, jnp.array([0.0, 1.0, 0.0]))
    close(apply(module, variables, towards.replace(normal=normalize(across)))[0], jnp.zeros(N), atol=1e-4)


def test_where_no_point_is_near_nothing_is_dense():
    module = field(lit=True)
    density, _ = apply(module, weights(module), sample().replace(exists=jnp.zeros(N, bool)))
    assert (density == 0).all()


def test_a_field_that_does_not_see_the_direction_has_one_colour_from_all_sides_that_see_the_same_face():
    module, surface = field(lit=True, sees_direction=False), sample()
    variables = weights(module)
    assert "direction" not in variables["params"]
    turned = DIRECTIONS - 2 * jnp.sum(DIRECTIONS * surface.normal, axis=1, keepdims=True) * surface.normal
    turned = -turned  # as steep, from the other side of the normal
    (density, color), (other_density, other) = (apply(module, variables, surface, d) for d in (DIRECTIONS, turned))
    close((other_density, other), (density, color), rtol=1e-4, atol=1e-5)


@functools.partial(jax.jit, static_argnums=0)
def finish(module, variables, emitted, acc):
    return module.apply(variables, emitted, acc, jnp.zeros((len(acc), module.width)), method="finish")


@functools.partial(jax.jit, static_argnums=0)
def emit(module, variables):
    return module.apply(variables, X, DIRECTIONS, sample())[1]


@pytest.mark.parametrize("lit", [True, False])
def test_a_ray_mixes_in_linear_light_and_lies_on_white_in_srgb(lit):
    """Half covered by linear grey 0.5 (sRGB 0.7354) in light of 1: half of that, and half of white."""
    module = field(lit)
    variables = jax.tree.map(jnp.zeros_like, weights(module))
    if lit:
        variables["params"]["light"]["bias"] += np.log(np.e - 1)  # softplus makes it 1
    grey, half, black = jnp.full((1, 3), 0.25), jnp.array([0.5]), jnp.zeros((1, 3))
    expected = 0.5 * (0.735357 if lit else 0.5) + 0.5
    emitted = (jnp.zeros((1, 6)), *((grey, black) if lit else ()))
    close(finish(module, variables, emitted, half), jnp.full((1, 3), expected))


@pytest.mark.parametrize("lit", [True, False])
def test_a_ray_lies_on_white_in_srgb_by_its_opacity(lit):
    """What is composited weighs as much as the opacity: half of it is the same colour, half of the picture."""
    module = field(lit)
    variables = weights(module)
    whole = emit(module, variables)
    full = finish(module, variables, whole, jnp.ones(N))
    half = finish(module, variables, tuple(0.5 * x for x in whole), jnp.full(N, 0.5))
    close(half, 0.5 * full + 0.5, rtol=1e-5, atol=1e-6)
    assert (finish(module, variables, tuple(0 * x for x in whole), jnp.zeros(N)) == 1).all()


def test_light_is_told_once_for_what_a_ray_sees_in_the_mean():
    """Two samples of a ray: layers up to `shape` each, then the mean; materials mix in linear light."""
    module = field(lit=True)
    variables = weights(module)
    whole = emit(module, variables)
    share = 0.25
    mixed = tuple(share * x[:1] + (1 - share) * x[1:2] for x in whole)
    params = variables["params"]
    deep = share * whole[0][0] + (1 - share) * whole[0][1]
    deep = jax.nn.softplus(deep @ params["deep"]["kernel"] + params["deep"]["bias"])
    light = jax.nn.softplus(deep @ params["light"]["kernel"] + params["light"]["bias"])
    radiance = mixed[1][0] * light[:3] + mixed[2][0] * light[3:]
    close(finish(module, variables, mixed, jnp.ones(1))[0], colors.linear_to_srgb(jnp.clip(radiance, 0, 1)), rtol=1e-4)


@pytest.mark.parametrize("lit", [True, False])
def test_a_ray_of_no_or_of_blinding_light_is_finite_in_value_and_gradient(lit):
    module = field(lit)
    variables = weights(module)

    @jax.jit
    @functools.partial(jax.value_and_grad, argnums=(0, 1))
    def picture(size, acc):
        emitted = (jnp.full((1, 6), size * acc), *[jnp.full((1, 3), size * acc)] * (2 if lit else 0))
        return jnp.sum(finish(module, variables, emitted, acc))

    for size in (0.0, 1e-30, 1e-8, 1e4):
        for acc in (0.0, 1e-30, 1e-6, 1.0):
            value, gradient = picture(jnp.float32(size), jnp.array([acc]))
            assert 0 <= value <= 3.00001
            assert all(np.isfinite(x).all() for x in gradient), (size, acc)
