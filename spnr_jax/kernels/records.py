"""The records that travel between kernels: pytrees of arrays, data only.

Every record may carry leading batch axes on all of its arrays (`*batch`).  Axes are named batch, objects, views,
points, rays, samples, height, width, features.  Colours of materials are linear RGB, images are sRGB in [0, 1].  Image
sizes are static fields because they shape arrays.
"""

import contextlib
from typing import TYPE_CHECKING, Any, Self, dataclass_transform, no_type_check

import jax
import numpy as np
from flax import struct
from jax import export
from jaxtyping import Array, Bool, Float, Int, UInt8

from spnr_jax.kernels.numerics import array_namespace

AnyArray = jax.Array | np.ndarray
TABLES = (7, 32, 64, 3)  # shape of a light's tables: irradiance, then a map for each of 6 roughnesses
LARGEST_REACH = 4  # upper bound of the distance from points, in voxels, at which rays are sampled


def register(kind: type) -> None:
    """Lets `jax.export` write functions of a record; static fields are integers."""
    name = f"{kind.__module__}.{kind.__qualname__}"
    with contextlib.suppress(ValueError):  # a module that is imported again: its first classes stay registered
        if issubclass(kind, tuple):
            export.register_namedtuple_serialization(kind, serialized_name=name)
        else:
            export.register_pytree_node_serialization(
                kind,
                serialized_name=name,
                serialize_auxdata=lambda sizes: " ".join(map(str, sizes)).encode(),
                deserialize_auxdata=lambda written: tuple(map(int, bytes(written).split())),
            )


@dataclass_transform(frozen_default=True, field_specifiers=(struct.field,))
class Record:
    """A frozen dataclass that is a pytree, and whose functions `jax.export` can serialise.

    Its fields are not checked at run time: transformations rebuild records with leaves that are no arrays.
    """

    def __init_subclass__(cls) -> None:
        register(no_type_check(struct.dataclass(cls)))

    if TYPE_CHECKING:

        def replace(self, **changes: Any) -> Self:
            """A copy with other values of these fields; Flax makes it."""
            ...


class PointCloud(Record):
    """Surface points of one object with their materials, padded to a fixed count; `mask` is True for real points."""

    positions: Float[AnyArray, "*batch points 3"]
    base_color: Float[AnyArray, "*batch points 3"]
    roughness: Float[AnyArray, "*batch points"]
    metallic: Float[AnyArray, "*batch points"]
    mask: Bool[AnyArray, "*batch points"]
    normals: Float[AnyArray, "*batch points 3"] | None = None
    """Unit vectors of either sign; None: estimated from these points."""
    materials_known: Float[AnyArray, "*batch points"] | None = None
    """1 where roughness and metallic are known, else 0; None: known everywhere."""
    learned: Float[AnyArray, "*batch points"] | None = None
    """0 for a measured point; for a learned one 1 - p / 2 in [0.5, 1], with its probability p of lying on the surface.

    So the two kinds stay apart for the network: 0.5 is the surest learned point, 1 the least sure one.
    """
    evenness: Float[AnyArray, "*batch points"] | None = None
    """Evenness of the measured points (`surfels.neighbors.measure_evenness`); None: that of these points.

    One number for the cloud, repeated for each point so that it is batched and padded like the other fields.
    """


class Camera(Record):
    """A pinhole camera: pose with OpenGL axes (x right, y up, looking along -z) and intrinsics in pixels.

    `height` and `width` are static, because they shape arrays.
    """

    cam_to_world: Float[AnyArray, "*batch 3 4"]
    intrinsics: Float[AnyArray, "*batch 3 3"]
    height: int = struct.field(pytree_node=False)
    width: int = struct.field(pytree_node=False)


class Rays(Record):
    """Half lines; `directions` have unit length, so distances along them are metric."""

    origins: Float[Array, "*batch 3"]
    directions: Float[Array, "*batch 3"]


class Rendering(Record):
    """The result of a rendering; of a network with an upsampler, all but `image` has the resolution before it.

    `depth` is the expected distance along the ray (where nothing is hit: the far side of the box, or 0 beside it),
    `acc` the opacity.
    """

    image: Float[Array, "*batch height width 3"]
    image_lr: Float[Array, "*batch height_lr width_lr 3"] | None = struct.field(default=None, kw_only=True)
    """The image before the upsampler; networks without one leave it out."""
    depth: Float[Array, "*batch height_lr width_lr"]
    acc: Float[Array, "*batch height_lr width_lr"]
    overflow: Int[Array, "*batch"] | None = None
    """Number of entries, pixels, columns and rows that did not fit into a surfel plan; 0: everything is drawn."""


