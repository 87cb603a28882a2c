"""What the network is told equals what it is shown: sampled points against the materials that the renderer draws with.

Each object is loaded from a file, its points are sampled, and through every point that the camera sees one ray is
traced in the scene that the pictures are rendered from. Where the ray lands, Mitsuba is asked for the base colour,
roughness and metallic of the surface: an unlit render of exactly those spots, without the pixel grid in between, on
which a point would be compared with its neighbours. A test then ties that answer to radiance, which for a smooth metal
under white light is its base colour.
"""

from pathlib import Path

import numpy as np
import pytest
from support.gltf_files import CORNERS, UV, GltfBuilder, one_square
from support.handmade import WHITE_LIGHT, box, plain

from data_gen.render import views
from data_gen.render.variant import mitsuba_module
from spnr_jax.formats import meshes, surface_points
from spnr_jax.formats.assets import Asset

REAL = Path(__file__).parents[4] / "shared" / "data" / "real" / "train"
EYE = np.array([0.5, 0.4, 2.9])
STEP = 1 / 255
GRAZING = 0.1  # cosine of a view so flat that float32 moves the spot where the ray lands
NOISE = np.random.default_rng(0).integers(0, 256, (5, 7, 3))
CHANNELS = ("base_color", "roughness", "metallic")


def told_and_shown(asset, eye=EYE, count=400, seed=0):
    """The points' own channels and normals, and the renderer's at the same spots, of all points that the eye sees."""
    mi = mitsuba_module()
    asset, _ = surface_points.normalise(asset)
    surface = surface_points.sample_surface(asset, count, seed)
    scene = views.build_scene(asset, WHITE_LIGHT)
    first_face = dict(zip([shape.id() for shape in scene.handle.shapes()], scene.first_face.values(), strict=True))
    rows, shown = [], {name: [] for name in (*CHANNELS, "normals")}
    for row, towards in enumerate(surface.positions - eye):
        hit = scene.handle.ray_intersect(mi.Ray3f(eye, towards / np.linalg.norm(towards)))
        on_its_face = hit.is_valid() and first_face[hit.shape.id()] + hit.prim_index == surface.face[row]
        if (
            not on_its_face
            or hit.t < np.linalg.norm(towards) - 1e-4
            or abs(np.dot(hit.n, hit.to_world(hit.wi))) < GRAZING
        ):
            continue
        np.testing.assert_allclose(np.array(hit.p), surface.positions[row], atol=2e-5)
        rows.append(row)
        shown["normals"].append(np.array(hit.sh_frame.n))
        shown["base_color"].append(np.array(hit.bsdf().eval_attribute_3("base_color", hit)))
        for name in ("roughness", "metallic"):
            shown[name].append(hit.bsdf().eval_attribute_1(name, hit))
    assert len(rows) > 0.05 * count
    return {name: getattr(surface, name)[rows] for name in shown}, {name: np.array(shown[name]) for name in shown}


def assert_agreement(asset, varying=(), **options):
    """Told equals shown to one step of 8 bits; the channels named as varying do vary over the object."""
    told, shown = told_and_shown(asset, **options)
    for name in CHANNELS:
        np.testing.assert_allclose(told[name], shown[name], atol=STEP, err_msg=name)
        assert (np.ptp(told[name], axis=0).max() > 0.1) == (name in varying), name
    np.testing.assert_allclose(told["normals"], shown["normals"], atol=1e-3)
    return told


def textured(builder, texels=NOISE, sampler=None, **factors):
    """A glTF material with a base-colour texture."""
    texture = {"index": builder.texture(texels, **(sampler or {}))}
    return {"pbrMetallicRoughness": {"baseColorTexture": texture, **factors}}


def factors(color, roughness, metallic):
    return {
        "pbrMetallicRoughness": {
            "baseColorFactor": [*color, 1],
            "roughnessFactor": roughness,
            "metallicFactor": metallic,
        }
    }


def own_sizes(builder):
    """Both textures, of different sizes, and factors."""
    material = textured(builder, baseColorFactor=[0.9, 0.5, 1, 1], roughnessFactor=0.8)
    surface = builder.texture(np.random.default_rng(2).integers(0, 256, (9, 3, 3)))
    material["pbrMetallicRoughness"]["metallicRoughnessTexture"] = {"index": surface}
    return material


def sized(*size):
    return lambda builder: textured(builder, np.random.default_rng(1).integers(0, 256, (*size, 3)))


def wrapped(code):
    return lambda builder: textured(builder, sampler={"wrapS": code, "wrapT": code})


TEXTURE, FAR = {"TEXCOORD_0": UV}, {"TEXCOORD_0": UV * np.float32(4.3) - np.float32(1.7)}
TINTS = {"COLOR_0": np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]])}
ONE_TINT = "vertex colours that vary over a texture (their mean is used)"
BASE = ("base_color",)
SQUARES = {  # case: material, attributes of vertices, the channels that vary, what is said to be ignored
    **{f"a texture that wraps by {code}": (wrapped(code), FAR, BASE) for code in (10497, 33648, 33071)},
    **{f"a texture of {size}": (sized(*size), TEXTURE, BASE) for size in ((1, 6), (6, 1), (2, 2), (33, 17))},
    "a texture of one texel": (sized(1, 1), TEXTURE, ()),
    "channels with textures of their own size": (own_sizes, FAR, CHANNELS),
    "vertex colours times a factor": (lambda builder: factors((0.5, 1, 0.8), 0.4, 0.2), TINTS, BASE),
    "vertex colours over a surface texture": (
        lambda builder: {"pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": builder.texture(NOISE)}}},
        TEXTURE | TINTS,
        CHANNELS,
    ),
    "vertex colours over a texture": (textured, TEXTURE | TINTS, BASE, ONE_TINT),
}


