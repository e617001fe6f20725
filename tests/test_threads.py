"""Torch on one thread, kernels on all: the numbers, and that a training step asks for it."""

from collections.abc import Callable
from threading import Event, Thread

import numpy as np
import pytest
import torch

from edge_depth_nerf.kernels import contraction_numba, ray_numba, threads
from edge_depth_nerf.kernels.hash_grid_numba import _threads
from edge_depth_nerf.kernels.threads import kernel_threads, take_all_threads, torch_on_one_thread


@pytest.fixture
def three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
def test_kernels_keep_the_threads_that_torch_gives_up():
    assert kernel_threads() == 3
    with torch_on_one_thread():
        assert (torch.get_num_threads(), kernel_threads()) == (1, 3)
        # large work is shared out, small work is not
        assert (_threads(1 << 20, 4), _threads(1, 4)) == (3, 1)
        with torch_on_one_thread():
            assert (torch.get_num_threads(), kernel_threads()) == (1, 3)
        assert (torch.get_num_threads(), kernel_threads()) == (1, 3)
    assert (torch.get_num_threads(), kernel_threads()) == (3, 3)


@pytest.mark.usefixtures("three_threads")
def test_an_error_gives_torch_its_threads_back():
    with pytest.raises(ZeroDivisionError), torch_on_one_thread():
        _ = 1 / 0
    assert (torch.get_num_threads(), kernel_threads()) == (3, 3)


@pytest.mark.usefixtures("three_threads")
def test_a_viewer_that_begins_during_a_step_renders_on_all_threads():
    begun, done, found = Event(), Event(), []

    def view() -> None:
        torch.ones(10).add_(1)
        found.append(torch.get_num_threads())
        begun.set()
        done.wait()
        found.append(torch.get_num_threads())
        take_all_threads()
        found.append(torch.get_num_threads())

    viewer = Thread(target=view)
    with torch_on_one_thread():
        viewer.start()
        begun.wait()
        take_all_threads()
        assert torch.get_num_threads() == 1
    done.set()
    viewer.join()
    # without that it would stay at one
    assert found == [1, 1, 3]
    torch.set_num_threads(2)
    take_all_threads()
    assert torch.get_num_threads() == 2


def places() -> torch.Tensor:
    edges, weights = torch.rand(7, 10).sort(dim=1)[0], torch.rand(7, 9)
    return ray_numba.sample_pdf(weights, edges, torch.rand(7, 5).sort(dim=1)[0], 0.01, 1e-5)


def interlevel_loss() -> tuple[torch.Tensor, torch.Tensor]:
    edges, outer_edges = (torch.rand(7, count).sort(dim=1)[0] for count in (6, 9))
    outer_weights = (torch.rand(7, 8) / 50).requires_grad_()
    loss = ray_numba.interlevel_loss(edges, torch.rand(7, 5), outer_edges, outer_weights)
    return loss.detach(), torch.autograd.grad(loss, outer_weights)[0]


def contracted() -> tuple[torch.Tensor, ...]:
    return contraction_numba.contract(4 * torch.randn(11, 3))


@pytest.mark.parametrize("work", [places, interlevel_loss, contracted])
def test_the_same_on_three_threads(work: Callable[[], torch.Tensor | tuple[torch.Tensor, ...]], monkeypatch):
    def once() -> list[np.ndarray]:
        torch.manual_seed(3)
        found = work()
        return [each.numpy() for each in ([found] if isinstance(found, torch.Tensor) else found)]

    alone = once()
    shares = []
    given = threads.share_out

    def counted(work, parts) -> None:
        shares.append(len(parts))
        given(work, parts)

    monkeypatch.setattr(threads, "share_out", counted)
    monkeypatch.setattr(threads, "kernel_threads", lambda: 3)
    for module in (ray_numba, contraction_numba):
        for name in ("LEAST_SHARE", "LEAST_WALKED"):
            monkeypatch.setattr(module, name, 2, raising=False)
    for together, one in zip(once(), alone, strict=True):
        np.testing.assert_allclose(together, one, rtol=1e-6)
    assert 3 in shares
