"""A headless Chromium for the tests of pages: found on PATH, or named by SPNR_CHROMIUM."""

import contextlib
import os
import shutil

import pytest

PATH = os.environ.get("SPNR_CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None
)
OPTIONS = (
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
)  # fmt: skip
needed = pytest.mark.skipif(PATH is None, reason="no Chromium on PATH: apt-get install chromium")


@contextlib.contextmanager
def launched(playwright):
    """The browser, closed at the end; `playwright` is the module playwright.sync_api."""
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=PATH, args=list(OPTIONS))
        yield browser
        browser.close()
