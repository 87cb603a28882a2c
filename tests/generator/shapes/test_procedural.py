"""Laws of the procedural objects: sound geometry, one connected thing, a function of its category and seed only."""

import functools

import numpy as np
import pytest

from data_gen.procedural import CATEGORIES, make

SEEDS = range(12)
CASES = [(category, seed) for category in CATEGORIES for seed in SEEDS]
PIXELS = 48  # of the voxel grid along the longest side
made = functools.cache(make)


@pytest.fixture
def asset(request):
    return made(*request.param)


every_asset = pytest.mark.parametrize("asset", CASES, indirect=True, ids=lambda case: f"{case[0]}-{case[1]}")


def content(asset):
    """The bytes of every array of an object."""
    records = (record for part in asset.parts for record in (vars(part), vars(part.material)))
    return b"".join(x.tobytes() for record in records for x in record.values() if isinstance(x, np.ndarray))


def triangles(asset):
    """(f, 3, 3) corners of all faces."""
    return np.concatenate([part.positions[part.faces] for part in asset.parts])


def corner_agreement(part):
    """(f, 3) cosine between each face and its corners' normals."""
    a, b, c = part.positions[part.faces.T]
    facing = np.cross(b - a, c - a)
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    return np.einsum("fk,fck->fc", facing, part.normals[part.faces])


@every_asset
def test_geometry_and_materials_are_sound_and_objects_enclose_volume_and_stand_on_the_floor(asset):
    for part in asset.parts:
        for array in (part.positions, part.normals, part.texcoords):
            assert np.isfinite(array).all()
        assert np.array_equal(np.unique(part.faces), np.arange(len(part.positions)))
        a, b, c = part.positions[part.faces.T]
        assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-10
        np.testing.assert_allclose(np.linalg.norm(part.normals, axis=1), 1, atol=1e-5)
        assert (corner_agreement(part) > 0).mean() > 0.985
        material = part.material
        assert 0.015 < material.base_color.min() <= material.base_color.max() < 0.96
        assert 0.045 < material.roughness.min() <= material.roughness.max() <= 1
        assert 0 <= material.metallic.min() <= material.metallic.max() <= 1
        assert {x.dtype for x in (material.base_color, material.roughness, material.metallic)} == {np.dtype("f4")}
        assert max(material.base_color.size // 3, material.roughness.size) <= 256**2
    corners = triangles(asset)
    assert np.einsum("fk,fk->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0
    assert corners[..., 1].min() == 0
    assert 0.2 < np.ptp(corners.reshape(-1, 3), axis=0).max() < 4
    assert 1 <= len(asset.parts) <= 6
    assert 60 <= len(corners) <= 9000


@every_asset
def test_every_part_touches_the_rest(asset):
    ndimage = pytest.importorskip("scipy.ndimage")
    rng = np.random.default_rng(0)
    corners = triangles(asset)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = np.concatenate([rng.choice(len(area), 60_000, p=area / area.sum()), np.repeat(np.arange(len(area)), 3)])
    weights = rng.dirichlet((1, 1, 1), len(chosen))
    samples = np.concatenate([np.einsum("nc,nck->nk", weights, corners[chosen]), corners.reshape(-1, 3)])
    low = samples.min(axis=0)
    voxels = ((samples - low) / np.ptp(samples, axis=0).max() * PIXELS).astype(int)
    filled = np.zeros(voxels.max(axis=0) + 1, bool)
    filled[tuple(voxels.T)] = True
    _, components = ndimage.label(filled, np.ones((3, 3, 3)))
    assert components == 1


@pytest.mark.parametrize("category", CATEGORIES)
def test_a_seed_gives_the_same_bytes_again_and_other_seeds_other_shapes_and_colours(category):
    assert content(make(category, 3)) == content(made(category, 3))
    assert len({content(made(category, seed)) for seed in SEEDS}) == len(SEEDS)
    shapes = {tuple(np.ptp(triangles(made(category, seed)).reshape(-1, 3), axis=0).round(4)) for seed in SEEDS}
    assert len(shapes) == len(SEEDS)
