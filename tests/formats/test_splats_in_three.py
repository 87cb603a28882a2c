"""Files of splats in three.js, in a headless Chromium: what it reads is what was written.

Without a Chromium and npm's three (support/three_js.py) these tests are skipped.
"""

import numpy as np
import pytest
from support import chromium as chromium_of
from support import splat_balls, three_js

from spnr_jax.formats import gaussian_files
from spnr_jax.surfels.gaussians import C0, rotations

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")

pytestmark = [chromium_of.needed, three_js.needed_with_splats, pytest.mark.ci]  # it opens a browser
SCRIPT = """
import { SPZLoader } from "add/loaders/SPZLoader.js";
import { GaussianSplatPLYLoader } from "add/loaders/GaussianSplatPLYLoader.js";
const read = { spz: await new SPZLoader().loadAsync("/ball.spz"),
               ply: await new GaussianSplatPLYLoader().loadAsync("/ball.ply") };
for (const [name, { attributes }] of Object.entries(read))
  read[name] = Object.fromEntries(Object.entries(attributes).map(([key, values]) => [key, Array.from(values.array)]));
window.shown = read;
"""


@pytest.fixture(scope="module")
def splats():
    return splat_balls.ball(500)


@pytest.fixture(scope="module")
def read(splats):
    """What three.js reads in both files, its console being silent."""
    files = {"/ball.spz": gaussian_files.spz_of(splats), "/ball.ply": gaussian_files.ply_of(splats, "a ball")}
    with three_js.run(playwright, SCRIPT, files, 64) as (tab, said):
        found = tab.evaluate("window.shown")
    assert not said
    return found


@pytest.mark.parametrize(("kind", "coarser"), [("spz", 1), ("ply", 0)])
def test_three_reads_places_shapes_colours_and_opacities_as_they_were_written(read, splats, kind, coarser):
    found = {name: np.array(values) for name, values in read[kind].items()}
    wanted = splats if kind == "spz" else gaussian_files.turn_half(splats)
    axes = rotations(wanted.rotation) * wanted.scale[:, None, :]
    shape = np.einsum("nij,nkj->nik", axes, axes)[:, *np.triu_indices(3)]
    color = np.concatenate([0.5 + C0 * wanted.harmonics[:, 0], wanted.opacity[:, None]], axis=1)
    np.testing.assert_allclose(found["position"].reshape(-1, 3), wanted.position, atol=1e-6 + 1e-6 * coarser)
    largest = np.abs(shape).max()
    np.testing.assert_allclose(found["covariance"].reshape(-1, 6), shape, atol=(1e-5 + 0.07 * coarser) * largest)
    np.testing.assert_allclose(
        found["color"].reshape(-1, 4) / 255, np.clip(color, 0, 1), atol=(1 + 0.6 * coarser) / 255
    )
    words = found["sphericalHarmonics1"].astype(np.uint32)[:, None] >> np.array([0, 8, 16, 24]) & 255
    rest = (words.reshape(len(color), -1)[:, :9].astype(float) - 128) / 128
    np.testing.assert_allclose(
        rest, np.clip(wanted.harmonics[:, 1:].reshape(-1, 9), -1, 1), atol=(1 + 4 * coarser) / 128
    )
