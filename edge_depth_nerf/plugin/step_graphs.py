"""A training step as one launch: CUDA graphs of what lies between a batch's upload and its gradients.

Host-facing. **No GPU has run this; it is off unless it is asked for** (`--cuda-graphs True`). The host needs longer to
launch the kernels of a step than a fast GPU to run them, so a graph is recorded once and launched as a whole: one of
the steps that update the proposal networks, one of those that do not.

A graph records decoding, rays, forward, losses and backward, but not optimisers, scaler and schedulers. It reads where
it read when it was recorded, so everything that differs between steps is put there before: the packed batch, λ, and how
far the sampler's weights are annealed. Anything else that changes (rays, parameters or options) ends this, with one
line that says why, and training continues without.

As torch's notes on CUDA graphs ask, it warms up on a stream of its own, takes gradients by `torch.autograd.grad` into
the graph's memory, and uses no cast that autocast kept from before.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from edge_depth_nerf.plugin.model import EdgeDepthNerfModel
from edge_depth_nerf.plugin.step_losses import PriorLoss

EAGER_STEPS = 20
"""So many steps are taken first without a graph: kernels are compiled and measured, the scaler is made."""
WARM_UPS = 3
"""Runs before the recording, on the stream that torch's notes ask for."""

Capture = Callable[[Callable[[], Any]], tuple[Any, Callable[[], None]]]
"""Records a function; gives what it has returned, and what runs it again with its results in the same places."""
Step = tuple[dict[str, Any], dict[str, Tensor], dict[str, Tensor]]
"""Outputs, losses and metrics."""


class GpuCapture:
    """Records functions as CUDA graphs, which share their memory."""

    def __init__(self) -> None:
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, work: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
        """Record a function."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UPS):
                work()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        # the viewer's thread may use the GPU meanwhile, on its own stream
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
            found = work()
        return found, graph.replay


@dataclass(frozen=True)
class _Recorded:
    """A recorded step; the tensors are where each replay writes."""

    replay: Callable[[], None]
    outputs: dict[str, Any]
    names: list[str]
    losses: Tensor
    metrics: dict[str, Tensor]
    gradients: list[Tensor | None]
    trained_on: Tensor


class _Gradients(torch.autograd.Function):
    """Losses of a replay; backward hands over the gradients that the replay has made, already scaled."""

    @staticmethod
    def forward(ctx: Any, start: Tensor, losses: Tensor, parameters: list[Tensor], gradients: list[Any]) -> Tensor:
        ctx.parameters, ctx.gradients = parameters, gradients
        return losses.clone()

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[None, ...]:
        # torch would copy them, as the graph keeps them
        for parameter, gradient in zip(ctx.parameters, ctx.gradients, strict=True):
            parameter.grad = gradient
        return None, None, None, None


def schedule(model: EdgeDepthNerfModel) -> tuple[float, float]:
    """Give what differs between steps: λ, and the exponent by which the sampler's weights are annealed."""
    return float(model.depth_weight()), float(model.proposal_sampler._anneal)


@contextmanager
def scheduled_by(model: EdgeDepthNerfModel, numbers: Float[Tensor, "2"]) -> Iterator[None]:
    """Let a model take what `schedule` gives from a tensor, where it can change without the host."""
    sampler: Any = model.proposal_sampler
    before = sampler._anneal
    model.scheduled_weight, sampler._anneal = numbers[0], numbers[1]
    try:
        yield
    finally:
        model.scheduled_weight, sampler._anneal = None, before


def updates_proposals(sampler: ProposalNetworkSampler) -> bool:
    """Say whether the next step trains the proposal networks, as nerfstudio's sampler decides it."""
    return sampler._steps_since_update > sampler.update_sched(sampler._step) or sampler._step < 10


def why_not(model: EdgeDepthNerfModel, device: str, world_size: int, accumulates: bool) -> str | None:
    """Say why the steps of a training cannot be recorded; None where they can.

    Args:
        model: what is trained.
        device: where.
        world_size: processes that train together.
        accumulates: whether gradients of several steps are added.
    """
    if torch.device(device).type != "cuda":
        return "there is no GPU"
    if world_size > 1:
        return "several processes train together"
    if accumulates:
        return "gradients of several steps are added"
    if any(isinstance(loss, PriorLoss) and loss.loss.varies for loss in model.step_losses.values()):
        return f"the loss {model.config.depth_loss} changes at each step"
    if model.config.predict_normals:
        return "normals are trained"
    return None


