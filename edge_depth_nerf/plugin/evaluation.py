"""Figures of a rendered view, depth errors pooled over views, and a model as evaluation needs it.

Host-facing; formulas stand in `method.metrics`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.method.metrics import DepthErrors, load_lpips, masked_lpips, masked_psnr, masked_ssim


@contextmanager
def evaluated(model: Any) -> Iterator[None]:
    """Let a model in training be evaluated as after loading it, without any trace in the training."""
    sampler = model.proposal_sampler
    kept = {name: getattr(sampler, name) for name in ("_anneal", "_steps_since_update")}
    was_training = model.training
    model.eval()
    # what a loaded model has; a training reaches it after its first hundreds of steps
    sampler.set_anneal(1.0)
    try:
        with torch.no_grad():
            yield
    finally:
        for name, value in kept.items():
            setattr(sampler, name, value)
        model.train(was_training)


class Psnr(torch.nn.Module):
    """torchmetrics' PSNR of values in 0..1, without the state that it keeps over batches."""

    def forward(self, image: Tensor, other: Tensor) -> Tensor:
        """PSNR of two pictures, dB."""
        return -10 * torch.log10(torch.nn.functional.mse_loss(image.detach(), other))


class LpipsAtFirstUse:
    """LPIPS as nerfacto calls it, kept outside the module tree and so outside checkpoints.

    Without AlexNet's weights on disk it reports this once and gives NaN, which the model leaves out of its figures.
    """

    def __init__(self) -> None:
        self._loaded = False
        self.network: torch.nn.Module | None = None

    def load(self, device: torch.device) -> torch.nn.Module | None:
        """The network on `device`, or None where its weights are missing."""
        if not self._loaded:
            self._loaded = True
            self.network = load_lpips()
        return None if self.network is None else self.network.to(device)

    def __call__(self, image: Tensor, other: Tensor) -> Tensor:
        """LPIPS of two pictures (1×3×H×W in 0..1), NaN without weights."""
        network = self.load(image.device)
        return image.new_tensor(float("nan")) if network is None else network(image, other.clamp(0, 1))


class ViewEvaluation:
    """Evaluates views inside their masks, and pools depth errors over the pixels of all of them."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start pooling depth errors again."""
        self._depth_errors = {"lidar": DepthErrors(), "truth": DepthErrors()}

    def pooled(self) -> dict[str, float]:
        """Depth errors over all pixels evaluated since the last reset."""
        return {
            key: value
            for name, errors in self._depth_errors.items()
            for key, value in errors.compute(f"{name}_").items()
        }

    def of_view(
        self,
        rgb: Float[Tensor, "h w 3"],
        distance_m: Float[Tensor, "h w"],
        batch: Mapping[str, Any],
        lpips: torch.nn.Module | None,
    ) -> dict[str, float]:
        """Give a view's figures, masked_* and, where the picture without noise is known, truth_masked_*.

        Args:
            rgb: rendered colours, 0..1.
            distance_m: rendered distances.
            batch: the datamanager's: mask, image and what else is known.
            lpips: its network; None where its weights are missing.
        """
        mask = batch["mask"][..., 0].to(rgb.device)
        metrics = {}
        for prefix, key in (("", "image"), ("truth_", "truth_rgb")):
            if key in batch:
                target = batch[key][..., :3].to(rgb)
                metrics[f"{prefix}masked_psnr"] = float(masked_psnr(rgb, target, mask))
                metrics[f"{prefix}masked_ssim"] = float(masked_ssim(rgb, target, mask))
                if lpips is not None:
                    metrics[f"{prefix}masked_lpips"] = float(masked_lpips(rgb, target, mask, lpips))
        for name, errors in self._depth_errors.items():
            if f"{name}_distance_m" in batch:
                errors.update(distance_m, batch[f"{name}_distance_m"][..., 0].to(distance_m), mask)
        return metrics
