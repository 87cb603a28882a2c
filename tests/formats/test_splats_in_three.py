"""Files of splats in three.js, in a headless Chromium: what it reads is what was written, and it draws them as we do.

Without a Chromium and npm's three (support/three_js.py) these tests are skipped.
"""

import io

import numpy as np
import pytest
from PIL import Image
from support import chromium as chromium_of
from support import splat_balls, three_js

from spnr_jax.formats import gaussian_files
from spnr_jax.gaussians import drawing
from spnr_jax.gaussians.harmonics import C0

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")

SIZE = 200
pytestmark = [chromium_of.needed, three_js.needed_with_splats, pytest.mark.ci]  # it opens a browser
SCRIPT = """
import * as THREE from "three/webgpu";
import { GLTFLoader } from "add/loaders/GLTFLoader.js";
import { GLTFGaussianSplatLoaderExtension } from "add/loaders/GLTFGaussianSplatLoaderExtension.js";
import { GaussianSplatPLYLoader } from "add/loaders/GaussianSplatPLYLoader.js";
const loader = new GLTFLoader(), world = new THREE.Scene(), found = [];
loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
(await loader.loadAsync("/ball.glb")).scene.traverse((node) => { if (node.isGaussianSplat) found.push(node); });
const read = { glb: found[0].splatGeometry, ply: await new GaussianSplatPLYLoader().loadAsync("/ball.ply") };
for (const [name, { attributes }] of Object.entries(read))
  read[name] = Object.fromEntries(Object.entries(attributes).map(([key, values]) => [key, Array.from(values.array)]));
const renderer = new THREE.WebGPURenderer({ forceWebGL: true, antialias: false });
await renderer.init();
renderer.setSize(SIZE, SIZE);
renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // colours are shown as they stand in the file
document.body.style.margin = 0;
document.body.append(renderer.domElement);
const camera = new THREE.PerspectiveCamera(VIEW, 1, 0.1, 100);
camera.position.set(...EYE);
camera.lookAt(0, 0, 0);
world.background = new THREE.Color(0xffffff);
world.add(found[0]);
for (let i = 0; i < 3; i++) {
  renderer.render(world, camera);
  await new Promise(requestAnimationFrame);
}
window.shown = { read, splats: found.length };
"""


@pytest.fixture(scope="module")
def splats():
    return splat_balls.ball(2000)


@pytest.fixture(scope="module")
def shown(splats):
    """What three.js reads in both files, its picture of the .glb, and what the console says."""
    eye = np.asarray(splat_balls.camera().cam_to_world)[:, 3]
    script = SCRIPT.replace("SIZE", str(SIZE)).replace("EYE", str(eye.tolist()))
    script = script.replace("VIEW", str(float(np.rad2deg(splat_balls.FIELD_OF_VIEW))))
    files = {"/ball.glb": gaussian_files.glb_of(splats, "a ball"), "/ball.ply": gaussian_files.ply_of(splats, "a ball")}
    with three_js.run(playwright, script, files, SIZE) as (tab, said):
        found = tab.evaluate("window.shown")
        tab.wait_for_timeout(500)
        picture = np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB")) / np.float32(255)
    return found | {"picture": picture, "said": [line for line in said if "WebGPU" not in line]}


@pytest.mark.parametrize("kind", ["glb", "ply"])
def test_three_reads_places_shapes_colours_and_opacities_as_they_were_written(shown, splats, kind):
    read = {name: np.array(values) for name, values in shown["read"][kind].items()}
    wanted = splats if kind == "glb" else gaussian_files.turned(splats)
    axes = np.asarray(drawing.rotations(wanted.rotation)) * wanted.scale[:, None, :]
    shape = np.einsum("nij,nkj->nik", axes, axes)[:, *np.triu_indices(3)]
    color = np.concatenate([0.5 + C0 * wanted.harmonics[:, 0], wanted.opacity[:, None]], axis=1)
    np.testing.assert_allclose(read["position"].reshape(-1, 3), wanted.position, atol=1e-6)
    np.testing.assert_allclose(read["covariance"].reshape(-1, 6), shape, atol=1e-7)
    np.testing.assert_allclose(read["color"].reshape(-1, 4) / 255, np.clip(color, 0, 1), atol=1 / 255)
    words = read["sphericalHarmonics1"].astype(np.uint32)[:, None] >> np.array([0, 8, 16, 24]) & 255
    rest = (words.reshape(2000, -1)[:, :9].astype(float) - 128) / 128
    np.testing.assert_allclose(rest, np.clip(wanted.harmonics[:, 1:].reshape(2000, 9), -1, 1), atol=1 / 128)


def test_three_draws_the_glb_as_we_draw_its_splats_and_says_nothing(shown, splats):
    ours, _ = drawing.draw(splats, splat_balls.camera(size=SIZE), dilation=0.3)
    assert shown["splats"] == 1
    assert shown["said"] == []
    assert -10 * np.log10(np.mean((shown["picture"] - ours) ** 2)) > 24
    assert -10 * np.log10(np.mean((1 - ours) ** 2)) < 16
