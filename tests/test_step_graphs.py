"""Training steps that are recorded and replayed, with a stand-in for CUDA graphs that runs them again on the CPU."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from scenes import fisheye, write_scene
from torch.utils._pytree import tree_leaves
from trainings import trainer_of

from edge_depth_nerf.kernels.table_adam import SUMS_LATER
from edge_depth_nerf.plugin import step_graphs
from edge_depth_nerf.plugin.step_graphs import GpuCapture, StepGraphs, why_not
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainer
from edge_depth_nerf.plugin.upload import TableOnDevice

pytestmark = pytest.mark.slow

RECORD_AT = (8, 14, 20)
STEPS = 24


class RunAgain:
    """In place of CUDA graphs: a function that is run again, and whose results go where those of the recording are.

    Like a recording, it computes nothing the first time. Random numbers are refused while it records or runs again; and
    after a failure, as torch's generator does it, until what that leaves is restored.
    """

    def __init__(self, trainer: EdgeDepthTrainer, fails: str = "", failures: int = 99) -> None:
        self.trainer, self.fails, self.failures = trainer, fails, failures
        self.recorded = self.replays = self.recovered = 0
        self.is_spoilt = self.records = False

    def stream(self) -> Any:
        return contextlib.nullcontext()

    def record(self, work: Any) -> Any:
        with self._unchanged():
            if self.failures and (self.fails in ("middle", "end") or (self.fails == "second" and self.recorded == 1)):
                self.failures -= 1
                self._fail(work)
            kept = self._drawing_nothing(work)
        self.recorded += 1

        def replay() -> None:
            self.replays += 1
            for place, value in zip(tree_leaves(kept), tree_leaves(self._drawing_nothing(work)), strict=True):
                if isinstance(place, torch.Tensor):
                    place.copy_(value)

        return kept, replay

    def _drawing_nothing(self, work: Any) -> Any:
        self.records = True
        try:
            return work()
        finally:
            self.records = False

    def recover(self) -> None:
        self.recovered += 1
        self.is_spoilt = False

    def _fail(self, work: Any) -> None:
        def invalidated(*_: Any) -> Any:
            raise RuntimeError("operation not permitted when stream is capturing")

        with pytest.MonkeyPatch.context() as changed:
            if self.fails == "middle":
                changed.setattr(self.trainer.pipeline.model, "get_loss_dict", invalidated)
            try:
                work()
            finally:
                self.is_spoilt = True
        raise RuntimeError("operation failed due to a previous error during capture")

    @contextlib.contextmanager
    def _unchanged(self) -> Iterator[None]:
        """Take back what is changed: numbers, the next batch, and random numbers."""
        trainer, state = self.trainer, torch.get_rng_state()
        held: list[Any] = [trainer.pipeline.model, *trainer.optimizers.optimizers.values()]
        before = [copy.deepcopy(each.state_dict()) for each in held]
        batches: Any = trainer.pipeline.datamanager._batches
        starts = batches._starts.clone()
        try:
            yield
        finally:
            with torch.no_grad():
                for each, values in zip(held, before, strict=True):
                    for place, value in zip(tree_leaves(each.state_dict()), tree_leaves(values), strict=True):
                        if isinstance(place, torch.Tensor):
                            place.copy_(value)
            batches._starts.copy_(starts)
            torch.set_rng_state(state)


def trainer_in(folder: Path, name: str, **changes: Any) -> EdgeDepthTrainer:
    """A training whose batches come as on a GPU, with as many rays at each step."""
    changes = {"max_num_iterations": STEPS, **changes}
    # what changes beyond the eager steps
    changes |= {"model__proposal_weights_anneal_max_num_iters": 500.0, "model__surface_loss_final": 0.01}
    trainer = trainer_of(folder / "scene", folder / name, **changes)
    manager: Any = trainer.pipeline.datamanager
    model: Any = trainer.pipeline.model
    model._training_steps = STEPS  # of one that is taken up again, too
    manager._batches = TableOnDevice(manager.train_pixel_sampler.table, "cpu")
    manager.next_train = lambda step: (manager.set_next(step), manager.batch_of(manager.packed()))[1]
    for parameter in trainer.pipeline.model.parameters():
        if hasattr(parameter, SUMS_LATER):
            delattr(parameter, SUMS_LATER)  # of the CPU alone
    # both kinds of steps, from the first graph on
    sampler: Any = trainer.pipeline.model.proposal_sampler
    sampler.update_sched = lambda step: 2
    return trainer


def with_graphs(trainer: EdgeDepthTrainer, monkeypatch: pytest.MonkeyPatch, **fails: Any) -> RunAgain:
    capture = RunAgain(trainer, **fails)
    trainer.graphs = StepGraphs(trainer, capture)
    drawers = [(torch, "rand"), (torch, "randn"), (torch.Tensor, "uniform_"), (torch.Tensor, "normal_")]
    for holder, name in drawers:
        draw = getattr(holder, name)

        def drawn(*args: Any, draw: Any = draw, **kwargs: Any) -> Any:
            assert not capture.is_spoilt, "Offset increment outside graph capture encountered unexpectedly."
            assert not capture.records, "a recorded step draws random numbers"
            return draw(*args, **kwargs)

        monkeypatch.setattr(holder, name, drawn)
    return capture


def never_recorded(trainer: EdgeDepthTrainer) -> EdgeDepthTrainer:
    """The same steps, one after the other."""
    trainer.graphs = StepGraphs(trainer, RunAgain(trainer))
    trainer.graphs._try_to_record = lambda *_: None  # pyrefly: ignore[bad-assignment]
    return trainer


def losses_of(trainer: EdgeDepthTrainer, steps: range) -> list[dict[str, float]]:
    from nerfstudio.engine.callbacks import TrainingCallbackLocation as At

    found = []
    for step in steps:
        torch.manual_seed(step)
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=At.BEFORE_TRAIN_ITERATION)
        loss, losses, metrics = trainer.train_iteration(step)
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=At.AFTER_TRAIN_ITERATION)
        every: Any = {**losses, **metrics, "all": loss}
        found.append({name: float(value.detach()) for name, value in every.items()})
    return found


def assert_same(
    one: EdgeDepthTrainer, another: EdgeDepthTrainer, losses: list[Any], others: list[Any], tolerance: float
) -> None:
    """The same learning rates, losses and parameters."""
    for each, other in zip(losses, others, strict=True):
        assert other == pytest.approx(each, rel=tolerance)
    for (name, value), (_, found) in zip(
        one.pipeline.model.named_parameters(), another.pipeline.model.named_parameters(), strict=True
    ):
        # in the mean: Adam takes a gradient of next to nothing for a whole step, in a direction of chance
        assert float((value - found).detach().abs().sum()) <= tolerance * value.numel(), name
    rates = [
        [group["lr"] for optimizer in each.optimizers.optimizers.values() for group in optimizer.param_groups]
        for each in (one, another)
    ]
    assert rates[0] == rates[1] and all(isinstance(rate, float) for rate in rates[1])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"), [fisheye(24, 20)])


@pytest.fixture
def folder(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(step_graphs, "RECORD_AT", RECORD_AT)
    (tmp_path / "scene").symlink_to(scene)
    return tmp_path


@pytest.fixture(scope="module")
def computed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[EdgeDepthTrainer, list[dict[str, float]]]:
    """A training step by step, and its losses."""
    folder = tmp_path_factory.mktemp("computed")
    (folder / "scene").symlink_to(scene)
    trainer = never_recorded(trainer_in(folder, "run"))
    return trainer, losses_of(trainer, range(STEPS))


def test_the_first_steps_are_those_of_nerfstudios_trainer(folder):
    """But for learning rates and λ, which are of float32 on a GPU."""
    of_host, other = (trainer_in(folder, name) for name in ("host", "other"))
    losses = [losses_of(each, range(5)) for each in (of_host, never_recorded(other))]
    assert_same(of_host, other, *losses, tolerance=1e-4)


def test_replayed_steps_are_those_that_are_computed(folder, computed, monkeypatch):
    """Both kinds of steps, with λ, annealing and learning rates on their way; a checkpoint between loads."""
    replayed = trainer_in(folder, "replayed")
    capture = with_graphs(replayed, monkeypatch)
    found = losses_of(replayed, range(STEPS))
    assert replayed.graphs is not None
    assert (capture.recorded, replayed.graphs.recorded, capture.recovered) == (2, 2, 0)
    # all but those that were taken before a recording of their kind; proposal networks rest from the tenth step on
    assert STEPS - 10 - 4 <= capture.replays < STEPS - RECORD_AT[0]
    assert len({each["edge_loss"] for each in found}) == STEPS
    assert_same(computed[0], replayed, computed[1], found, tolerance=1e-6)
    replayed.save_checkpoint(STEPS - 1)
    again = trainer_in(folder, "again", load_dir=replayed.checkpoint_dir)
    assert again._start_step == STEPS
    # checkpoints do not keep how long the proposal networks have rested
    samplers: list[Any] = [each.pipeline.model.proposal_sampler for each in (again, replayed)]
    for name in ("_step", "_steps_since_update"):
        setattr(samplers[0], name, getattr(samplers[1], name))
    further = range(STEPS, STEPS + 2)
    assert losses_of(again, further)[0] == pytest.approx(losses_of(replayed, further)[0], rel=1e-4)


@pytest.mark.parametrize("fails", ["end", "second"])
def test_training_goes_on_after_a_failed_recording(folder, computed, fails, monkeypatch, capsys):
    """It is tried again later, then given up; steps, learning rates and batches are those of a training without."""
    trainer = trainer_in(folder, "fails")
    capture = with_graphs(trainer, monkeypatch, fails=fails)
    found = losses_of(trainer, range(STEPS))
    assert trainer.graphs is not None and trainer.graphs.has_ended and trainer.graphs.recorded == 0
    assert capture.recovered == 3 and (capture.replays > 0) == (fails == "second")
    # the last steps are those of nerfstudio's trainer
    assert_same(computed[0], trainer, computed[1], found, tolerance=1e-3)
    seen: list[Any] = [each.pipeline.datamanager.trained_on for each in (computed[0], trainer)]
    assert torch.equal(*seen)
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("continues without CUDA graphs") == 1 and "RuntimeError: operation" in said


def test_a_recording_that_works_later_is_used(folder, computed, monkeypatch):
    trainer = trainer_in(folder, "later")
    capture = with_graphs(trainer, monkeypatch, fails="middle", failures=1)
    found = losses_of(trainer, range(STEPS))
    assert trainer.graphs is not None and trainer.graphs.recorded == 2
    assert capture.recovered == 1 and STEPS - 14 - 4 <= capture.replays < STEPS - 14
    assert_same(computed[0], trainer, computed[1], found, tolerance=1e-6)


def test_what_was_not_recorded_is_computed_and_reported_once(folder, capsys, monkeypatch):
    trainer = trainer_in(folder, "run")
    capture = with_graphs(trainer, monkeypatch)
    losses_of(trainer, range(STEPS - 8))
    replays = capture.replays
    pipeline: Any = trainer.pipeline
    assert replays > 2 and trainer.graphs is not None
    for holder, name, value in (
        (pipeline.datamanager.train_pixel_sampler, "num_rays_per_batch", 48),
        (next(pipeline.model.field.parameters()), "requires_grad", False),
        (pipeline.model.config, "sky_loss_mult", 0.0),
        (trainer.graphs._noise, "asked", [1, 1]),
    ):
        assert trainer.graphs._state() == trainer.graphs._seen
        before = getattr(holder, name)
        setattr(holder, name, value)
        assert trainer.graphs._state() != trainer.graphs._seen, name
        setattr(holder, name, before)
    pipeline.model.config.sky_loss_mult = 0.0
    found = losses_of(trainer, range(STEPS - 8, STEPS - 5))
    assert capture.replays == replays and "sky_loss" not in found[-1]
    assert trainer.graphs.recorded == 0 and trainer.graphs.has_ended
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("continues without CUDA graphs") == 1 and "have changed" in said


class Generator:
    """As torch's of a GPU: after an interrupted recording it refuses to draw, until it is given another state."""

    def __init__(self, records: bool) -> None:
        self.state = SimpleNamespace(records=records, value=torch.zeros(1))

    def clone_state(self) -> Any:
        return Generator(records=False)

    def graphsafe_set_state(self, other: Any) -> None:
        self.state = other.state

    def set_state(self, state: torch.Tensor) -> None:
        assert not self.state.records
        self.state.value = state


