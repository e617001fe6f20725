"""Maps of colours: neutral on average, of each picture alone, smooth over it."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from edge_depth_nerf.plugin.exposure import GRID_SHAPE, KINDS


def maps(kind: str, pictures: int = 5) -> Any:
    found = KINDS[kind](pictures)
    with torch.no_grad():
        for parameter in found.parameters():
            parameter.normal_(0, 1.0, generator=torch.Generator().manual_seed(0))
    return found


def seen_by(found, picture: int, colours: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    return found(colours, torch.full((len(colours),), picture), place)


@pytest.fixture
def rays():
    generator = torch.Generator().manual_seed(1)
    return torch.rand(200, 3, generator=generator), torch.rand(200, 2, generator=generator)


@pytest.mark.parametrize("kind", ["affine", "grid"])
def test_the_pictures_maps_are_the_identity_on_average(kind, rays):
    colours, place = rays
    found = maps(kind)
    every = torch.stack([seen_by(found, picture, colours, place) for picture in range(5)])
    assert float((every - colours).abs().max()) > 0.01
    torch.testing.assert_close(every.mean(dim=0), colours, atol=1e-6, rtol=0)


def test_the_gains_geometric_mean_is_one(rays):
    colours, place = rays
    found = maps("gain")
    every = torch.stack([seen_by(found, picture, colours, place) for picture in range(5)])
    torch.testing.assert_close(every.log().mean(dim=0).exp(), colours, atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_map_changes_nothing_and_one_picture_keeps_it_so(kind, rays):
    colours, place = rays
    assert torch.equal(seen_by(KINDS[kind](3), 1, colours, place), colours)
    torch.testing.assert_close(seen_by(maps(kind, 1), 0, colours, place), colours)


def test_a_grid_is_of_its_picture_place_and_brightness_alone():
    found: Any = KINDS["grid"](3)
    with torch.no_grad():
        # the red offset of the second picture, at its lower right and where it is bright
        found.slow_offsets[1, 3, -1, -1, -1] = 3.0
    bright, dark = torch.full((1, 3), 1.0), torch.zeros(1, 3)
    corner, other = torch.tensor([[1.0, 1.0]]), torch.tensor([[0.0, 1.0]])
    moved = seen_by(found, 1, bright, corner) - bright
    # less the mean over three pictures, which the two others pay
    torch.testing.assert_close(moved, torch.tensor([[0.2, 0.0, 0.0]]))
    for picture in (0, 2):
        torch.testing.assert_close(seen_by(found, picture, bright, corner) - bright, torch.tensor([[-0.1, 0.0, 0.0]]))
    assert torch.equal(seen_by(found, 1, dark, corner), dark)
    assert torch.equal(seen_by(found, 1, bright, other), bright)
    step = 1 / (GRID_SHAPE[2] - 1)
    halfway = seen_by(found, 1, bright, corner - torch.tensor([[step / 2, 0.0]])) - bright
    torch.testing.assert_close(halfway, moved / 2)


def test_what_is_uneven_costs():
    assert float(KINDS["gain"](3).unevenness()) == 0
    for kind in ("affine", "grid"):
        assert float(KINDS[kind](3).unevenness()) == 0
        assert float(maps(kind).unevenness().detach()) > 1e-3
    smooth: Any = KINDS["grid"](2)
    rough: Any = KINDS["grid"](2)
    with torch.no_grad():
        smooth.slow_offsets[0] += 1.0
        rough.slow_offsets[0, ..., ::2] += 1.0
    assert float(rough.unevenness().detach()) > 2 * float(smooth.unevenness().detach())


@pytest.mark.parametrize("kind", KINDS)
def test_maps_learn_a_cameras_gain(kind, rays):
    """Two pictures of the same scene, one a third brighter than the other: the maps take up the difference."""
    colours, place = rays
    found = KINDS[kind](2)
    optimizer = torch.optim.Adam(found.parameters(), 0.02 if kind == "gain" else 0.2)
    picture = torch.arange(200) % 2
    target = colours * torch.tensor([0.85, 1.15])[picture][:, None]
    for _ in range(200):
        optimizer.zero_grad()
        loss = (found(colours, picture, place) - target).square().mean()
        loss.backward()
        optimizer.step()
    assert float(loss.detach()) < 3e-4 < float((colours - target).square().mean())
