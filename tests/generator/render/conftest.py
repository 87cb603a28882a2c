"""Every file of these tests renders with scalar code on one thread, whatever a test before it has chosen.

Variant and thread count belong to the process, and with them the random numbers of a picture.
"""

import pytest

from data_gen.render.variant import SCALAR, mitsuba_module


@pytest.fixture(scope="module", autouse=True)
def scalar_code():
    """The variant that runs everywhere."""
    mitsuba_module(SCALAR)
