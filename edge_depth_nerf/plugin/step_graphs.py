"""A whole training step as one launch on a GPU: batch, forward, losses, backward, unscaling, optimisers and scale.

Host-facing. The host needs several times longer to launch the kernels of a step than a GPU to run them. So each of the
two kinds of steps, with and without an update of the proposal networks, is recorded once as a CUDA graph and replayed.

A graph reads where it read when it was recorded. What differs between steps is put there before: the batch (on a table
that lies on the device the graph advances by itself), random numbers, λ, how far the sampler's weights are annealed,
and the learning rates. Anything else that changes (rays, parameters or options) ends this with one line that says why.

Nothing may be compiled, loaded or tried out in a recording. So the first steps run unrecorded, by the same function, on
the stream that records; a kind of step is recorded after it has run that way. If a recording fails, nothing is lost:
its step is done already. What torch leaves in the state of recording is restored, and it is tried again later.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import torch
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from edge_depth_nerf.plugin.fused.noise import Noise
from edge_depth_nerf.plugin.model import EdgeDepthNerfModel
from edge_depth_nerf.plugin.ray_table import TableRayGenerator
from edge_depth_nerf.plugin.step_losses import PriorLoss

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import Trainer

RECORD_AT = (20, 200, 1000)
"""Steps of this process from which on a recording is tried, after no, one and two failures."""
UNRECORDED = 3
"""A kind of step has run so often before it is recorded."""

Step = tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]
"""Sum of the losses, losses and metrics, as nerfstudio's `train_iteration` returns them."""


