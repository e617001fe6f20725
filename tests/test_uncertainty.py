import numpy as np
import pytest
import torch

from edge_depth_nerf.method.uncertainty import termination_std


def drawn_std(weights: np.ndarray, edges: np.ndarray, draws: int = 400_000) -> float:
    """Of so many places where the ray ends, drawn one by one."""
    rng = np.random.default_rng(0)
    interval = rng.choice(len(weights), draws, p=weights / weights.sum())
    return float((edges[interval] + rng.random(draws) * np.diff(edges)[interval]).std())


def of_edges(weights: np.ndarray, edges: np.ndarray) -> float:
    ends = torch.tensor(edges).float()[None]
    return float(termination_std(torch.tensor(weights).float()[None], ends[:, :-1], ends[:, 1:]))


def test_it_is_the_spread_of_where_rays_end():
    rng = np.random.default_rng(1)
    edges = np.concatenate(([0.2], np.geomspace(1, 300, 25)))
    weights = rng.random(25) ** 4
    assert of_edges(weights, edges) == pytest.approx(drawn_std(weights, edges), rel=0.01)


def test_a_sample_is_as_unsure_as_it_is_long():
    assert of_edges(np.array([0, 0.7, 0]), np.array([0.0, 3.0, 3.6, 9.0])) == pytest.approx(0.6 / np.sqrt(12))


def test_what_passes_does_not_count():
    edges = np.array([0.0, 1.0, 2.0, 50.0])
    weights = np.array([0.1, 0.3, 0.05])
    assert of_edges(weights, edges) == pytest.approx(of_edges(2 * weights, edges))


def test_a_ray_that_nothing_stops_may_end_anywhere():
    assert of_edges(np.zeros(2), np.array([0.0, 1.0, 12.0])) == pytest.approx(12 / np.sqrt(12))


def test_a_kilometre_away_it_keeps_its_digits():
    """Squares of 900 m leave float32 no centimetres."""
    edges = 900 + np.array([0.0, 0.02, 0.04, 0.06])
    exact = float(np.sqrt((0.02**2 * 2 / 3) + 0.02**2 / 12))
    assert of_edges(np.ones(3), edges) == pytest.approx(exact, rel=0.01)
