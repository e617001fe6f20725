"""Renders the viewer's picture coarse to fine, in sizes that the machine's speed allows, and smooth in each.

nerfstudio itself renders twice: first for a thirtieth of a second, which on a CPU gives a mosaic of 38×30 pixels, then
in full size, which takes half a minute on a CPU.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from nerfstudio.viewer.render_state_machine import RenderAction, RenderStateMachine
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO

from edge_depth_nerf.plugin.detail import detail_shown

if TYPE_CHECKING:
    import viser
    from nerfstudio.viewer.utils import CameraState
    from nerfstudio.viewer.viewer import Viewer

BUDGETS: dict[str, tuple[float, int]] = {"low_move": (0.15, 60), "low_static": (1.0, 100), "middle": (3.0, 160)}
"""For each step before the last: its largest time in seconds, and its least height in px."""
FIRST_RAYS_PER_S = 10_000.0
"""Assumed speed of the machine before the first rendering."""
ASPECT_TOLERANCE = 0.01
"""A finished picture is rendered again if the aspect ratio of the browser's window changes by a larger share."""
FINER = 1.3
"""A second picture of the middle step is this much higher at least."""
POSE_TOLERANCE = 1e-5
"""Of rotation and position (scene units): what a pose may lose on its way to the browser and back."""
LONGEST_START_S = 5.0
"""A browser that still reports its own first view by then is there."""
SHOWN_PX = 512
"""Smaller pictures are enlarged to this height. Otherwise the browser draws their pixels as squares."""


class CoarseToFine(RenderStateMachine):
    """Chooses what a browser receives: a coarse picture while the camera moves, then finer ones."""

    def __init__(
        self, viewer: Viewer, client: viser.ClientHandle, shows_detail: Callable[[], bool] = lambda: False
    ) -> None:
        """Render for one browser; nothing is rendered before `begin`.

        `shows_detail` says whether complete pictures are to have the detail of training pictures.
        """
        super().__init__(viewer, VISER_NERFSTUDIO_SCALE_RATIO, client)
        self._moves: dict[str, dict[str, str]] = self.transitions  # pyrefly: ignore[bad-assignment]
        self._moves["low_static"]["static"] = "middle"
        self._moves["middle"] = {"static": "high", "step": "high", "move": "low_move", "rerender": "low_static"}
        self._shows_detail = shows_detail
        self._rays_per_s = FIRST_RAYS_PER_S
        self._is_rendering = False
        self._requested: CameraState | None = None
        self._first: CameraState | None = None
        self._first_until_s = -math.inf
        self._rendered: CameraState | None = None

    def begin(self, first: CameraState) -> None:
        """Start with the view that the browser was just sent to.

        `first` is the browser's own view, which it reports some more times before it goes where it was sent.
        """
        self._first, self._first_until_s = first, time.monotonic() + LONGEST_START_S
        self._requested = self.viewer.get_camera_state(self.client)
        super().action(RenderAction("rerender", self._requested))
        self.start()

    def action(self, action: RenderAction) -> None:
        """Record an event. A movement stops the rendering of a finer picture.

        The browser also reports a movement when only its window or side panel changes its size, for seconds while the
        page opens. That is no movement: the next finer picture gets the new aspect ratio, and a finished one is
        rendered again, without a coarse one in between. A movement that changes nothing at all is nerfstudio's way to
        ask for a picture with other settings; only while a page opens, browsers report such movements too.
        """
        if self._is_late(action.camera_state):
            # the resting machine asks where the browser is; whatever else was reported is out of date
            if action.action != "static" or self._requested is None:
                return
            action = RenderAction("static", replace(self._requested, aspect=action.camera_state.aspect))
        if action.action == "move":
            before, self._requested = self._requested, action.camera_state
            waiting = self.next_action is not None and self.next_action.action in ("move", "rerender")
            if before is not None and not waiting and self._stays(before, action.camera_state):
                action = RenderAction("static", action.camera_state)
        if action.action == "static" and self.state == "high" and self._rendered is not None:
            change = action.camera_state.aspect / self._rendered.aspect - 1
            if abs(change) > ASPECT_TOLERANCE:
                action = RenderAction("step", action.camera_state)
        super().action(action)
        # nerfstudio's own flag would also stop a rendering that has not started
        asked = self.next_action
        self.interrupt_render_flag = (
            self._is_rendering
            and self.state != "low_move"
            and asked is not None
            and asked.action in ("move", "rerender")
        )

    def _opens(self) -> bool:
        """Return whether the browser has only just connected."""
        return time.monotonic() < self._first_until_s

    def _is_late(self, camera_state: CameraState) -> bool:
        """Return whether this is still the view in which the browser opened, not that to which it was sent."""
        return self._first is not None and self._opens() and _same_view(self._first, camera_state)

    def _stays(self, before: CameraState, camera_state: CameraState) -> bool:
        """Return whether a reported movement is none, and no request for other settings."""
        reshaped = camera_state.aspect != before.aspect
        return _same_view(before, camera_state) and (reshaped or (self._opens() and self.state != "high"))

    def _render_img(self, camera_state: CameraState) -> dict[str, Any]:
        started = time.perf_counter()
        self._is_rendering, self._rendered = True, camera_state
        try:
            # a coarse picture has none, and is to come soon
            with_detail = self.state == "high" and self._shows_detail()
            with detail_shown(with_detail):
                outputs = super()._render_img(camera_state)
            if outputs["rgb"].is_cuda:
                # until here it was only asked for; waiting for all streams would spoil a recording
                torch.cuda.current_stream(outputs["rgb"].device).synchronize()
        finally:
            self._is_rendering = False
        rays = outputs["rgb"].shape[0] * outputs["rgb"].shape[1]
        if not with_detail:  # whose time is that of other pictures, too
            self._rays_per_s = rays / max(time.perf_counter() - started, 1e-6)
        if self.state == "middle":
            # small pictures underrate the machine: once more, if its time is now enough for a much finer one
            affordable, _ = self._calculate_image_res(camera_state.aspect)
            again = affordable > FINER * outputs["rgb"].shape[0]
            self._moves["middle"]["static"] = "middle" if again else "high"
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


def _same_view(a: CameraState, b: CameraState) -> bool:
    """Return whether two cameras differ at most in their aspect ratio."""
    return torch.allclose(a.c2w, b.c2w, atol=POSE_TOLERANCE) and (a.fov, a.camera_type, a.time) == (
        b.fov,
        b.camera_type,
        b.time,
    )


def _enlarged(values: Any, size: tuple[int, int]) -> Any:
    """Enlarge an output, H×W×C, smoothly."""
    dtype = values.dtype
    channels_first = values.float().permute(2, 0, 1)[None]
    return F.interpolate(channels_first, size, mode="bilinear", align_corners=False)[0].permute(1, 2, 0).to(dtype)


def render_coarse_to_fine(
    viewer: Viewer, client: viser.ClientHandle, first: CameraState, shows_detail: Callable[[], bool]
) -> None:
    """Serve a new browser with `CoarseToFine`, which was sent away from its `first` view."""
    before = viewer.render_statemachines[client.client_id]
    # an idle machine checks its flag only after a rendering, or if its picture is complete
    before.state, before.running = "high", False
    machine = CoarseToFine(viewer, client, shows_detail)
    viewer.render_statemachines[client.client_id] = machine
    machine.begin(first)
