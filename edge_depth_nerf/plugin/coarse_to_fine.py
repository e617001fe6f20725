"""How the viewer's picture gets sharp on a CPU: in steps that a machine's speed allows, and smooth at each.

nerfstudio renders once for a thirtieth of a second, which on a CPU is a mosaic of 38×30 pixels, and then as large as it
may, which takes half a minute there.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import torch.nn.functional as F
from nerfstudio.viewer.render_state_machine import RenderAction, RenderStateMachine
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO

if TYPE_CHECKING:
    import viser
    from nerfstudio.viewer.utils import CameraState
    from nerfstudio.viewer.viewer import Viewer

BUDGETS: dict[str, tuple[float, int]] = {"low_move": (0.15, 60), "low_static": (1.0, 100), "middle": (3.0, 160)}
"""Of the steps before the last: seconds that one may take, and the height in px that it has in any case."""
FIRST_RAYS_PER_S = 10_000.0
"""Taken for the machine's speed before anything was rendered."""
SHOWN_PX = 512
"""Smaller pictures are enlarged to this height, lest the browser draw their pixels as squares."""


class CoarseToFine(RenderStateMachine):
    """Decides what a browser is sent: a rough picture while it moves, then three finer ones."""

    def __init__(self, viewer: Viewer, client: viser.ClientHandle) -> None:
        """Render for one browser; nothing is rendered before `start`."""
        super().__init__(viewer, VISER_NERFSTUDIO_SCALE_RATIO, client)
        moves: dict[str, dict[str, str]] = self.transitions  # pyright: ignore[reportAssignmentType]
        moves["low_static"]["static"] = "middle"
        moves["middle"] = {"static": "high", "step": "high", "move": "low_move", "rerender": "low_static"}
        self._rays_per_s = FIRST_RAYS_PER_S
        self._is_rendering = False

    def action(self, action: RenderAction) -> None:
        """Take note of what happened; a movement ends a finer picture that is being rendered."""
        super().action(action)
        # nerfstudio's own flag would also end a rendering that has not begun
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
        # the size that was rendered, and the step that the model is of: nerfstudio tells of it during trainings alone
        self.viewer.stats_markdown.content = self.viewer.make_stats_markdown(self.viewer.step, f"{width}x{height}px")


def _enlarged(values: Any, size: tuple[int, int]) -> Any:
    """Enlarge an output, H×W×C, smoothly."""
    dtype = values.dtype
    channels_first = values.float().permute(2, 0, 1)[None]
    return F.interpolate(channels_first, size, mode="bilinear", align_corners=False)[0].permute(1, 2, 0).to(dtype)


def render_coarse_to_fine(viewer: Viewer, client: viser.ClientHandle) -> None:
    """Let a browser that has just come be served by `CoarseToFine`."""
    before = viewer.render_statemachines[client.client_id]
    # what has nothing to do does not look at its flag before it has rendered once, unless its picture is done
    before.state, before.running = "high", False
    machine = CoarseToFine(viewer, client)
    viewer.render_statemachines[client.client_id] = machine
    machine.start()
