"""Torch on one thread, kernels on all: the numbers, and that a training step asks for it."""

from __future__ import annotations

import pytest
import torch

from edge_depth_nerf.kernels.hash_grid_numba import _threads
from edge_depth_nerf.kernels.threads import kernel_threads, torch_on_one_thread


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