class StepGraphs:
    """Replays training steps of a pipeline."""

    def __init__(self, pipeline: Any, scale: Callable[[Tensor], Tensor], capture: Capture) -> None:
        """Record nothing yet.

        Args:
            pipeline: an EdgeDepthPipeline.
            scale: of mixed precision, applied to the loss.
            capture: records a function.
        """
        self._pipeline, self._scale, self._capture = pipeline, scale, capture
        self._parameters: list[Tensor] = [each for group in pipeline.get_param_groups().values() for each in group]
        self._recorded: dict[bool, _Recorded] = {}
        self._is_off = False
        self._eager_steps = 0
        self._seen: tuple[Any, ...] = ()
        self._packed = self._schedule = self._start = torch.empty(0)

    @property
    def recorded(self) -> int:
        """Count the kinds of steps that are replayed; 0 before the first recording and after this has ended."""
        return len(self._recorded)

    def replayed(self, packed: Tensor, step: int) -> Step | None:
        """Take a step with a batch by a graph, but for the optimisers.

        Args:
            packed: the uploaded batch.
            step: its number, for what is printed.

        Returns:
            Outputs, losses and metrics, until the next replay; None where the caller has to compute them.
        """
        if self._is_off:
            return None
        if self._eager_steps < EAGER_STEPS:
            self._eager_steps += 1
            return None
        try:
            return self._replayed(packed)
        except Exception as error:  # whatever keeps steps from being recorded here
            self._is_off = True
            self._recorded.clear()
            CONSOLE.print(
                f"Step {step}: training continues without CUDA graphs ({type(error).__name__}: {error}).",
                style="yellow",
                soft_wrap=True,
                highlight=False,
                markup=False,
            )
            return None

    def _replayed(self, packed: Tensor) -> Step:
        model: EdgeDepthNerfModel = self._pipeline.model
        seen = self._state(packed)
        if not self._seen:
            self._seen = copy.deepcopy(seen)  # options may be changed in place
            self._packed = torch.empty_like(packed)
            self._schedule = torch.empty(2, device=packed.device)
            self._start = torch.zeros((), device=packed.device, requires_grad=True)
        if seen != self._seen:
            raise RuntimeError("the rays of a batch, the parameters or the model's options have changed")
        self._packed.copy_(packed)
        # numbers of the host, which a kernel's launch takes with it: no copy that has to be waited for
        for place, number in enumerate(schedule(model)):
            self._schedule[place].fill_(number)
        updated = updates_proposals(model.proposal_sampler)
        if updated not in self._recorded:
            self._recorded[updated] = self._record(model)
        recorded, sampler = self._recorded[updated], model.proposal_sampler
        since = sampler._steps_since_update
        recorded.replay()
        # nerfstudio's sampler counts steps itself, where it is asked
        sampler._steps_since_update = 0 if updated else since
        self._pipeline.datamanager.trained_on = recorded.trained_on
        losses = _Gradients.apply(self._start, recorded.losses, self._parameters, recorded.gradients)
        assert isinstance(losses, Tensor)
        return recorded.outputs, dict(zip(recorded.names, losses.unbind(), strict=True)), recorded.metrics

    def _state(self, packed: Tensor) -> tuple[Any, ...]:
        """Collect what must not change after a step was recorded."""
        pipeline = self._pipeline
        return (
            packed.shape,
            pipeline.datamanager.train_pixel_sampler.num_rays_per_batch,
            pipeline.training,
            pipeline.model.config,
            tuple((each.data_ptr(), each.requires_grad) for each in self._parameters),
        )

    def _record(self, model: EdgeDepthNerfModel) -> _Recorded:
        pipeline, manager = self._pipeline, self._pipeline.datamanager
        before = model.proposal_sampler._steps_since_update

        def work() -> tuple[Any, ...]:
            # each run is of one kind
            model.proposal_sampler._steps_since_update = before
            torch.clear_autocast_cache()
            with scheduled_by(model, self._schedule):
                rays, batch = manager.batch_of(self._packed)
                outputs = pipeline._model(rays, batch)
                metrics = model.get_metrics_dict(outputs, batch)
                losses = model.get_loss_dict(outputs, batch, metrics)
            total = functools.reduce(torch.add, losses.values())
            with torch.autocast(self._packed.device.type, enabled=False):
                gradients = torch.autograd.grad(self._scale(total), self._parameters, allow_unused=True)
            torch.clear_autocast_cache()
            every = torch.stack([loss.detach() for loss in losses.values()])
            outputs = {name: each.detach() if isinstance(each, Tensor) else each for name, each in outputs.items()}
            metrics = {name: each.detach() for name, each in metrics.items()}
            return outputs, list(losses), every, metrics, list(gradients), manager.trained_on

        try:
            found, replay = self._capture(work)
        finally:
            model.proposal_sampler._steps_since_update = before
        return _Recorded(replay, *found)
