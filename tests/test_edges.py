"""Which edges a rendered view has: against slow loops, and by pictures whose edges are known."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from edge_depth_nerf.method.edges import RIM_PX, EdgeRecall, depth_edges_found, picture_edges_found

H, W = 40, 46


def slow_ridges(picture: np.ndarray, mask: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Slopes by SciPy, and edges pixel by pixel."""
    grey = np.where(mask, picture.astype(np.float64).mean(-1), 0)
    blurred = gaussian_filter(grey, 1.0, radius=3, mode="constant")
    padded = np.pad(blurred, 1)
    right = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    steep, edge = np.hypot(right, down), np.zeros(mask.shape, bool)
    for row in range(1, mask.shape[0] - 1):
        for column in range(1, mask.shape[1] - 1):
            turn = round(math.atan2(down[row, column], right[row, column]) / math.radians(45)) % 4
            step = [(0, 1), (1, 1), (1, 0), (1, -1)][turn]
            before = steep[row - step[0], column - step[1]]
            after = steep[row + step[0], column + step[1]]
            here = steep[row, column]
            edge[row, column] = here >= least and here > before and here >= after
    return edge, np.stack([right, down])


def slow_pictures(pred: np.ndarray, target: np.ndarray, mask: np.ndarray) -> tuple[int, int]:
    true, true_slope = slow_ridges(target, mask, 0.03)
    rendered, slope = slow_ridges(pred, mask, 0.015)
    found = edges = 0
    for row in range(RIM_PX, H - RIM_PX):
        for column in range(RIM_PX, W - RIM_PX):
            window = mask[row - RIM_PX : row + RIM_PX + 1, column - RIM_PX : column + RIM_PX + 1]
            if not (true[row, column] and window.all()):
                continue
            edges += 1
            mine = true_slope[:, row, column]
            for r in range(row - 2, row + 3):
                for c in range(column - 2, column + 3):
                    theirs = slope[:, r, c]
                    if rendered[r, c] and (r - row) ** 2 + (c - column) ** 2 <= 4:
                        cosine = mine @ theirs / np.linalg.norm(mine) / np.linalg.norm(theirs)
                        if cosine >= math.cos(math.radians(30)):
                            found += 1
                            break
                else:
                    continue
                break
    return found, edges


def slow_depths(pred: np.ndarray, true: np.ndarray, mask: np.ndarray) -> tuple[int, int]:
    found = edges = 0
    for row in range(H):
        known = [c for c in range(W) if mask[row, c] and 1 <= true[row, c] <= 60]
        for left, right in itertools.pairwise(known):
            ratio = true[row, right] / true[row, left]
            if right - left > 3 or max(ratio, 1 / ratio) < 1.5 or left == 0 or right == W - 1:
                continue
            edges += 1
            for r in range(max(row - 2, 0), min(row + 3, H)):
                for shift in range(-1, 2):
                    a, b = left - 1 + shift, right + 1 + shift
                    if a < 0 or b >= W or not (mask[r, a] and mask[r, b]):
                        continue
                    theirs = math.log(pred[r, b] / pred[r, a])
                    if theirs * math.log(ratio) > 0 and abs(theirs) >= abs(math.log(ratio)) / 2:
                        break
                else:
                    continue
                found += 1
                break
    return found, edges


