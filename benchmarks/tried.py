"""Terms that were tried for the edge loss and are no part of it; `ablation.py` measures them beside those that are.

Each takes a pipeline that is to be trained and changes it.
"""

from __future__ import annotations

import math
from typing import Any

import torch

GUIDED_SIGMAS = 1.5
"""Samples that the prior places lie around it by so many of its σ̂."""
BEFORE_SIGMAS = 3.0
"""What lies nearer than so many σ̂ before the prior is in its line of sight."""


def line_of_sight(pipeline: Any, mult: float) -> None:
    """Punish weight before the prior (URF's L_empty): its sum up to d̃ - 3 σ̂, mean over the rays with a prior."""
    model = pipeline.model
    losses_of = model.get_loss_dict

    def get_loss_dict(outputs: Any, batch: Any, metrics_dict: Any = None) -> Any:
        losses = losses_of(outputs, batch, metrics_dict)
        if not model.training:
            return losses
        distance_m, sigma_m = batch["prior_distance_m"][:, 0], batch["prior_sigma_m"][:, 0]
        has_prior = distance_m > 0
        limit = ((distance_m - BEFORE_SIGMAS * sigma_m) / model.metres_per_unit)[has_prior, None]
        total = outputs["rgb"].new_zeros(())
        for weights, samples in zip(outputs["weights_list"], outputs["ray_samples_list"], strict=True):
            starts, ends = samples.frustums.starts[has_prior, :, 0], samples.frustums.ends[has_prior, :, 0]
            share = ((limit - starts) / (ends - starts).clamp(min=1e-6)).clamp(0, 1)
            total = total + (share * weights[has_prior, :, 0]).sum() / max(1, int(has_prior.sum()))
        losses["line_of_sight"] = mult * total / len(outputs["weights_list"])
        return losses

    model.get_loss_dict = get_loss_dict


def guided_samples(pipeline: Any, share: float) -> None:
    """Place that share of a ray's last samples by the prior's Gaussian in place of the proposal networks' weights."""
    model, data = pipeline.model, pipeline.datamanager
    sampler = model.proposal_sampler.pdf_sampler
    next_train, place = data.next_train, sampler.generate_ray_samples
    served: dict[str, Any] = {}

    def next_guided(step: int) -> Any:
        rays, served["batch"] = next_train(step)
        return rays, served["batch"]

    def generate(ray_bundle: Any, ray_samples: Any, weights: Any, num_samples: int, eps: float = 1e-5) -> Any:
        if model.training and num_samples == model.config.num_nerf_samples_per_ray:
            distance = served["batch"]["prior_distance_m"] / model.metres_per_unit
            sigma = GUIDED_SIGMAS * served["batch"]["prior_sigma_m"] / model.metres_per_unit
            sigma = torch.where(distance > 0, sigma, 1.0) * math.sqrt(2)
            ends, starts = ray_samples.frustums.ends[..., 0], ray_samples.frustums.starts[..., 0]
            gaussian = (torch.erf((ends - distance) / sigma) - torch.erf((starts - distance) / sigma)) / 2
            found = weights[..., 0].detach()
            mixed = (1 - share) * found / found.sum(1, keepdim=True).clamp(min=eps) + share * gaussian
            # where the samples of before do not reach the Gaussian there is nothing to place by
            reached = (distance > 0) & (gaussian.sum(1, keepdim=True) > 0.3)
            weights = torch.where(reached, mixed, found)[..., None]
        return place(ray_bundle, ray_samples, weights, num_samples, eps)

    data.next_train, sampler.generate_ray_samples = next_guided, generate