@runtime_checkable
class Capture(Protocol):
    """What records functions."""

    def stream(self) -> AbstractContextManager[None]:
        """Work on the stream that records."""
        ...

    def record(self, work: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
        """Record a function; give what it has returned, and what runs it again with its results in the same places."""
        ...

    def recover(self) -> None:
        """Restore what a failed recording leaves behind."""
        ...


class GpuCapture:
    """Records functions as CUDA graphs, which share their memory."""

    def __init__(self, device: torch.device | str) -> None:
        self._device = torch.device(device)
        self._stream = torch.cuda.Stream(self._device)
        self._pool = torch.cuda.graph_pool_handle()
        self._random_state = torch.empty(0)

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Work on the stream that records; what is before it and after it on the present stream waits."""
        self._stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(self._stream):
            yield
        torch.cuda.current_stream(self._device).wait_stream(self._stream)

    def record(self, work: Callable[[], Any]) -> tuple[Any, Callable[[], None]]:
        """Record a function."""
        self._random_state = torch.cuda.get_rng_state(self._device)
        graph, before = torch.cuda.CUDAGraph(), torch.cuda.current_stream(self._device)
        try:
            # the viewer's thread may use the GPU meanwhile, on its own stream
            with torch.cuda.graph(graph, pool=self._pool, stream=self._stream, capture_error_mode="thread_local"):
                found = work()
        finally:
            # a recording that cannot be ended stays on its stream
            torch.cuda.set_stream(before)
        return found, graph.replay

    def recover(self) -> None:
        """Give the generator a state that does not record, and the next recording memory of its own.

        A recording that was cut short leaves the one in a state that refuses to draw, and the other where torch still
        records to it.
        """
        index = torch.cuda.current_device() if self._device.index is None else self._device.index
        generator = torch.cuda.default_generators[index]
        generator.graphsafe_set_state(generator.clone_state())
        generator.set_state(self._random_state)
        with suppress(AttributeError, RuntimeError):  # not in each torch, and some have ended it
            torch._C._cuda_endAllocateToPool(index, self._pool)
        self._pool = torch.cuda.graph_pool_handle()


@dataclass(frozen=True)
class _Recorded:
    """A recorded step; the tensors are where each replay writes."""

    replay: Callable[[], None]
    result: Step
    outputs: dict[str, Any]
    trained_on: Tensor


class Numbers:
    """Numbers of a step where a graph reads them: weights of losses, the exponent of annealed ones, rates."""

    def __init__(self, count: int, device: torch.device | str) -> None:
        self.places = torch.zeros(count, device=device)
        self._held: list[float | None] = [None] * count

    def hold(self, numbers: Sequence[float]) -> None:
        """Write those that have changed, equal neighbours at once; a number goes with its kernel's launch."""
        first = 0
        for number, run in groupby(numbers):
            behind = first + len([*run])
            if any(held != number for held in self._held[first:behind]):
                self.places[first:behind].fill_(number)
            first = behind
        self._held = [*numbers]


def updates_proposals(sampler: ProposalNetworkSampler) -> bool:
    """Say whether the next step trains the proposal networks, as nerfstudio's sampler decides it."""
    return sampler._steps_since_update > sampler.update_sched(sampler._step) or sampler._step < 10


def why_not(trainer: Trainer) -> str | None:
    """Say why the steps of a training cannot be recorded; None where they can."""
    pipeline: Any = trainer.pipeline
    model: EdgeDepthNerfModel = pipeline.model
    if not model.fused:
        return "nerfstudio's own code (--pipeline.model.implementation torch) copies from the host"
    if trainer.world_size > 1:
        return "several processes train together"
    if any(steps > 1 for steps in trainer.gradient_accumulation_steps.values()):
        return "gradients of several steps are added"
    if trainer.config.log_gradients:
        return "gradients are logged"
    if any(isinstance(loss, PriorLoss) and loss.loss.varies for loss in model.step_losses.values()):
        return f"the loss {model.config.depth_loss} changes at each step"
    if model.config.predict_normals:
        return "normals are trained"
    if not all(group.get("fused") for each in trainer.optimizers.optimizers.values() for group in each.param_groups):
        return "an optimiser is not fused"
    if not isinstance(pipeline.datamanager.train_ray_generator, TableRayGenerator):
        return "its cameras have no table of rays: many large lenses, or neither fisheye nor perspective"
    return None


class StepGraphs:
    """Takes the training steps of a trainer, after the first ones by replaying them."""

    def __init__(self, trainer: Trainer, capture: Capture) -> None:
        """Record nothing yet.

        Args:
            trainer: of an EdgeDepthPipeline, set up.
            capture: records a function.
        """
        self._trainer, self._capture = trainer, capture
        self._pipeline: Any = trainer.pipeline
        self._optimizers = list(trainer.optimizers.optimizers.values())
        self._parameters = [each for group in trainer.optimizers.parameters.values() for each in group]
        self._groups = [group for optimizer in self._optimizers for group in optimizer.param_groups]
        self._numbers = Numbers(3 + len(self._groups), trainer.device)
        self._noise = Noise(trainer.device)
        self._recorded: dict[bool, _Recorded] = {}
        self._taken: Counter[bool] = Counter()
        self._failures = 0
        self._seen: tuple[Any, ...] = ()

    @property
    def recorded(self) -> int:
        """Count the kinds of steps that are replayed; 0 before the first recording and after a failure."""
        return len(self._recorded)

    @property
    def has_ended(self) -> bool:
        """Whether no step will be recorded or replayed any more."""
        return self._failures >= len(RECORD_AT)

    def step(self, step: int) -> Step | None:
        """Take the training step of this number.

        Returns:
            Sum of the losses, losses and metrics, until the next replay; None where this has ended: the caller has to
            take the step.
        """
        if self._recorded and self._state() != self._seen:
            self._failures = len(RECORD_AT)
            self._say(step, "the rays of a batch, the parameters or the model's options have changed")
            self._forget()
        if self.has_ended:
            return None
        sampler = self._pipeline.model.proposal_sampler
        updates, since = updates_proposals(sampler), sampler._steps_since_update
        self._pipeline.detail.forget()
        self._pipeline.datamanager.set_next(step)
        self._numbers.hold(self._numbers_now())
        self._noise.draw()
        if (recorded := self._recorded.get(updates)) is not None:
            recorded.replay()
            # nerfstudio's sampler counts steps itself, where it is asked
            sampler._steps_since_update = 0 if updates else since
            self._pipeline.datamanager.trained_on = recorded.trained_on
            result, outputs = recorded.result, recorded.outputs
        else:
            with self._capture.stream():
                result, outputs, _ = self._work()
            self._taken[updates] += 1
            if self._taken.total() >= RECORD_AT[self._failures] and self._taken[updates] >= UNRECORDED:
                self._try_to_record(step, updates, since)
        self._pipeline.look_for_not_finite(step, outputs, result[1])
        self._step_schedulers(step)
        return result

    def _numbers_now(self) -> list[float]:
        """Give what differs between steps."""
        model = self._pipeline.model
        rates = [float(group["lr"]) for group in self._groups]
        return [*map(float, model.weights_now()), float(model.proposal_sampler._anneal), *rates]

    def _step_schedulers(self, step: int) -> None:
        """Continue the learning rates, as nerfstudio's trainer does where the scale has not fallen."""
        scaler: Any = self._trainer.grad_scaler
        before = scaler.get_scale()
        scaler.look()
        if before <= scaler.get_scale():
            self._trainer.optimizers.scheduler_step_all(step)

    def _state(self) -> tuple[Any, ...]:
        """Collect what must not change after a step was recorded."""
        pipeline = self._pipeline
        return (
            pipeline.datamanager.rays_of_a_step(),
            self._noise.asked,
            pipeline.training,
            pipeline.model.config,
            tuple((each.data_ptr(), each.requires_grad) for each in self._parameters),
        )

    def _try_to_record(self, step: int, updates: bool, since: int) -> None:
        """Record a kind of step that has just been taken."""
        sampler = self._pipeline.model.proposal_sampler
        after, trained_on = sampler._steps_since_update, self._pipeline.datamanager.trained_on
        # so that it is of the same kind
        sampler._steps_since_update = since
        try:
            (result, outputs, of_rays), replay = self._capture.record(self._work)
            self._recorded[updates] = _Recorded(replay, result, outputs, of_rays)
            self._seen = copy.deepcopy(self._state())  # options may be changed in place
        except Exception as error:  # whatever keeps steps from being recorded here
            self._failures += 1
            if self._failures == 1:
                self._say(step, f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}")
            self._forget()
            self._capture.recover()
        finally:
            sampler._steps_since_update = after
            self._pipeline.datamanager.trained_on = trained_on

    def _say(self, step: int, why: str) -> None:
        CONSOLE.print(
            f"Step {step}: training continues without CUDA graphs, slower but with the same results ({why}).",
            style="yellow",
            soft_wrap=True,
            highlight=False,
            markup=False,
        )

    def _forget(self) -> None:
        """Drop all graphs and what an interrupted step may have left."""
        self._recorded.clear()
        torch.clear_autocast_cache()
        scaler: Any = self._trainer.grad_scaler
        scaler.forget()
        for optimizer in self._optimizers:
            optimizer.zero_grad(set_to_none=True)
            for name in ("grad_scale", "found_inf"):
                vars(optimizer).pop(name, None)

    def _work(self) -> tuple[Step, dict[str, Any], Tensor]:
        """Take a step from reading the batch to the scale of mixed precision; all that is recorded.

        Returns:
            Sum of the losses, losses and metrics; the model's outputs; which pixels were trained on.
        """
        trainer, pipeline = self._trainer, self._pipeline
        device_type = torch.device(trainer.device).type
        # a cast that autocast has kept from before would not be part of a recording
        torch.clear_autocast_cache()
        with self._on_device(), self._noise.given(), torch.autocast(device_type, enabled=trainer.mixed_precision):
            manager = pipeline.datamanager
            outputs, losses, metrics = pipeline.computed(*manager.batch_of(manager.packed()))
            loss = torch.stack([*losses.values()]).sum()
            with torch.autocast(device_type, enabled=False):
                gradients = torch.autograd.grad(trainer.grad_scaler.scale(loss), self._parameters, allow_unused=True)
                for parameter, gradient in zip(self._parameters, gradients, strict=True):
                    parameter.grad = gradient
                trainer.optimizers.optimizer_scaler_step_all(trainer.grad_scaler)
                pipeline.count_not_finite(loss)
                torch.amp.GradScaler.update(trainer.grad_scaler)
        torch.clear_autocast_cache()
        outputs = {name: each.detach() if isinstance(each, Tensor) else each for name, each in outputs.items()}
        losses, metrics = ({name: each.detach() for name, each in named.items()} for named in (losses, metrics))
        return (loss.detach(), losses, metrics), outputs, manager.trained_on

    @contextmanager
    def _on_device(self) -> Iterator[None]:
        """Let model and optimisers read their numbers from the device, where they can change without the host."""
        model = self._pipeline.model
        sampler: Any = model.proposal_sampler
        depth, surface, anneal, *rates = self._numbers.places.unbind()
        before = sampler._anneal, [(group["lr"], group["capturable"]) for group in self._groups]
        model.scheduled_weights, sampler._anneal = (depth, surface), anneal
        for group, rate in zip(self._groups, rates, strict=True):
            group["lr"], group["capturable"] = rate, True
        try:
            yield
        finally:
            model.scheduled_weights, sampler._anneal = None, before[0]
            for group, (rate, capturable) in zip(self._groups, before[1], strict=True):
                group["lr"], group["capturable"] = rate, capturable
