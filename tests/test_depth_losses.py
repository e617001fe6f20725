"""Losses on the prior by name: how one is registered, found, and averaged over rays and levels."""

from copy import copy
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint

import pytest
import torch
from nerfstudio.configs.method_configs import all_methods

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.method import depth_losses
from edge_depth_nerf.method.depth_losses import (
    GROUP,
    LOSSES,
    DepthLoss,
    DsNerfLoss,
    EdgeLoss,
    Level,
    UrbanNerfLoss,
    UrbanNerfSightLoss,
    depth_loss,
    register,
)
from edge_depth_nerf.plugin.step_losses import PriorLoss, step_losses_of


@dataclass(frozen=True)
class OffLoss(DepthLoss):
    """How far the expected distance is off."""

    power: float = 1.0

    def __call__(self, level: Level) -> torch.Tensor:
        off = (level.expected_m - level.prior_m).abs() ** self.power
        return torch.where(level.prior_m > 0, off, 0)


def level(prior: list[float], scale: float = 1.0, **more) -> Level:
    edges = scale * torch.tensor([[0.0, 2.0, 4.0]]).expand(len(prior), -1)
    weights = torch.tensor([[0.5, 0.5]]).expand(len(prior), -1).clone().requires_grad_()
    return Level(weights, edges[:, :-1], edges[:, 1:], torch.tensor(prior), torch.ones(len(prior)), **more)


@dataclass(frozen=True)
class WithoutDefault(DepthLoss):
    option: float


@pytest.fixture
def table(monkeypatch):
    monkeypatch.setattr(depth_losses, "LOSSES", dict(LOSSES))
    return depth_losses.LOSSES


def test_the_table_has_ours_and_what_is_registered(table, monkeypatch):
    assert set(table) == {"edge", "ds-nerf", "urban-nerf", "urban-nerf-los"}
    register("off=test_depth_losses:OffLoss, off-2 = test_depth_losses:OffLoss")
    assert set(table) - set(LOSSES) == {"off", "off-2"} and table["off"].__name__ == "OffLoss"
    # those of installed packages
    installed = [EntryPoint("installed", "test_depth_losses:OffLoss", GROUP)]
    monkeypatch.setattr(depth_losses, "entry_points", lambda group: installed if group == GROUP else [])
    register("")
    assert table["installed"].__name__ == "OffLoss"


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ("off=no_such_module:OffLoss", "ModuleNotFoundError"),
        ("off=test_depth_losses:NoLoss", "AttributeError"),
        ("off=test_depth_losses:level", "TypeError"),
        ("off=test_depth_losses:EntryPoint", "not derived from DepthLoss"),
        ("off", "off= is left out"),
        ("2nd=test_depth_losses:OffLoss", "cannot be that of an option"),
        ("lambda=test_depth_losses:OffLoss", "cannot be that of an option"),
        ("none=test_depth_losses:OffLoss", "another loss of this name"),
        ("urban_nerf=test_depth_losses:OffLoss", "another loss of this name"),
        ("off=test_depth_losses:WithoutDefault", "missing 1 required"),
    ],
)
def test_what_is_no_loss_is_left_out_with_a_warning(table, named, words):
    with pytest.warns(UserWarning, match=words):
        register(named)
    assert table == LOSSES


def test_a_loss_is_the_mean_over_rays_with_a_prior_and_the_levels():
    final = level([3.0, 0.0, 5.0, 2.0])
    proposal = replace(level([3.0, 0.0, 5.0, 2.0], scale=2.0), final=final)
    # expected 2 m and 4 m: off by 1, -, 3, 0 and 1, -, 1, 2
    assert float(depth_loss(OffLoss(), [final]).detach()) == pytest.approx(4 / 3)
    both = depth_loss(OffLoss(), [final, proposal])
    assert float(both.detach()) == pytest.approx((4 / 3 + 4 / 3) / 2)
    # a level that rests is left out, and the other pulls as before
    resting = depth_loss(OffLoss(2.0), [final], 2)
    assert float(resting.detach()) == pytest.approx(10 / 3 / 2)
    resting.backward()
    assert final.weights.grad is not None and final.weights.grad.any()
    assert float(depth_loss(OffLoss(), [level([0.0, 0.0])]).detach()) == 0


@pytest.mark.parametrize("kind", [EdgeLoss, DsNerfLoss, UrbanNerfLoss, UrbanNerfSightLoss])
def test_every_loss_gives_a_number_a_ray_and_none_without_a_prior(kind):
    losses = kind()(level([3.0, 0.0, 5.0]))
    assert losses.shape == (3,) and losses[1] == 0 and losses[[0, 2]].all()
    given = level([3.0, 0.0, 5.0])
    kind()(given).sum().backward()
    assert given.weights.grad is not None and not given.weights.grad[1].any() and given.weights.grad[0].any()


def test_urban_nerfs_sigma_narrows_over_the_training():
    loss = UrbanNerfSightLoss(sigma_m=0.1, narrowing=16.0)
    constant = replace(loss, narrowing=1.0)
    for share, sigma_m in ((0.0, 1.6), (0.5, 0.4), (1.0, 0.1)):
        narrowed, expected = loss(level([3.0], share_done=share)), replace(constant, sigma_m=sigma_m)(level([3.0]))
        torch.testing.assert_close(narrowed, expected)


def test_a_configuration_names_its_loss(monkeypatch):
    """A config.yml may name one that was registered after it was written, or that is not registered here."""
    config = copy(all_methods["edge-depth-nerf-lite"].pipeline.model)
    assert set(step_losses_of(config)) == {"edge_loss", "sky_loss", "surface_loss"}
    monkeypatch.setitem(LOSSES, "off", OffLoss)
    config.depth_loss = "off"
    found = step_losses_of(config)
    assert set(found) == {"off_loss", "sky_loss", "surface_loss"}
    assert isinstance(found["off_loss"], PriorLoss) and found["off_loss"].loss == OffLoss()
    monkeypatch.delitem(LOSSES, "off")
    with pytest.raises(InputError, match=r"no such loss; expected one of edge, .*EDGE_DEPTH_NERF_LOSSES=off=MODULE:"):
        step_losses_of(config)
    config.depth_loss = "none"
    assert step_losses_of(config) == {}
