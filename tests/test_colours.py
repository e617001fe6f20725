"""Views in colours: as the NumPy form of the same scale, to one of its 256 steps."""

import numpy as np
import pytest
import torch

from edge_depth_nerf.base.pictures import DISTANCE, NO_VALUE_RGB, RELATIVE_ERROR, SIGMA
from edge_depth_nerf.plugin.colours import coloured


@pytest.mark.parametrize("scale", [DISTANCE, SIGMA, RELATIVE_ERROR], ids=["distance", "sigma", "relative error"])
def test_colours_are_those_of_the_scale(scale):
    steps = torch.arange(256, dtype=torch.float64)
    values = torch.from_numpy(scale.values_at(steps.numpy() / 255)).float()
    found = (coloured(values.view(16, 16), scale) * 255).round().byte()
    assert torch.equal(found.view(256, 3), torch.from_numpy(scale.colours.copy()))
    at = torch.linspace(0.5 * scale.low, 1.5 * scale.high, 4000).view(40, 100)
    expected = scale.coloured(at.numpy(), np.ones(at.shape, bool))
    off = (coloured(at, scale) * 255 - torch.from_numpy(expected).float()).abs().amax(-1)
    assert (off < 0.01).float().mean() > 0.99


def test_what_is_no_number_has_the_colour_of_no_value():
    at = torch.tensor([[float("nan"), float("inf"), -float("inf"), 5.0]])
    found = (coloured(at, DISTANCE) * 255).round().int()
    assert (found[0, :3] == torch.tensor(NO_VALUE_RGB)).all()
    assert found[0, 3].tolist() == DISTANCE.coloured(np.array([[5.0]]), np.ones((1, 1), bool))[0, 0].tolist()
