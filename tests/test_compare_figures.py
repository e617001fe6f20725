"""Figures of comparisons by hand."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from edge_depth_nerf.compare.figures import BinnedErrors, affine_fitted


def test_a_colour_fit_takes_out_gain_offset_and_tint():
    generator = torch.Generator().manual_seed(0)
    target = 0.3 + 0.4 * torch.rand(20, 30, 3, generator=generator)
    mixing = torch.tensor([[0.8, 0.1, 0.0], [0.0, 0.7, 0.1], [0.1, 0.0, 0.9]])
    mask = torch.ones(20, 30, dtype=torch.bool)
    mask[:, :4] = False
    pred = target @ mixing + 0.05
    pred[~mask] = 0.9  # what is outside has no part in the fit
    fitted = affine_fitted(pred, target, mask)
    assert torch.allclose(fitted[mask], target[mask], atol=1e-5)
    noisy = (target + 0.1 * torch.randn(target.shape, generator=generator)).clamp(0, 1)
    design = np.concatenate([noisy[mask].numpy(), np.ones((int(mask.sum()), 1))], axis=1)
    best, *_ = np.linalg.lstsq(design, target[mask].numpy(), rcond=None)
    assert np.allclose(affine_fitted(noisy, target, mask)[mask].numpy(), np.clip(design @ best, 0, 1), atol=1e-5)
    flat = torch.full_like(target, 0.5)  # one colour: as good as a mean
    mean = target[mask].mean(0)
    assert torch.allclose(affine_fitted(flat, target, mask)[mask], mean.expand(int(mask.sum()), 3), atol=1e-4)


def test_binned_errors_are_pooled_over_pictures():
    rng = np.random.default_rng(0)
    edges = (0.0, 10.0, 20.0, 40.0)
    binned = BinnedErrors(edges)
    pixels = {index: ([], [], []) for index in range(3)}
    for _ in range(2):
        values = rng.uniform(-5, 45, (6, 7))
        values[0, 0] = np.nan
        mask = rng.random((6, 7)) < 0.8
        pred, target = rng.random((2, 6, 7, 3)).astype(np.float32)
        pred_m = rng.uniform(1, 80, (6, 7)).astype(np.float32)
        true_m = np.where(rng.random((6, 7)) < 0.3, 0, rng.uniform(0.5, 90, (6, 7))).astype(np.float32)
        arrays = (torch.from_numpy(array) for array in (pred, target, pred_m, true_m))
        binned.update(torch.from_numpy(values.astype(np.float32)), torch.from_numpy(mask), *arrays)
        for row, column in zip(*np.nonzero(mask), strict=True):
            for index, (low, high) in enumerate(pairwise(edges)):
                if low <= np.float32(values[row, column]) < high:
                    pixels[index][0].append(((pred[row, column] - target[row, column]) ** 2).mean())
                    true = true_m[row, column]
                    if 1 <= true <= 60:
                        pixels[index][1].append(abs(pred_m[row, column] - true) / true)
                        pixels[index][2].append(max(pred_m[row, column] / true, true / pred_m[row, column]) < 1.25)
    found = binned.compute()
    assert [entry["low"] for entry in found] == [0, 10, 20]
    for index, entry in enumerate(found):
        squared, relative, within = pixels[index]
        assert entry["pixels"] == len(squared)
        assert entry["psnr"] == pytest.approx(-10 * math.log10(np.mean(squared)), abs=1e-4)
        assert entry["abs_rel"] == pytest.approx(np.mean(relative), abs=1e-5)
        assert entry["delta_1_25"] == pytest.approx(np.mean(within), abs=1e-9)
