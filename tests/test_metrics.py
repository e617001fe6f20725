import logging
import math

import numpy as np
import pytest
import torch
from torchvision.models import alexnet

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.method import metrics
from edge_depth_nerf.method.metrics import DepthErrors, load_lpips, masked_flip, masked_lpips, masked_psnr, masked_ssim


def pictures(seed: int = 0, height: int = 40, width: int = 50) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height // 5, width // 5, 3, generator=generator)
    target = target.repeat_interleave(5, 0).repeat_interleave(5, 1)
    pred = (target + 0.1 * torch.randn(target.shape, generator=generator)).clamp(0, 1)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return pred, target, (x - width / 2) ** 2 + (y - height / 2) ** 2 < 17**2


def mean_difference(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Stand in for the LPIPS network; refuses what that refuses."""
    assert a.shape == b.shape and a.shape[:2] == (1, 3)
    assert 0 <= min(a.min(), b.min()) and max(a.max(), b.max()) <= 1
    return (a - b).abs().mean()


METRICS = {
    "masked_psnr": masked_psnr,
    "masked_ssim": masked_ssim,
    "masked_flip": masked_flip,
    "masked_lpips": lambda pred, target, mask: masked_lpips(pred, target, mask, mean_difference),
}


@pytest.mark.parametrize(("metric", "of_equal"), zip(METRICS.values(), (100, 1, 0, 0), strict=True), ids=METRICS)
def test_what_lies_outside_the_mask_never_counts(metric, of_equal):
    pred, target, mask = pictures()
    found = metric(pred, target, mask)
    for rubbish in (0.0, 55.0, math.nan, -math.inf):
        torch.testing.assert_close(metric(torch.where(mask[..., None], pred, rubbish), target, mask), found)
    pred[20, 25] = 1 - pred[20, 25]
    assert metric(pred, target, mask) != found
    assert float(metric(pred, pred, mask)) == pytest.approx(of_equal)


def test_psnr_by_hand():
    # two of four pixels evaluated, errors 0.1 (all channels) and 0: mean square 0.005, 10 · log10(200) = 23.0103 dB
    pred, target = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)
    pred[0, 0], pred[1, 1] = 0.1, 0.9
    mask = torch.tensor([[True, True], [False, False]])
    assert float(masked_psnr(pred, target, mask)) == pytest.approx(23.0103, abs=1e-4)


def test_flip_of_green_and_blue():
    """Without edges FLIP is the colours' distance, whose unit is that of green and blue."""
    green, blue = torch.zeros(2, 60, 80, 3).unbind(0)
    green[..., 1], blue[..., 2] = 1, 1
    assert float(masked_flip(green, blue, torch.ones(60, 80, dtype=torch.bool))) == pytest.approx(1, abs=1e-3)


def ssim_twin(pred: np.ndarray, target: np.ndarray, row: int, column: int) -> float:
    """SSIM (Wang et al. 2004) of the 11×11 window around one pixel, mean over the channels."""
    offsets = np.arange(-5, 6)
    line = np.exp(-(offsets**2) / (2 * 1.5**2))
    g = np.outer(line, line)[..., None] / line.sum() ** 2
    a, b = (p[row - 5 : row + 6, column - 5 : column + 6].astype(np.float64) for p in (pred, target))
    mean_a, mean_b = (g * a).sum((0, 1)), (g * b).sum((0, 1))
    var_a, var_b = (g * (a - mean_a) ** 2).sum((0, 1)), (g * (b - mean_b) ** 2).sum((0, 1))
    covariance = (g * (a - mean_a) * (b - mean_b)).sum((0, 1))
    c1, c2 = 0.01**2, 0.03**2
    top = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return float((top / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))).mean())


