"""What a step and a view ask of a GPU, counted on tensors of one that is not there."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from benchmark_modules import benchmark_modules
from torch._subclasses.fake_tensor import FakeTensorMode

from edge_depth_nerf.method.depth_losses import LOSSES, Level, depth_loss
from edge_depth_nerf.method.losses import step_kernels
from edge_depth_nerf.plugin.exposure import Gains

pytestmark = pytest.mark.slow

MOST = {
    "full, a view": (159, 10.9),
    "full": (301, 2.4),
    "full, proposals rest": (247, 1.8),
    "full, poses": (667, 2.6),
    "lite": (273, 0.9),
    "paper": (243, 2.3),
}
"""Today's kernels, and gigabytes of torch's operations: to be lowered when fewer are needed, never raised."""
FORMS = {form.name: form for form in step_kernels()}


@pytest.fixture(scope="module")
def gpu_counts() -> Any:
    with benchmark_modules() as load:
        return load("speed.gpu_counts")


@pytest.fixture(scope="module")
def counts(gpu_counts, sample_drive, tmp_path_factory) -> dict[str, Any]:
    if reason := gpu_counts.why_not():
        pytest.skip(reason)
    return gpu_counts.in_a_process(list(MOST), sample_drive, tmp_path_factory.mktemp("gpu_counts"))


@pytest.mark.parametrize("case", MOST)
def test_it_runs_without_waiting_and_in_so_many_kernels(counts, case):
    found = counts[case]
    assert found["synchronisations"] == {}
    assert 0 < found["kernels"] <= MOST[case][0], found["parts"]
    assert found["triton_kernels"] > 0 and found["numba"] == []
    # torch's operations move so much
    assert 0 < found["gigabytes"] <= MOST[case][1], found["parts"]
    if "view" not in case:
        # a graph; beside it λ, the exponent of annealed weights and the learning rates are written, and random numbers
        # drawn in two calls; nothing is uploaded
        # poses have a learning rate of their own
        most = 6 if "poses" in case else 5
        assert found["uploads"] == [] and found["parts"]["beside the graph"]["kernels"] <= most


def test_the_field_is_asked_once_and_directions_once_a_ray(counts):
    """Two proposal networks and the field; at rest the former get no gradient."""
    for case, gradients in (("full", 3), ("full, proposals rest", 1), ("lite", 3)):
        names = counts[case]["names"]
        assert (names["triton:_encode_kernel"], names["triton:_table_gradient_kernel"]) == (3, gradients), case
        assert names["triton:_harmonics_kernel"] == 1, case
        # the edge loss, of each level that learns
        assert names["triton:_loss_kernel"] == gradients, case


def test_all_parameters_get_a_gradient_but_those_of_proposals_at_rest(counts):
    for case in ("full", "full, poses", "lite", "paper"):
        # nerfstudio's parameter that tells the device
        assert counts[case]["without_gradient"] == ["device_indicator_param"]
    resting = counts["full, proposals rest"]["without_gradient"]
    assert len(resting) > 1
    assert all(name == "device_indicator_param" or name.startswith("proposal_networks") for name in resting)


def test_the_counter_counts(gpu_counts):
    """Kernels, views, uploads from pinned memory, and all that waits."""
    counter = gpu_counts.Counter()
    on_host = torch.ones(5)
    with FakeTensorMode(allow_non_fake_inputs=True), counter:
        x = torch.full((5,), 2.0, device="cuda")
        with counter.during("sums"):
            (x + x.view(1, 5)).sum()
        assert (counter.counts.parts["other"].kernels, counter.counts.parts["sums"].kernels) == (1, 2)
        # two times five numbers read and five written, then five read and one written
        assert counter.counts.parts["sums"].bytes == 4 * (15 + 6)
        counter.pin(on_host).to("cuda", non_blocking=True)
        assert counter.counts.uploads == [20] and not counter.counts.synchronisations
        for waits in (
            lambda: x.sum().item(),
            lambda: x.cpu(),
            lambda: torch.tensor([1.0, 2.0], device="cuda"),
            lambda: torch.ones(5).to("cuda", non_blocking=True),  # not pinned
            lambda: torch.ones(5).to("cuda"),
        ):
            before = sum(counter.counts.synchronisations.values())
            waits()
            assert sum(counter.counts.synchronisations.values()) == before + 1
        assert counter.counts.uploads == [20]
        with pytest.raises(Exception, match="same device"):
            torch.add(x, torch.ones(5))


@pytest.mark.parametrize("what", ["gains of colours", "ds-nerf", "urban-nerf", "urban-nerf-los", *FORMS])
def test_an_operation_alone_copies_nothing_from_the_host(what, gpu_counts):
    counter = gpu_counts.Counter()
    with FakeTensorMode(), torch.device("cuda"):
        gains, colours, picture = Gains(3), torch.rand(7, 3), torch.zeros(7).long()
        examples = FORMS[what].in_a_step(torch.device("cuda")) if what in FORMS else []
        level = Level(torch.rand(7, 5), torch.rand(7, 5), torch.rand(7, 5), torch.rand(7), torch.rand(7))
        with counter:
            for each in examples:
                FORMS[what].formula(**each)
            (depth_loss(LOSSES[what](), [level]) if what in LOSSES else gains(colours, picture)).sum()
    assert counter.counts.parts["other"].kernels > 0 and not counter.counts.synchronisations


def test_a_kernel_of_triton_is_given_tensors_of_the_gpu(gpu_counts):
    counter, kernel = gpu_counts.Counter(), SimpleNamespace(__name__="kernel")
    with FakeTensorMode():
        counter.launch(kernel, torch.ones(3, device="cuda"), 3, SIZE=4)
        with pytest.raises(AssertionError, match="a tensor of the cpu"):
            counter.launch(kernel, torch.ones(3))
    assert counter.counts.names == {"triton:kernel": 1}
