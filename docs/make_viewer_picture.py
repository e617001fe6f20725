"""Take the picture of docs/films.md: the viewer of a trained model, in a browser without a window.

python docs/make_viewer_picture.py --load-config outputs/sample_drive/edge-depth-nerf-lite/DATE/config.yml

The scene is copied without its `.cache`, so that what earlier trainings left there is not seen. It needs Chromium and
Playwright (`pip install playwright`). What is seen depends on the training; the picture in the repository is of the
rendered street of docs/results.md (ours, 1,000 steps), with `detail: true` in its config.yml.
"""

from __future__ import annotations

import argparse
import shutil
import socket
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parents[1]
SIZE_PX = (1000, 640)
BEHIND_M, ABOVE_M, AHEAD_M = 2.2, 1.6, 4.0
"""Where the browser looks from, as seen from the drive's middle, and how far ahead it looks."""
TIMEOUT_S = 120
ARGUMENTS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""Chromium's: as root, and WebGL by software."""


def take_picture(load_config: Path, output: Path) -> None:
    """Write the page as a JPEG, with the lenses, the path and the LiDAR points."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        sys.exit("No Chromium on this machine (Debian: apt-get install chromium).")
    with tempfile.TemporaryDirectory() as folder:

        def of_a_copy(config: TrainerConfig) -> TrainerConfig:
            datamanager: Any = config.pipeline.datamanager
            scene = Path(datamanager.data or datamanager.dataparser.data)
            datamanager.data = shutil.copytree(
                scene, Path(folder) / scene.name, ignore=shutil.ignore_patterns(".cache")
            )
            return config

        config, pipeline, _, step = eval_setup(load_config, test_mode="test", update_config_callback=of_a_copy)
        dataset, settings = pipeline.datamanager.train_dataset, config.viewer
        assert dataset is not None
        settings.websocket_host, settings.default_composite_depth = "127.0.0.1", False
        with socket.socket() as probe:
            probe.bind((settings.websocket_host, 0))
            settings.websocket_port = probe.getsockname()[1]
        viewer = Viewer(settings, Path(folder) / "log.txt", pipeline.datamanager.get_datapath(), pipeline)
        viewer.init_scene(dataset, "completed")
        viewer.update_scene(step)
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
            # where WebGL is slow, the page goes down to a fifth of the screen's resolution
            page = browser.new_page(viewport={"width": SIZE_PX[0], "height": SIZE_PX[1]}, device_scale_factor=3)
            page.set_default_timeout(TIMEOUT_S * 1000)  # drawing by software keeps the page busy
            page.goto(f"http://127.0.0.1:{settings.websocket_port}")
            page.wait_for_selector("text=Output type")
            for layer in ("LiDAR points", "Lenses"):
                page.get_by_label(layer).click()
            page.mouse.move(10, 300)
            look_along_the_drive(viewer, dataset)
            deadline = time.monotonic() + TIMEOUT_S
            while "512" not in viewer.stats_markdown.content and time.monotonic() < deadline:
                page.wait_for_timeout(1000)
            page.wait_for_timeout(5000)
            page.screenshot(path=output, type="jpeg", quality=80, scale="css")
            browser.close()
        viewer.viser_server.stop()


def look_along_the_drive(viewer: Viewer, dataset: InputDataset) -> None:
    """Place the browser's camera behind and above the middle of the drive."""
    places = dataset.cameras.camera_to_worlds[:, :, 3].double().numpy()
    ahead = places[-1] - places[0]
    ahead = ahead / np.linalg.norm(ahead)
    transform = dataset._dataparser_outputs.dataparser_transform.double().numpy()
    up, units_per_metre = transform[:, 2], VISER_NERFSTUDIO_SCALE_RATIO / dataset.metadata["metres_per_unit"]
    middle = places.mean(0) * VISER_NERFSTUDIO_SCALE_RATIO
    for client in viewer.viser_server.get_clients().values():
        client.camera.position = tuple(middle + units_per_metre * (ABOVE_M * up - BEHIND_M * ahead))
        client.camera.look_at = tuple(middle + units_per_metre * AHEAD_M * ahead)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Take the picture of docs/films.md.")
    parser.add_argument("--load-config", type=Path, required=True, help="config.yml of a training")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "viewer.jpg", help="the picture")
    given = parser.parse_args()
    take_picture(given.load_config, given.output)
