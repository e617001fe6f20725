"""A browser for tests of pages: Debian's Chromium or Google's Chrome, driven by Playwright; never downloaded."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

SOFTWARE_WEBGL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PROGRAMS = ("chromium", "chromium-browser", "google-chrome")


@contextmanager
def open_browser() -> Iterator[Any]:
    """A Playwright browser; skips the test that asks where Playwright or a browser is missing."""
    api = pytest.importorskip("playwright.sync_api", reason="Playwright is missing (pip install playwright)")
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        pytest.skip("no browser (Debian: apt-get install chromium)")
    # with --fast, where no program is started, this skips the test; within Playwright nobody would hear of it
    subprocess.run([program, "--version"], stdout=subprocess.DEVNULL, check=True)
    # Chromium's sandbox does not start as root
    arguments = [*SOFTWARE_WEBGL, *(["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else [])]
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=arguments)
        try:
            yield browser
        finally:
            browser.close()
