"""Take the picture of docs/quick_start.md: report.html in a browser without a window.

    python docs/make_report_picture.py outputs/demo/report.html

It needs Chromium and Playwright (`pip install playwright`).
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parents[1]
SIZE_PX = (1180, 900)


def take_picture(report: Path, output: Path) -> None:
    """Write the page's first screen as a JPEG: distances of nerfacto on the left, of ours on the right."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        sys.exit("No Chromium on this machine (Debian: apt-get install chromium).")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": SIZE_PX[0], "height": SIZE_PX[1]})
        page.goto(report.resolve().as_uri())
        page.screenshot(path=output, type="jpeg", quality=80)
        browser.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Take the picture of docs/quick_start.md.")
    parser.add_argument("report", type=Path, help="report.html of a finished `edge-depth-nerf demo`")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "report.jpg", help="the picture")
    given = parser.parse_args()
    take_picture(given.report, given.output)