class TestGltf:
    def test_each_primitive_keeps_its_own_flat_material(self, tmp_path):
        builder = GltfBuilder()
        looks = [((0.9, 0.1, 0.2), 0.1, 0.0), ((0.02, 0.5, 1.0), 1.0, 1.0), ((0, 0, 0), 0.0, 0.3), ((1, 1, 1), 0.6, 0)]
        shifts = np.float32([[0, 0, 0], [2, 0, 0], [0, 2, 0], [2, 2, 0]])
        squares = [
            builder.primitive(CORNERS + shift, material=builder.material(**factors(*look)))
            for shift, look in zip(shifts, looks, strict=True)
        ]
        builder.mesh(*squares[:3])
        builder.mesh(squares[3], translation=[0, 0, 0.5])
        asset = meshes.load_mesh(builder.write(tmp_path / "squares.glb"))
        told = assert_agreement(asset, varying=CHANNELS)
        for color, roughness, metallic in looks:
            near = np.abs(told["base_color"] - color).max(axis=1) < 1e-6
            assert near.sum() > 40
            np.testing.assert_allclose(told["roughness"][near], roughness, atol=1e-6)
            np.testing.assert_allclose(told["metallic"][near], metallic, atol=1e-6)

    @pytest.mark.parametrize("smooth", [False, True])
    def test_flat_and_smooth_faces_show_their_texture_and_normals(self, tmp_path, smooth):
        builder = GltfBuilder()
        tilted = np.float32([[-1, 0, 2], [1, 0, 2], [1, 1, 2], [-1, 1, 2]])
        tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
        attributes = {"TEXCOORD_0": UV} | ({"NORMAL": tilted} if smooth else {})
        node = {"rotation": [0, 0.2, 0, 0.96**0.5]}
        asset = one_square(tmp_path, builder, node, material=builder.material(**textured(builder)), **attributes)
        told = assert_agreement(asset, varying=["base_color"])
        assert told["normals"][:, 2].min() > 0.5  # towards the camera
        assert (np.ptp(told["normals"], axis=0).max() > 0.2) == smooth

    @pytest.mark.parametrize("double_sided", [False, True])
    def test_faces_seen_from_behind_show_the_same_material(self, tmp_path, double_sided):
        builder = GltfBuilder()
        material = builder.material(**textured(builder), doubleSided=double_sided)
        asset = one_square(tmp_path, builder, material=material, TEXCOORD_0=UV)
        assert assert_agreement(asset, varying=["base_color"], eye=EYE * [1, 1, -1])["normals"][:, 2].min() > 0.99

    @pytest.mark.parametrize("case", SQUARES)
    def test_what_a_square_of_a_material_is_told_to_be_it_shows(self, tmp_path, case):
        material, attributes, varying, *ignored = SQUARES[case]
        builder = GltfBuilder()
        asset = one_square(tmp_path, builder, material=builder.material(**material(builder)), **attributes)
        assert asset.ignored == tuple(ignored)
        assert_agreement(asset, varying=varying, count=1500 if "wraps" in case else 400)


@pytest.mark.parametrize("color", [(0.9, 0.6, 0.2), (0.04, 0.5, 1.0), (1.0, 1.0, 1.0)])
def test_a_smooth_metal_under_white_light_radiates_the_base_colour_that_its_points_carry(color):
    # at normal incidence a metal's reflectance is its base colour, and the mirrored light is 1 from everywhere
    asset = Asset(parts=(box(half=(0.6, 0.6, 0.02), material=plain(color, roughness=0.05, metallic=1.0)),))
    config = views.ViewConfig(resolution=16, spp=256)
    radiance = views.render_view(views.build_scene(asset, WHITE_LIGHT), views.look_at(np.array([0, 0, 3.0])), config, 0)
    told = surface_points.sample_surface(asset, 100, 6).base_color.mean(axis=0)
    np.testing.assert_allclose(radiance[6:10, 6:10, :3].mean(axis=(0, 1)), told, atol=STEP)


@pytest.mark.skipif(not REAL.is_dir(), reason="needs the real meshes beside the checkout")
@pytest.mark.parametrize(
    "name", ["khr_sheen_chair.glb", "kenney_racer.glb", "sk_taxi.glb", "gso_chefmate_8_frypan/chefmate_8_frypan.obj"]
)
def test_real_objects_agree(name):
    told, shown = told_and_shown(meshes.load_mesh(REAL / name), count=1000)
    for channel in CHANNELS:
        np.testing.assert_allclose(told[channel], shown[channel], atol=STEP, err_msg=channel)
