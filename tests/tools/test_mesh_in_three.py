"""A surface of `spnr render --mesh` in three.js, in a headless Chromium: one mesh, its colours and its materials.

Without a Chromium and npm's three (support/three_js.py) these tests are skipped.
"""

import numpy as np
import pytest
from support import chromium as chromium_of
from support import three_js
from support.solid_ball import RADIUS, ball_cloud, ball_grid

from spnr_jax.tools.mesh_export import mesh_of

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")

SIZE = 96
SCRIPT = """
import * as THREE from "three";
import { GLTFLoader } from "add/loaders/GLTFLoader.js";
const { scene } = await new GLTFLoader().loadAsync("/ball.glb"), meshes = [];
scene.traverse((node) => { if (node.isMesh) meshes.push(node); });
const [mesh] = meshes, own = mesh.material, size = SIZE;
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
renderer.setSize(size, size);
renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
const middle = new THREE.Box3().setFromObject(scene).getCenter(new THREE.Vector3());
const half = RADIUS, camera = new THREE.OrthographicCamera(-half, half, half, -half, 0.1, 100);
camera.position.copy(middle).add(new THREE.Vector3(0, 0, 10));
scene.add(new THREE.AmbientLight(0xffffff, Math.PI));
const drawn = (material) => {
  mesh.material = material;
  renderer.render(scene, camera);
  const pixels = new Uint8Array(4 * size * size), gl = renderer.getContext();
  gl.readPixels(0, 0, size, size, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return Array.from(pixels);
};
window.shown = {
  meshes: meshes.length, middle: middle.toArray(), vertexColors: own.vertexColors, sided: own.side,
  whole: drawn(own), color: drawn(new THREE.MeshBasicMaterial({ vertexColors: true })),
  shine: drawn(new THREE.MeshBasicMaterial({ map: own.metalnessMap })), same: own.metalnessMap === own.roughnessMap,
  factors: [own.roughness, own.metalness],
};
"""
pytestmark = [chromium_of.needed, three_js.needed, pytest.mark.ci]  # it opens a browser


@pytest.fixture(scope="module")
def shown():
    """What three.js says of the ball's file, and how it draws it."""
    content = mesh_of(ball_grid(), ball_cloud()).content
    script = SCRIPT.replace("SIZE", str(SIZE)).replace("RADIUS", str(RADIUS))
    with three_js.run(playwright, script, {"/ball.glb": content}, SIZE) as (tab, said):
        found = tab.evaluate("window.shown")
    found["said"] = [line for line in said if "GPU stall" not in line]  # what this test's reading of pixels costs
    for name in ("whole", "color", "shine"):
        found[name] = np.array(found[name]).reshape(SIZE, SIZE, 4)[::-1, :, :3] / 255
    return found


def sides(picture):
    """Mean colours of places on the right and on the left of the ball."""
    middle = slice(SIZE // 3, 2 * SIZE // 3)
    return picture[middle, -SIZE // 3 : -SIZE // 6].mean(axis=(0, 1)), picture[middle, SIZE // 6 : SIZE // 3].mean(
        axis=(0, 1)
    )


def test_three_finds_one_mesh_in_its_place_and_says_nothing(shown):
    assert shown["said"] == []
    assert shown["meshes"] == 1
    np.testing.assert_allclose(shown["middle"], [5, -3, 1], atol=0.05)


def test_three_draws_the_colours_and_roughness_and_metallic_of_the_points(shown):
    assert shown["vertexColors"]
    assert shown["same"]
    assert shown["factors"] == [1, 1]
    right, left = sides(shown["color"])
    np.testing.assert_allclose([right, left], [[1, 0, 0], [0, 0, 1]], atol=0.01)
    right, left = sides(shown["shine"])  # roughness in green, metallic in blue
    np.testing.assert_allclose([right[1:], left[1:]], [[1, 0], [0.25, 1]], atol=0.02)


def test_as_its_material_the_rough_side_is_lit_and_the_metal_one_dark_without_surroundings(shown):
    right, left = sides(shown["whole"])
    np.testing.assert_allclose(right, [1, 0, 0], atol=0.02)
    np.testing.assert_allclose(left, 0, atol=0.02)
