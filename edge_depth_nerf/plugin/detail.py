"""Adds to rendered views what training pictures show beyond their own renderings.

Host-facing; the formulas stand in `method.detail`. A training picture is rendered when a view near it first needs it,
and its detail is kept until the model changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from edge_depth_nerf.method.detail import Detail, carried, detail_of, pictures_that_see
from edge_depth_nerf.plugin.pose_refinement import moved_pose

if TYPE_CHECKING:
    from edge_depth_nerf.plugin.dataset import FisheyeDepthDataset

PICTURES = 8
"""So many training pictures, those that see most of a view, add their detail to it."""
CONSIDERED = 64
"""The pictures that are compared for it: so many, the nearest."""
MOST_BYTES = 1 << 30
"""Details in memory, all together; one more than a view needs at least."""
BYTES_A_PIXEL = 8
_shown: ContextVar[bool | None] = ContextVar("detail_shown", default=None)


@contextmanager
def with_appearance_of(field: Any, picture: int) -> Iterator[None]:
    """Let a field that has nerfacto's appearance embedding look as a training picture."""
    embedding: Any = field.embedding_appearance
    if embedding is None:
        yield
        return
    averages = field.use_average_appearance_embedding
    try:
        # what both forms of the field ask for at evaluation
        embedding.mean = lambda dim: embedding.embedding.weight[picture]
        field.use_average_appearance_embedding = True
        yield
    finally:
        vars(embedding).pop("mean", None)
        field.use_average_appearance_embedding = averages


@contextmanager
def detail_shown(shown: bool) -> Iterator[None]:
    """Render views with or without detail, whatever the configuration says; in this thread."""
    token = _shown.set(shown)
    try:
        yield
    finally:
        _shown.reset(token)


class TrainingDetail:
    """The detail of a model's training pictures."""

    def __init__(self, model: Any, dataset: FisheyeDepthDataset) -> None:
        self.model, self.dataset = model, dataset
        pixels = int((dataset.cameras.width * dataset.cameras.height).max())
        self.kept = max(PICTURES + 1, MOST_BYTES // (BYTES_A_PIXEL * pixels))
        """So many pictures' detail is kept, that which was used last."""
        self.of_picture = lru_cache(self.kept)(self._of_picture)

    @property
    def is_shown(self) -> bool:
        """Say whether views are rendered with detail, by `detail_shown` or the configuration."""
        shown = _shown.get()
        return self.model.config.detail if shown is None else shown

    def forget(self) -> None:
        """Forget what was kept: the model is no longer what rendered it."""
        if self.of_picture.cache_info().currsize:
            self.of_picture.cache_clear()

    def of_view(self, rays: RayBundle, distance: Float[Tensor, "*rays 1"]) -> Float[Tensor, "*rays 3"]:
        """Look up what is to be added to the colours of a view's rays, which end at `distance`, scene units.

        The rays are from one place or nearly so. What is given lies on the distance's device.
        """
        device = self.model.device
        origins, directions = (each.reshape(-1, 3).to(device) for each in (rays.origins, rays.directions))
        flat = distance.reshape(-1).to(device)
        poses = self._poses()
        away = (poses[:, :, 3] - origins.mean(dim=0)).norm(dim=-1)
        near = away.argsort(stable=True)[:CONSIDERED].tolist()
        lenses = [(self.dataset.pictures[picture].lens, poses[picture]) for picture in near]
        chosen = pictures_that_see(origins, directions, flat, lenses, PICTURES)
        found = carried(origins, directions, flat, [self.of_picture(near[number]) for number in chosen])
        return found.view(*distance.shape[:-1], 3).to(distance)

    def _poses(self) -> Float[Tensor, "pictures 3 4"]:
        """Give the poses of the training pictures, as training has moved them."""
        poses = self.dataset.cameras.camera_to_worlds.to(self.model.device)
        optimizer = self.model.camera_optimizer
        if optimizer.config.mode == "off":
            return poses
        with torch.no_grad():
            return moved_pose(poses, optimizer(torch.arange(len(poses), device=poses.device)))

    def _of_picture(self, number: int) -> Detail:
        """Render a training picture where its camera was, and take what it shows beyond that."""
        model = self.model
        image = torch.from_numpy(self.dataset.rgb(number)).to(model.device).float() / 255
        usable = torch.from_numpy(self.dataset.mask(number)).to(model.device)
        camera = self.dataset.cameras[number : number + 1].to(model.device)
        camera.camera_to_worlds = self._poses()[number : number + 1]
        with torch.no_grad(), with_appearance_of(model.field, number):
            outputs = model.rendered_alone(camera)
            rgb, distance = outputs["rgb"].to(model.device), outputs["depth"][..., 0].to(model.device)
            beyond = image - rgb if model.exposure is None else model.exposure.beyond(image, rgb, number)
        return detail_of(
            self.dataset.pictures[number].lens, camera.camera_to_worlds[0], image, beyond, distance, usable
        )