def test_after_a_failure_the_generator_draws_again_what_it_would_have_drawn(monkeypatch):
    generator = Generator(records=True)
    capture: Any = object.__new__(GpuCapture)
    capture._device, capture._random_state, capture._pool = torch.device("cuda:0"), torch.tensor([7]), (0, 1)
    monkeypatch.setattr(torch.cuda, "default_generators", (generator,))
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 2))
    ended = []
    monkeypatch.setattr(torch._C, "_cuda_endAllocateToPool", lambda *given: ended.append(given), raising=False)
    capture.recover()
    assert not generator.state.records and generator.state.value == 7
    assert ended == [(0, (0, 1))] and capture._pool == (0, 2)  # to the one before torch still recorded


def test_a_recording_that_cannot_be_ended_leaves_the_stream_that_was(monkeypatch):
    """As in torch up to 2.11, whose way out ends with the error of the recording's end."""
    streams = ["the usual"]

    @contextlib.contextmanager
    def graph(*_: Any, stream: str, **__: Any) -> Iterator[None]:
        streams.append(stream)
        yield
        raise RuntimeError("operation failed due to a previous error during capture")

    capture: Any = object.__new__(GpuCapture)
    capture._device, capture._stream, capture._pool = torch.device("cuda:0"), "of recordings", (0, 1)
    for name, stand_in in (
        ("get_rng_state", lambda _: torch.zeros(1)),
        ("CUDAGraph", SimpleNamespace),
        ("graph", graph),
        ("current_stream", lambda _: streams[-1]),
        ("set_stream", streams.append),
    ):
        monkeypatch.setattr(torch.cuda, name, stand_in)
    with pytest.raises(RuntimeError, match="previous error"):
        capture.record(lambda: None)
    assert streams == ["the usual", "of recordings", "the usual"]


