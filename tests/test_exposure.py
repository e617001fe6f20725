"""Gains of colours: neutral on average, of each picture alone."""

import pytest
import torch
import yaml
from scenes import write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.plugin.exposure import Gains


def some_gains(pictures: int = 5) -> Gains:
    found = Gains(pictures)
    with torch.no_grad():
        found.log_gains.normal_(0, 1.0, generator=torch.Generator().manual_seed(0))
    return found


def seen_by(found: Gains, picture: int, colours: torch.Tensor) -> torch.Tensor:
    return found(colours, torch.full((len(colours),), picture))


@pytest.fixture
def colours():
    return torch.rand(200, 3, generator=torch.Generator().manual_seed(1))


def test_the_gains_geometric_mean_is_one(colours):
    found = some_gains()
    every = torch.stack([seen_by(found, picture, colours) for picture in range(5)])
    torch.testing.assert_close(every.log().mean(dim=0).exp(), colours, atol=1e-6, rtol=0)


def test_new_gains_change_nothing_and_one_picture_keeps_it_so(colours):
    assert torch.equal(seen_by(Gains(3), 1, colours), colours)
    torch.testing.assert_close(seen_by(some_gains(1), 0, colours), colours)


def test_gains_learn_a_cameras_gain(colours):
    """Two pictures of the same scene, one a third brighter than the other: the gains take up the difference."""
    found = Gains(2)
    optimizer = torch.optim.Adam(found.parameters(), 0.02)
    picture = torch.arange(200) % 2
    target = colours * torch.tensor([0.85, 1.15])[picture][:, None]
    for _ in range(200):
        optimizer.zero_grad()
        loss = (found(colours, picture) - target).square().mean()
        loss.backward()
        optimizer.step()
    assert float(loss.detach()) < 3e-4 < float((colours - target).square().mean())


@pytest.mark.parametrize("exposure", ["affine", "grid"])
def test_a_training_with_an_exposure_of_an_earlier_version_is_refused(tmp_path, exposure):
    from models import pipeline_config  # imports nerfstudio

    text = yaml.dump(pipeline_config(write_scene(tmp_path, frames=2)))
    assert "exposure: gain" in text
    config = yaml.load(text.replace("exposure: gain", f"exposure: {exposure}"), yaml.Loader)  # as ns-eval does
    with pytest.raises(InputError, match=rf"exposure {exposure}: .*one of gain, embedding, none\. Train again"):
        config.setup(device="cpu", test_mode="test")