class Scene(Record):
    """An encoded object of a ray-marching network: the feature volume, and which of its voxels hold points."""

    volume: Float[Array, "*batch d d d features"]
    occupied: Bool[Array, "*batch d d d"]


class Volume(Record):
    """An object as a Linen network encodes it, in the box [-1, 1]^3, which is (position - centre) * scale of the cloud.

    `scene` is the network's encoding: a `Scene` for the paper's network.
    """

    scene: Any
    centre: Float[AnyArray, "3"]
    scale: Float[AnyArray, ""]
    reach: int = struct.field(pytree_node=False, default=LARGEST_REACH)
    """Voxels around points within which rays are sampled; follows from the point spacing."""


class Surfels(Record):
    """Surface elements of one object (`surfels/geometry.py`): discs with materials.

    Lengths are in units of the box, colours linear.  Where `mask` is False, the spacing is 1 and all else 0.
    """

    position: Float[AnyArray, "*batch points 3"]
    normal: Float[AnyArray, "*batch points 3"]
    spacing: Float[AnyArray, "*batch points"]
    """Side of the square that a point represents."""
    base_color: Float[AnyArray, "*batch points 3"]
    color_edge: Float[AnyArray, "*batch points 4"]
    """A line in the disc's plane: unit vector across it, and its distance from the point."""
    color_jump: Float[AnyArray, "*batch points 3"]
    """Added to the colour beyond the edge; 0: no edge."""
    roughness: Float[AnyArray, "*batch points"]
    metallic: Float[AnyArray, "*batch points"]
    materials_unknown: Float[AnyArray, "*batch points"]
    """1 where roughness and metallic are unknown, else 0."""
    learned: Float[AnyArray, "*batch points"]
    """As in PointCloud."""
    one_sided: Float[AnyArray, "*batch points"]
    """0 for a two-sided disc, up to 0.98 if only the side of the normal is outside."""
    visibility: Float[AnyArray, "*batch points 64"]
    """In [0, 1], from each of the directions `sides.DIRECTIONS`."""
    shape_ratios: Float[AnyArray, "*batch points 2"]
    """Ratios of the neighbourhood's deviations (`numerics.measure_shape`): thickness / width, width / length."""
    rim_tangent: Float[AnyArray, "*batch points 3"]
    """Unit vector in the disc's plane."""
    rim_distances: Float[AnyArray, "*batch points 4"]
    """Extents of the disc in spacings: along +rim_tangent, -rim_tangent, +normal x rim_tangent and its opposite."""
    mask: Bool[AnyArray, "*batch points"]


class SurfelScene(Record):
    """An encoded object of the surfel network; arrays only, so scenes of equally padded clouds can be stacked.

    The surfels lie in the box [-1, 1]^3, which is (position - centre) * scale of the cloud.  `spacing` is their median
    spacing in the box; it determines the resolution of the G-buffer.
    """

    surfels: Surfels
    spacing: Float[AnyArray, "*batch"]
    centre: Float[AnyArray, "*batch 3"]
    scale: Float[AnyArray, "*batch"]


Encoded = Volume | SurfelScene  # what Model.encode returns: a scene for surfels, a volume for other networks


