"""npm's three.js for the tests of files: found in npm's global folder, or named by SPNR_THREE, the package's folder."""

import contextlib
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from support import chromium

ORIGIN = "http://page.test"
HEAD = """<!doctype html><link rel="icon" href="data:,"><script type="importmap">{"imports": {
"three": "/three/build/three.module.js", "three/webgpu": "/three/build/three.webgpu.js",
"three/tsl": "/three/build/three.tsl.js", "add/": "/three/examples/jsm/"}}</script><script type="module">
"""
SPZ = Path("examples/jsm/loaders/SPZLoader.js")  # from r187 on


def folder() -> Path | None:
    """The folder of the package, where it is installed."""
    if named := os.environ.get("SPNR_THREE"):
        return Path(named)
    npm = shutil.which("npm")
    found = (
        npm and subprocess.run([npm, "root", "--global"], capture_output=True, text=True, check=False).stdout.strip()
    )
    return Path(found) / "three" if found and (Path(found) / "three").is_dir() else None


FOLDER = folder()
needed = pytest.mark.skipif(
    FOLDER is None, reason="no three in npm's global folder or SPNR_THREE: npm install -g three"
)

needed_with_splats = pytest.mark.skipif(
    FOLDER is None or not (FOLDER / SPZ).is_file(), reason="no three that reads .spz: npm install -g three@0.187"
)


@contextlib.contextmanager
def run(playwright, script: str, files: dict[str, bytes], size: int):
    """The tab, `size` pixels wide and high, in which a script has set window.shown, and what its console says."""

    def answered(route):
        path = route.request.url.removeprefix(ORIGIN)
        if path.startswith("/three/"):
            route.fulfill(path=FOLDER / path.removeprefix("/three/"), content_type="text/javascript")
        elif path in files:
            route.fulfill(body=files[path], content_type="application/octet-stream")
        else:
            route.fulfill(body=f"{HEAD}{script}</script>", content_type="text/html")

    with chromium.launched(playwright) as browser:
        tab, said = browser.new_page(viewport={"width": size, "height": size}), []
        tab.on("console", lambda line: said.append(line.text) if line.type in ("error", "warning") else None)
        tab.on("pageerror", lambda error: said.append(str(error)))
        tab.route(ORIGIN + "/**", answered)
        tab.goto(ORIGIN)
        tab.wait_for_function("window.shown", timeout=120_000)
        yield tab, said
