"""mip-NeRF 360's two losses on the samples of a ray, as nerfstudio has them, in fewer passes.

Host-facing. Shapes: `[rays, samples]`; edges, of which there is one more than samples, in the spacing of 0..1.
"""

from __future__ import annotations

from jaxtyping import Float
from nerfstudio.model_components.losses import lossfun_outer
from torch import Tensor

from edge_depth_nerf.kernels.back_ends import along_rays


def distortion_loss(edges: Float[Tensor, "rays edges"], weights: Float[Tensor, "rays samples"]) -> Float[Tensor, ""]:
    """Compute mip-NeRF 360's distortion loss (its Eq. 15), mean over the rays.

    Σ_ij w_i w_j |m_i - m_j| + 1/3 Σ_i w_i² Δ_i, with middles m and lengths Δ of the samples. As the middles ascend, the
    double sum is 2 Σ_i w_i (m_i Σ_j<i w_j - Σ_j<i w_j m_j): two cumulative sums instead of samples² terms.

    Args:
        edges: of the samples, ascending, in the spacing of 0..1.
        weights: rendering weights.

    """
    kernels = along_rays(edges, weights)
    if kernels is not None and not edges.requires_grad:
        return kernels.distortion_loss(edges, weights)
    middles = (edges[:, 1:] + edges[:, :-1]) / 2
    # the sums up to and including i: what i itself adds cancels
    before, before_middles = weights.cumsum(dim=-1), (weights * middles).cumsum(dim=-1)
    between = 2 * (weights * (middles * before - before_middles)).sum(dim=-1)
    within = (weights**2 * (edges[:, 1:] - edges[:, :-1])).sum(dim=-1) / 3
    return (between + within).mean()


def interlevel_loss(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays samples"],
    proposal_edges: Float[Tensor, "rays proposal_edges"],
    proposal_weights: Float[Tensor, "rays proposal_samples"],
) -> Float[Tensor, ""]:
    """Compute mip-NeRF 360's proposal loss (its Eq. 13) of one proposal network, mean over the samples.

    `weights` are taken as given: the gradient goes to `proposal_weights` alone.
    """
    kernels = along_rays(edges, weights, proposal_edges, proposal_weights)
    if kernels is not None:
        return kernels.bound_loss(edges, weights, proposal_edges, proposal_weights)
    return lossfun_outer(edges, weights.detach(), proposal_edges, proposal_weights).mean()