def blocks(rng: np.random.Generator, side: int, low: float, high: float, channels: int = 1) -> np.ndarray:
    values = rng.uniform(low, high, (-(-H // side), -(-W // side), channels))
    return values.repeat(side, 0).repeat(side, 1)[:H, :W]


def lens() -> np.ndarray:
    row, column = np.indices((H, W))
    return (row - H / 2) ** 2 + (column - W / 2) ** 2 < 19**2


def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.from_numpy(np.ascontiguousarray(each)) for each in arrays]


@pytest.mark.parametrize("seed", range(3))
def test_edges_of_pictures_as_a_slow_loop_finds_them(seed):
    rng = np.random.default_rng(seed)
    target = blocks(rng, 6, 0, 1, 3).astype(np.float32)
    pred = np.roll(target, (seed, 1), (0, 1)) * 0.7 + rng.normal(0, 0.05, target.shape)
    # on the right there is nothing but noise
    pred[:, 25:] = pred[:, 25:] * 0.05 + 0.5
    pred = np.where(lens()[..., None], pred, np.nan).astype(np.float32)
    found = picture_edges_found(*tensors(pred, target, lens()))
    assert found == slow_pictures(pred, target, lens()) and 0.1 < found[0] / found[1] < 1


@pytest.mark.parametrize(("seed", "kept"), [(0, 1.0), (1, 1.0), (2, 0.4), (3, 0.3)])
def test_depth_edges_as_a_slow_loop_finds_them(seed, kept):
    rng = np.random.default_rng(10 + seed)
    true = blocks(rng, 5, 0.5, 70)[..., 0]
    pred = np.roll(true, rng.integers(-2, 3), 1) * rng.uniform(0.9, 1.1, (H, W))
    pred[:, 25:] = rng.uniform(9, 12, (H, W - 25))
    true = np.where(rng.random((H, W)) < kept, true, 0)
    mask = lens() | (rng.random((H, W)) < 0.3)
    found = depth_edges_found(*tensors(np.where(mask, pred, np.nan), true, mask))
    assert found == slow_depths(pred, true, mask) and 0.2 < found[0] / found[1] < 1


def stripe(place: int, blur_px: float = 0.0) -> torch.Tensor:
    picture = np.full((H, W), 0.2)
    picture[:, place:] = 0.8
    picture = gaussian_filter(picture, (0, blur_px)) if blur_px else picture
    return torch.from_numpy(np.repeat(picture[..., None], 3, 2)).float()


def share(pred: torch.Tensor, target: torch.Tensor) -> float:
    found, edges = picture_edges_found(pred, target, torch.ones(H, W, dtype=torch.bool))
    assert edges == H - 2 * RIM_PX
    return found / edges


def test_an_edge_counts_at_its_place_in_its_direction():
    target = stripe(20)
    assert share(target, target) == share(stripe(22), target) == share(stripe(18), target) == 1
    assert share(stripe(23), target) == share(stripe(17), target) == 0
    assert share(1 - target, target) == share(target.transpose(0, 1)[:H, :H].new_full((H, W, 3), 0.5), target) == 0
    # half the contrast is enough at that place, and a strong blur is not
    assert share(0.5 + (target - 0.5) * 0.6, target) == 1 and share(0.5 + (target - 0.5) * 0.05, target) == 0
    assert share(stripe(20, 1.0), target) == 1 and share(stripe(20, 16.0), target) == 0


def test_a_depth_edge_counts_at_its_place_in_its_direction():
    def street(place: int, near: float = 5.0, far: float = 20.0) -> torch.Tensor:
        found = torch.full((H, W), near)
        found[:, place:] = far
        return found

    everywhere, target = torch.ones(H, W, dtype=torch.bool), street(20)
    assert depth_edges_found(target, target, everywhere) == (H, H)
    for place in (18, 22):
        assert depth_edges_found(street(place), target, everywhere) == (H, H)
    for place in (17, 23):
        assert depth_edges_found(street(place), target, everywhere)[0] == 0
    assert depth_edges_found(street(20, 20, 5), target, everywhere)[0] == 0
    assert depth_edges_found(street(20, 10, 19), target, everywhere)[0] == 0
    # a road that recedes down its rows has no edges
    road = torch.linspace(2, 59, H)[:, None].expand(H, W).contiguous()
    assert depth_edges_found(road, road, everywhere) == (0, 0)


def test_shares_are_of_all_views_together():
    recall = EdgeRecall()
    for name, found in (("edges", (1, 2)), ("edges", (3, 8)), ("none", (0, 0))):
        recall.update(name, found)
    assert recall.compute() == {"edges": 0.4}
