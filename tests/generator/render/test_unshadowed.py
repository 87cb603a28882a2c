"""Pictures without shadows: right where nothing could be shadowed, never darker than with shadows elsewhere."""

import numpy as np
import pytest
from support.handmade import ball, checked_box_and_ball, plain

from data_gen.render import unshadowed, views
from data_gen.render.variant import LLVM, SCALAR, choose_variant, mitsuba_module
from spnr_jax.formats.mesh.assets import Asset
from spnr_jax.surfels import skies

VIEW = views.ViewConfig(resolution=24, spp=256, max_depth=2)
POSE = views.look_at(np.array([1.0, 1.0, 2.6]))


def test_scalar_code_is_refused_in_a_line():
    scene = views.build_scene(Asset(parts=(ball(),)), skies.studio(16))
    with pytest.raises(ValueError, match="llvm_ad_rgb; install LLVM"):
        unshadowed.render_unshadowed(scene, POSE, VIEW, 0)


@pytest.fixture
def compiled(scalar_code):
    """Mitsuba's compiled code, for one test."""
    if choose_variant()[0] != LLVM:
        pytest.skip("no usable LLVM library")
    mitsuba_module(LLVM)
    yield
    mitsuba_module(SCALAR)


def drawn(asset):
    """With one bounce and shadows, without shadows, with ambient occlusion: radiance where the object is."""
    scene = views.build_scene(asset, skies.normalised(skies.studio(64)))
    path = views.render_view(scene, POSE, VIEW, 0)
    bare, occluded = (unshadowed.render_unshadowed(scene, POSE, VIEW, 0, occlusion) for occlusion in (False, True))
    np.testing.assert_allclose(bare[..., 3], path[..., 3], atol=0.1)
    solid = path[..., 3] > 0.999
    return [picture[solid][:, :3] for picture in (path, bare, occluded)]


@pytest.mark.ci
def test_a_ball_has_no_shadows(compiled):
    path, bare, occluded = drawn(Asset(parts=(ball(radius=0.7, material=plain((0.6, 0.3, 0.2), 0.4), rows=24),)))
    for picture in (bare, occluded):
        np.testing.assert_allclose(picture.mean(axis=0), path.mean(axis=0), rtol=0.02)
    assert np.abs(bare - path).mean() < 0.02 * path.mean()


@pytest.mark.ci
def test_what_stands_close_together_is_darker_with_shadows_and_with_occlusion(compiled):
    path, bare, occluded = drawn(checked_box_and_ball())
    assert path.mean() < 0.99 * bare.mean()
    assert occluded.mean() < 0.99 * bare.mean()
    assert (bare - path).min() > -0.1