class Light(Record):
    """Distant light as tables by direction, all linear in the environment map (`surfels/lighting.py`).

    `tables[0]` is the irradiance / pi by normal.  `tables[1:]` are the prefiltered radiances by mirrored direction, one
    for each of the roughnesses LEVELS; `tables[1]` is the map itself.
    """

    tables: Float[AnyArray, "7 32 64 3"]

    def __add__(self, other: "Light") -> "Light":
        """The sum of both lights."""
        return Light(tables=self.tables + other.tables) if isinstance(other, Light) else NotImplemented

    def __radd__(self, other: int) -> "Light":
        """The light itself: `sum` begins with 0."""
        return self if isinstance(other, int) and other == 0 else NotImplemented

    def __mul__(self, factor: float | int) -> "Light":
        """The light with its radiance multiplied by a factor."""
        if isinstance(factor, Light):
            return NotImplemented
        return Light(tables=(factor * self.tables).astype(self.tables.dtype))  # of NumPy's numbers, which are double

    __rmul__ = __mul__

    def __truediv__(self, divisor: float | int) -> "Light":
        """The light with its radiance divided by a number."""
        return self * (1 / divisor)

    def turned(self, degrees: float | int | jax.Array) -> "Light":
        """The light rotated about the up axis: an azimuth (0 at +z, 90 at +x) increases by `degrees`.

        Exact for multiples of a texel, 5.625 degrees; otherwise texels are interpolated.  The angle may be traced.
        """
        xp = array_namespace(degrees, self.tables)
        tables = xp.asarray(self.tables)
        columns = -degrees / 360 * tables.shape[-2]  # columns run against the azimuth
        whole = xp.floor(columns)
        part = xp.asarray(columns - whole, tables.dtype)
        # indices: jnp.roll would be compiled for every shift
        places = xp.arange(tables.shape[-2]) - whole.astype(int)
        near, far = (tables[..., (places - i) % len(places), :] for i in (0, 1))
        return Light(tables=(1 - part) * near + part * far)


class GBuffer(Record):
    """The attributes of the front-most surfels at each pixel, blended; vectors are in camera axes, 0 without discs.

    Entry i of a pixel has the kernel k_i, the facing f_i, the transmittance T_i in front of it, the blend weight a_i
    and the narrower weight b_i = a_i k_i^4 f_i.  Means are weighted by a_i where nothing else is said.
    """

    opacity: Float[Array, "height width"]
    """sum a_i, at most 1."""
    coverage: Float[Array, "height width"]
    """sum k_i^2 f_i T_i: grows with overlap."""
    depth: Float[Array, "height width"]
    """Mean depth along the camera's axis, in units of the box."""
    depth_deviation: Float[Array, "height width"]
    """Standard deviation of the depth."""
    log_spacing: Float[Array, "height width"]
    normal: Float[Array, "height width 3"]
    color: Float[Array, "height width 3"]
    """Mean by b_i, where the ray meets the discs."""
    attributes: Float[Array, "height width features"]
    """Means of nn.shader.ATTRIBUTES."""
    sharp_weight: Float[Array, "height width"]
    """sum b_i."""
    centre_offset: Float[Array, "height width 2"]
    """Mean, by b_i, of the offset of the discs' centres from the pixel's centre, in pixels."""


class Batch(Record):
    """One training batch: clouds of `objects`, and `views` of each with reference, opacity, and condition image."""

    cloud: PointCloud
    camera: Camera
    image: Float[AnyArray, "objects views height width 3"]
    alpha: Float[AnyArray, "objects views height width"]
    condition: Float[AnyArray, "objects views height width 3"]
    condition_mask: Bool[AnyArray, "objects views height width"]


class Crops(Record):
    """One training batch of the shader network: crops of G-buffers as network inputs (`nn/shader.py`).

    `target` is the reference, 8-bit RGBA with straight alpha, at 2^doublings times the resolution.  `inputs` extend
    `margin` pixels beyond it and beyond the light maps on each side.
    """

    inputs: Float[AnyArray, "crops rows columns 33"]
    maps: Float[AnyArray, "crops height width 17"]
    light_harmonics: Float[AnyArray, "crops 9 3"]
    target: UInt8[AnyArray, "crops h w 4"]
    doublings: int = struct.field(pytree_node=False)
    margin: int = struct.field(pytree_node=False, default=0)


class Gaussians(Record):
    """Gaussian splats of one object, as `spnr_jax/surfels/gaussians.py` makes them and splat viewers draw them.

    Splat i is its opacity times exp(-d^T C^-1 d / 2), with C = R S^2 R^T from its rotation (a unit quaternion, w x y z)
    and scales (standard deviations along its axes; the third is the normal).  Its colour in the direction eye -> splat
    is sRGB: 0.5 plus the sum of `harmonics` times the real spherical harmonics of surfels/gaussians.py.
    """

    position: Float[AnyArray, "splats 3"]
    rotation: Float[AnyArray, "splats 4"]
    scale: Float[AnyArray, "splats 3"]
    opacity: Float[AnyArray, " splats"]
    harmonics: Float[AnyArray, "splats coefficients 3"]


Key = jax.Array


def unstack(tree: Any) -> list[Any]:
    """The elements of a pytree of arrays along the first axis."""
    return [jax.tree.map(lambda x, i=i: x[i], tree) for i in range(len(jax.tree.leaves(tree)[0]))]
