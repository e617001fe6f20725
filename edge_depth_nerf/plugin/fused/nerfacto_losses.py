"""mip-NeRF 360's two losses on the samples of a ray, as nerfstudio has them, in fewer passes.

Host-facing. Shapes: `[rays, samples]`; edges, of which there is one more than samples, in the spacing of 0..1.
"""

from __future__ import annotations

from jaxtyping import Float
from nerfstudio.model_components.losses import lossfun_outer
from torch import Tensor

from edge_depth_nerf.kernels import formulas
from edge_depth_nerf.kernels.functions import DISTORTION_LOSS, INTERLEVEL_LOSS


def distortion_loss(edges: Float[Tensor, "rays edges"], weights: Float[Tensor, "rays samples"]) -> Float[Tensor, ""]:
    """Compute mip-NeRF 360's distortion loss (its Eq. 15), mean over the rays.

    Args:
        edges: of the samples, ascending, in the spacing of 0..1.
        weights: rendering weights.
    """
    compute = None if edges.requires_grad else DISTORTION_LOSS.compiled_for(edges, weights)
    return (compute or formulas.distortion_loss)(edges, weights)


def interlevel_loss(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays samples"],
    proposal_edges: Float[Tensor, "rays proposal_edges"],
    proposal_weights: Float[Tensor, "rays proposal_samples"],
) -> Float[Tensor, ""]:
    """Compute mip-NeRF 360's interlevel loss (its Eq. 13) of one proposal network, mean over the samples.

    `weights` are taken as given: the gradient goes to `proposal_weights` alone.
    """
    compute = INTERLEVEL_LOSS.compiled_for(edges, weights, proposal_edges, proposal_weights)
    if compute is not None:
        return compute(edges, weights, proposal_edges, proposal_weights)
    return lossfun_outer(edges, weights.detach(), proposal_edges, proposal_weights).mean()