def test_where_it_is_not_possible_training_says_so(folder, capsys, monkeypatch):
    trainer: Any = trainer_of(folder / "scene", folder / "run")
    # on the CPU nobody expects it
    assert trainer.graphs is None and "CUDA graphs" not in capsys.readouterr().out
    assert why_not(trainer) is None
    model = trainer.pipeline.model
    for holder, name, value, why in (
        (trainer, "world_size", 2, "several processes train together"),
        (trainer, "gradient_accumulation_steps", {"fields": 2}, "gradients of several steps are added"),
        (trainer.config, "log_gradients", True, "gradients are logged"),
        (model, "fused", False, "implementation torch"),
        (model.config, "depth_loss", "urban-nerf-los", "changes at each step"),
        (model.config, "predict_normals", True, "normals are trained"),
        (trainer.optimizers.optimizers["fields"], "param_groups", [{"fused": None}], "an optimiser is not fused"),
        (step_graphs, "TableRayGenerator", str, "its cameras have no table of rays"),  # so that ours is another
    ):
        with monkeypatch.context() as changed:
            changed.setattr(holder, name, value)
            assert why in str(why_not(trainer))
            trainer._use_graphs(RunAgain(trainer))
            assert trainer.graphs is None and why in " ".join(capsys.readouterr().out.split())
    trainer._use_graphs(RunAgain(trainer))
    assert trainer.graphs is not None
