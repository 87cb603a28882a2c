"""What training minimises: closed forms; tests/laws has the twins."""

import pytest
from support import reference
from support.laws import close, numbers

from spnr_jax.kernels.losses import area_downsample


@pytest.mark.parametrize(("size", "new"), [((8, 8), 4), ((10, 10), 4), ((3, 3), 3), ((2, 2), 3)])
def test_pixels_of_another_size_are_the_mean_over_cells_for_any_ratio(size, new):
    image = numbers(6, *size, 3)
    close(area_downsample(image, new), reference.area_downsample(image, new))