@pytest.mark.parametrize("kind", ["full", "disc", "strip"])
def test_ssim_is_the_mean_over_the_eroded_mask(kind):
    pred, target, mask = pictures()
    if kind == "full":
        mask[:] = True
    elif kind == "strip":
        mask[:] = False
        mask[10:23, 15:26] = True  # three windows fit
    fitting = [(i, j) for i in range(5, 35) for j in range(5, 45) if mask[i - 5 : i + 6, j - 5 : j + 6].all()]
    assert len(fitting) == {"full": 30 * 40, "strip": 3}.get(kind, len(fitting))
    expected = np.mean([ssim_twin(pred.numpy(), target.numpy(), i, j) for i, j in fitting])
    assert float(masked_ssim(pred, target, mask)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("name", METRICS)
def test_wrong_pictures(name, unchecked_types):
    pred, target, mask = pictures()
    with pytest.raises(InputError, match=rf"{name}: the mask \(40, 50\) keeps no pixel"):
        METRICS[name](pred, target, torch.zeros_like(mask))
    with pytest.raises(InputError, match=rf"{name}: found pred \(39, 50, 3\), target \(40, 50, 3\), mask \(40, 50\)"):
        METRICS[name](pred[1:], target, mask)
    with pytest.raises(InputError, match=r"mask \(50, 40\)"):
        METRICS[name](pred, target, mask.T)


@pytest.mark.parametrize("size", [(10, 40), (40, 40)])
def test_ssim_of_a_mask_too_thin(size):
    pred = torch.rand(*size, 3)
    mask = torch.zeros(size, dtype=torch.bool)
    mask[:10] = True
    with pytest.raises(InputError, match="no 11×11 window inside"):
        masked_ssim(pred, pred, mask)


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """An empty torch.hub folder from which nothing can be downloaded."""

    def refuse(*arguments, **keywords):
        pytest.fail(f"a download was tried: {arguments}")

    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", refuse)
    metrics._say_once.cache_clear()
    (tmp_path / "checkpoints").mkdir()
    return tmp_path / "checkpoints" / "alexnet-owt-7be5be79.pth"


def test_lpips_without_whole_weights_is_left_out_with_one_notice(hub, caplog):
    with caplog.at_level(logging.WARNING):
        assert load_lpips() is None
        assert load_lpips() is None
        assert [str(hub) in record.getMessage() for record in caplog.records] == [True]
        hub.write_bytes(b"PK\x03\x04 not all of it")
        assert load_lpips() is None
    assert "cannot be read" in caplog.text


def test_lpips_with_weights(hub):
    # expanded zeros: the right shapes in a file of some kilobytes
    with torch.device("meta"):
        shapes = {name: tensor.shape for name, tensor in alexnet().state_dict().items()}
    torch.save({name: torch.zeros(1).expand(shape) for name, shape in shapes.items()}, hub)
    network = load_lpips()
    assert network is not None and not network.training
    pred, target, mask = pictures(0, 70, 70)
    assert float(masked_lpips(pred * 1.5, target, mask, network)) == 0


def test_depth_errors_by_hand():
    # evaluated: 10 → 11 (+10 %), 20 → 15 (-25 %), 50 → 50, 30 → 40 (+33 %);   20/15 and 40/30 are not within 1.25
    #   abs_rel (0.1 + 0.25 + 0 + 1/3) / 4 = 0.170833,  rmse sqrt((1 + 25 + 0 + 100) / 4) = 5.612486,  delta 2 / 4
    # left out: true 0 (none), 0.9 and 61 (range), the masked one, NaN truth
    true = torch.tensor([[10.0, 20.0, 50.0, 30.0, 0.0, 0.9, 61.0, 30.0, math.nan]])
    pred = torch.tensor([[11.0, 15.0, 50.0, 40.0, 9.0, 9.0, 9.00, math.nan, 9.0]])
    mask = torch.tensor([[True] * 7 + [False, True]])
    errors = DepthErrors()
    errors.update(pred, true, mask)
    figures = errors.compute("lidar_")
    assert figures == pytest.approx(
        {"lidar_abs_rel": 0.170833, "lidar_rmse_m": 5.612486, "lidar_delta_1_25": 0.5, "lidar_pixels": 4}, abs=1e-6
    )


def test_depth_errors_of_nothing_are_left_out_and_of_wrong_input_refused(unchecked_types):
    ones, mask = torch.ones(2, 3), torch.ones(2, 3, dtype=torch.bool)
    errors = DepthErrors()
    assert errors.compute("lidar_") == {}
    errors.update(ones, torch.zeros(2, 3), mask)
    assert errors.compute("lidar_") == {}
    with pytest.raises(InputError, match="1 of 6 evaluated pixels have a prediction that is not finite"):
        DepthErrors().update(torch.where(torch.arange(6).reshape(2, 3) == 4, math.nan, ones), ones, mask)
    with pytest.raises(InputError, match=r"pred_distance_m \(3, 2\), true_distance_m \(2, 3\)"):
        DepthErrors().update(ones.T, ones, mask)


def test_depth_errors_are_pooled_over_pixels():
    rng = np.random.default_rng(0)
    true = torch.tensor(rng.uniform(0, 70, (20, 30)))
    pred = true * torch.tensor(rng.uniform(0.7, 1.4, (20, 30)))
    mask = torch.tensor(rng.random((20, 30)) < 0.7)
    whole, parts = DepthErrors(), DepthErrors()
    whole.update(pred, true, mask)
    for rows in (slice(0, 3), slice(3, 20)):
        parts.update(pred[rows], true[rows], mask[rows])
    parts.update(pred, true, torch.zeros_like(mask))
    assert parts.compute("") == pytest.approx(whole.compute(""))
