"""Renders the viewer's picture coarse to fine, in sizes that the machine's speed allows, and smooth in each.

nerfstudio itself renders twice: first for a thirtieth of a second, which on a CPU gives a mosaic of 38×30 pixels, then
in full size, which takes half a minute on a CPU.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from nerfstudio.viewer.render_state_machine import RenderAction, RenderStateMachine
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO

if TYPE_CHECKING:
    import viser
    from nerfstudio.viewer.utils import CameraState
    from nerfstudio.viewer.viewer import Viewer

BUDGETS: dict[str, tuple[float, int]] = {"low_move": (0.15, 60), "low_static": (1.0, 100), "middle": (3.0, 160)}
"""For each step before the last: its largest time in seconds, and its least height in px."""
FIRST_RAYS_PER_S = 10_000.0
"""Assumed speed of the machine before the first rendering."""
SHOWN_PX = 512
"""Smaller pictures are enlarged to this height. Otherwise the browser draws their pixels as squares."""


class CoarseToFine(RenderStateMachine):
    """Chooses what a browser receives: a coarse picture while the camera moves, then three finer ones."""

    def __init__(self, viewer: Viewer, client: viser.ClientHandle) -> None:
        """Render for one browser; nothing is rendered before `start`."""
        super().__init__(viewer, VISER_NERFSTUDIO_SCALE_RATIO, client)
        moves: dict[str, dict[str, str]] = self.transitions  # pyright: ignore[reportAssignmentType]
        moves["low_static"]["static"] = "middle"
        moves["middle"] = {"static": "high", "step": "high", "move": "low_move", "rerender": "low_static"}
        self._rays_per_s = FIRST_RAYS_PER_S
        self._is_rendering = False

    def action(self, action: RenderAction) -> None:
        """Record an event. A movement stops the rendering of a finer picture."""
        super().action(action)
        # nerfstudio's own flag would also stop a rendering that has not started
        asked = self.next_action
        self.interrupt_render_flag = (
            self._is_rendering
            and self.state != "low_move"
            and asked is not None
            and asked.action in ("move", "rerender")
        )

    def _render_img(self, camera_state: CameraState) -> dict[str, Any]:
        started = time.perf_counter()
        self._is_rendering = True
        try:
            outputs = super()._render_img(camera_state)
            if outputs["rgb"].is_cuda:
                torch.cuda.synchronize(outputs["rgb"].device)  # until here it was only asked for
        finally:
            self._is_rendering = False
        rays = outputs["rgb"].shape[0] * outputs["rgb"].shape[1]
        self._rays_per_s = rays / max(time.perf_counter() - started, 1e-6)
        return outputs

    def _calculate_image_res(self, aspect_ratio: float) -> tuple[int, int]:
        """Height and width of the step's picture, px."""
        if self.state == "high":
            return super()._calculate_image_res(aspect_ratio)
        seconds, least_px = BUDGETS[self.state]
        largest_px = self.viewer.control_panel.max_res
        height = max((seconds * self._rays_per_s / aspect_ratio) ** 0.5, least_px)
        height = max(min(height, largest_px, largest_px / aspect_ratio), 1.0)
        return round(height), max(round(height * aspect_ratio), 1)

    def _send_output_to_viewer(self, outputs: dict[str, Any], static_render: bool = True) -> None:
        height, width = outputs["rgb"].shape[:2]
        if height < SHOWN_PX:
            size = (SHOWN_PX, round(SHOWN_PX * width / height))
            outputs = {name: _enlarged(values, size) for name, values in outputs.items()}
        super()._send_output_to_viewer(outputs, static_render)
        # the rendered size and the model's step; nerfstudio itself updates them only during a training
        self.viewer.stats_markdown.content = self.viewer.make_stats_markdown(self.viewer.step, f"{width}x{height}px")


def _enlarged(values: Any, size: tuple[int, int]) -> Any:
    """Enlarge an output, H×W×C, smoothly."""
    dtype = values.dtype
    channels_first = values.float().permute(2, 0, 1)[None]
    return F.interpolate(channels_first, size, mode="bilinear", align_corners=False)[0].permute(1, 2, 0).to(dtype)


def render_coarse_to_fine(viewer: Viewer, client: viser.ClientHandle) -> None:
    """Serve a new browser with `CoarseToFine`."""
    before = viewer.render_statemachines[client.client_id]
    # an idle machine checks its flag only after a rendering, or if its picture is complete
    before.state, before.running = "high", False
    machine = CoarseToFine(viewer, client)
    viewer.render_statemachines[client.client_id] = machine
    machine.start()
