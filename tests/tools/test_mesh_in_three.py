"""A surface of `spnr render --mesh` in three.js, in a headless Chromium: one mesh, its colours and its materials.

Chromium and npm's three are found where they are installed (or named by SPNR_CHROMIUM and SPNR_THREE, the folder of the
package); without them these tests are skipped.
"""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support import chromium as chromium_of
from support.solid_ball import RADIUS, ball_cloud, ball_grid

from spnr_jax.tools.mesh_export import mesh_of

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")

SIZE = 96
ORIGIN = "http://page.test"
PAGE = """<!doctype html><link rel="icon" href="data:,"><script type="importmap">{"imports":
{"three": "/three/build/three.module.js", "loaders": "/three/examples/jsm/loaders/GLTFLoader.js"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "loaders";
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
</script>"""


def three() -> Path | None:
    """The folder of npm's three, where it is installed."""
    if named := os.environ.get("SPNR_THREE"):
        return Path(named)
    npm = shutil.which("npm")
    found = (
        npm and subprocess.run([npm, "root", "--global"], capture_output=True, text=True, check=False).stdout.strip()
    )
    return Path(found) / "three" if found and (Path(found) / "three").is_dir() else None


THREE = three()
pytestmark = [
    chromium_of.needed,
    pytest.mark.skipif(THREE is None, reason="no three in npm's global folder or SPNR_THREE: npm install -g three"),
]


@pytest.fixture(scope="module")
def shown():
    """What three.js says of the ball's file, and how it draws it."""
    content = mesh_of(ball_grid(), ball_cloud()).content
    page = PAGE.replace("SIZE", str(SIZE)).replace("RADIUS", str(RADIUS))

    def answered(route):
        path = route.request.url.removeprefix(ORIGIN)
        if path.startswith("/three/"):
            route.fulfill(path=THREE / path.removeprefix("/three/"), content_type="text/javascript")
        elif path == "/ball.glb":
            route.fulfill(body=content, content_type="model/gltf-binary")
        else:
            route.fulfill(body=page, content_type="text/html")

    with chromium_of.launched(playwright) as browser:
        tab, said = browser.new_page(), []
        tab.on("console", lambda line: said.append(line.text) if line.type in ("error", "warning") else None)
        tab.on("pageerror", lambda error: said.append(str(error)))
        tab.route(ORIGIN + "/**", answered)
        tab.goto(ORIGIN)
        tab.wait_for_function("window.shown", timeout=60_000)
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
