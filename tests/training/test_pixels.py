"""Some of the pixels of a batch: pictures, conditions and rays stay those of the same pixels."""

import jax
import numpy as np
from support.laws import close, same_bits
from support.tiny_model import SIZE
from support.tiny_training import BATCH

from spnr_jax.kernels import cameras
from spnr_jax.training import pixels


class TestLattice:
    def test_is_every_so_many_th_pixel_of_picture_condition_and_rays(self):
        made, firsts = jax.jit(pixels.lattice, static_argnums=2), set()
        whole = cameras.camera_rays(BATCH.camera).directions
        for seed in range(6):
            thin = made(jax.random.key(seed), BATCH, 4)
            assert thin.image.shape == (2, 1, SIZE // 4, SIZE // 4, 3)
            rays = cameras.camera_rays(thin.camera).directions
            distance = np.abs(np.asarray(whole[0, 0]) - np.asarray(rays[0, 0, 0, 0])).sum(-1)
            row, column = np.unravel_index(distance.argmin(), distance.shape)
            assert max(row, column) < 4
            firsts.add((row, column))
            close(rays, whole[:, :, row::4, column::4], atol=1e-6)
            for name in ("image", "condition", "condition_mask"):
                same_bits(getattr(thin, name), getattr(BATCH, name)[:, :, row::4, column::4])
            same_bits(thin.cloud, BATCH.cloud)
        assert len(firsts) > 3, "another first pixel for another key"

    def test_its_opacity_is_that_of_the_same_pixels(self):
        thinned = pixels.lattice(jax.random.key(3), BATCH, 3)
        # the balls are opaque where they are not white
        same_bits(thinned.alpha > 0, (thinned.image != 1).any(axis=-1))
        assert thinned.alpha.shape == thinned.image.shape[:-1]


class TestCrop:
    def test_a_crop_is_a_square_of_picture_condition_and_rays(self):
        firsts = set()
        made, whole = jax.jit(pixels.cropped, static_argnums=2), cameras.camera_rays(BATCH.camera).directions
        for seed in range(6):
            crop = made(jax.random.key(seed), BATCH, 10)
            rays = cameras.camera_rays(crop.camera).directions
            assert crop.image.shape == (*BATCH.image.shape[:2], 10, 10, 3)
            distance = np.abs(np.asarray(whole[0, 0]) - np.asarray(rays[0, 0, 0, 0])).sum(-1)
            row, column = np.unravel_index(distance.argmin(), distance.shape)
            firsts.add((row, column))
            inside = np.s_[:, :, row : row + 10, column : column + 10]
            close(rays, whole[inside], atol=1e-6)
            for name in ("image", "alpha", "condition", "condition_mask"):
                same_bits(getattr(crop, name), getattr(BATCH, name)[inside])
            same_bits(crop.cloud, BATCH.cloud)
        assert len(firsts) > 3, "another place for another key"

    def test_a_crop_as_large_as_the_view_is_the_view(self):
        same_bits(pixels.cropped(jax.random.key(0), BATCH, BATCH.image.shape[2]), BATCH)
