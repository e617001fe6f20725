import numpy as np
import pytest
import torch

from edge_depth_nerf.errors import InputError
from edge_depth_nerf.pixel_table import PixelTable, to_steps

RNG = np.random.default_rng(5)


def picture(height, width):
    """Colours that say where they are from: red = row, green = column."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack([rows, columns, np.full_like(rows, 9)], axis=-1).astype(np.uint8)


def test_draws_are_valid_pixels_of_the_right_picture_with_their_own_prior():
    sizes = [(4, 7), (9, 3), (4, 7)]
    masks = [RNG.random(size) < 0.5 for size in sizes[:2]]
    masks.append(masks[0])
    table = PixelTable()
    priors = []
    for number, ((height, width), mask) in enumerate(zip(sizes, masks, strict=True)):
        distance = (1 + number + np.arange(height * width).reshape(height, width) / 256).astype(np.float32)
        priors.append(distance)
        table.add(picture(height, width), mask, (height, width), distance, distance / 2)
    table.finish()
    assert len(table) == sum(mask.sum() for mask in masks)
    assert table.share_with_prior == 1
    batch = table.sample(3000, torch.Generator().manual_seed(0))
    seen = set()
    for (number, row, column), rgb, distance, sigma in zip(
        batch.indices.tolist(), batch.rgb, batch.prior_distance_m, batch.prior_sigma_m, strict=True
    ):
        assert masks[number][row, column]
        assert (rgb * 255).round().tolist() == [row, column, 9]
        assert distance.item() == priors[number][row, column]  # a multiple of 1/256 m
        assert abs(sigma.item() - distance.item() / 2) <= 1 / 512 + 1e-6
        seen.add((number, row, column))
    assert len(seen) == len(table)  # 3000 draws of some 50 pixels: every one is reached


def test_uniform_over_pixels_not_over_pictures():
    table = PixelTable()
    table.add(picture(30, 30), np.ones((30, 30), bool), 0, None, None)
    table.add(picture(10, 10), np.ones((10, 10), bool), 1, None, None)
    table.finish()
    assert table.share_with_prior == 0
    share = (table.sample(20000, torch.Generator().manual_seed(1)).indices[:, 0] == 0).float().mean()
    assert abs(share - 0.9) < 0.01  # 900 of 1000 pixels; standard deviation 0.002


def test_a_picture_without_valid_pixels_is_never_drawn():
    table = PixelTable()
    for number, mask in enumerate([np.zeros((3, 3), bool), np.eye(3, dtype=bool), np.zeros((3, 3), bool)]):
        table.add(picture(3, 3), mask, number, None, None)
    table.finish()
    assert set(table.sample(100).indices[:, 0].tolist()) == {1}


def test_no_valid_pixel_at_all():
    table = PixelTable()
    table.add(picture(2, 2), np.zeros((2, 2), bool), 0, None, None)
    with pytest.raises(InputError, match="inverted"):
        table.finish()


def test_steps_of_a_quarter_of_a_centimetre():
    metres = np.array([0, 1, 255.996, 256.0, np.nan, np.inf, -3, 1 / 256])
    assert to_steps(metres).tolist() == [0, 256, 65535, 0, 0, 0, 0, 1]


def test_the_same_seed_draws_the_same():
    table = PixelTable()
    table.add(picture(8, 8), np.ones((8, 8), bool), 0, None, None)
    table.finish()
    first, second = (table.sample(64, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first.indices, second.indices)


def test_a_sigma_beyond_16_bits_stays_a_sigma():
    table = PixelTable()
    distance = np.full((1, 4), 5, np.float32)
    sigma = np.array([[1e-4, 1000.0, 0.5, 0.0]], np.float32)
    table.add(picture(1, 4), np.ones((1, 4), bool), 0, distance, sigma)
    table.finish()
    batch = table.sample(200, torch.Generator().manual_seed(0))
    stored = {int(column): float(s) for (_, _, column), s in zip(batch.indices, batch.prior_sigma_m, strict=True)}
    assert stored == {0: 1 / 256, 1: 65535 / 256, 2: 0.5, 3: 0.0}
