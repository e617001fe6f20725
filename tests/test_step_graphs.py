"""Training steps that are recorded and replayed, with a stand-in for CUDA graphs that runs them again on the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from scenes import write_scene
from torch.utils._pytree import tree_leaves
from trainings import trainer_of

from edge_depth_nerf.kernels.table_adam import SUMS_LATER
from edge_depth_nerf.plugin.step_graphs import EAGER_STEPS, StepGraphs, why_not
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainer

pytestmark = pytest.mark.slow

STEPS = EAGER_STEPS + 12


class RunAgain:
    """In place of a graph: a function that is run again, and whose results go where those of the recording are."""

    def __init__(self) -> None:
        self.recorded = self.replays = 0

    def __call__(self, work: Any) -> Any:
        self.recorded += 1
        # a recording computes nothing
        state = torch.get_rng_state()
        kept = work()
        torch.set_rng_state(state)

        def replay() -> None:
            self.replays += 1
            for place, value in zip(tree_leaves(kept), tree_leaves(work()), strict=True):
                if isinstance(place, torch.Tensor):
                    place.copy_(value)

        return kept, replay


def trainer_in(folder: Path, name: str, **changes: Any) -> EdgeDepthTrainer:
    """A training whose batches come as on a GPU, with as many rays at each step."""
    # annealed beyond the eager steps
    changes |= {"max_num_iterations": STEPS, "model__proposal_weights_anneal_max_num_iters": 500.0}
    trainer = trainer_of(folder / "scene", folder / name, **changes)
    manager: Any = trainer.pipeline.datamanager
    model: Any = trainer.pipeline.model
    model._training_steps = STEPS  # of one that is taken up again, too
    manager.next_train = lambda step: manager.batch_of(manager.upload(step))
    for parameter in trainer.pipeline.model.parameters():
        if hasattr(parameter, SUMS_LATER):
            delattr(parameter, SUMS_LATER)  # of the CPU alone
    # both kinds of steps, from the first graph on
    sampler: Any = trainer.pipeline.model.proposal_sampler
    sampler.update_sched = lambda step: 2
    return trainer


def with_graphs(trainer: EdgeDepthTrainer) -> RunAgain:
    capture = RunAgain()
    pipeline: Any = trainer.pipeline
    pipeline.graphs = StepGraphs(pipeline, trainer.grad_scaler.scale, capture)
    return capture


def losses_of(trainer: EdgeDepthTrainer, steps: range) -> list[dict[str, float]]:
    from nerfstudio.engine.callbacks import TrainingCallbackLocation as At

    found = []
    for step in steps:
        torch.manual_seed(step)
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=At.BEFORE_TRAIN_ITERATION)
        _, losses, metrics = trainer.train_iteration(step)
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, location=At.AFTER_TRAIN_ITERATION)
        found.append({name: float(value.detach()) for name, value in {**losses, **metrics}.items()})
    return found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_scene(tmp_path / "scene")
    return tmp_path


def test_replayed_steps_are_those_that_are_computed(folder):
    """Both kinds of steps, with λ and the sampler's annealing on their way; a checkpoint between loads."""
    computed, replayed = (trainer_in(folder, name) for name in ("computed", "replayed"))
    capture = with_graphs(replayed)
    expected, found = (losses_of(trainer, range(STEPS)) for trainer in (computed, replayed))
    assert (capture.recorded, capture.replays) == (2, STEPS - EAGER_STEPS)
    assert replayed.pipeline.graphs.recorded == 2  # pyright: ignore[reportAttributeAccessIssue]
    assert len({each["edge_loss"] for each in found}) == STEPS
    for one, another in zip(expected, found, strict=True):
        assert set(one) == set(another)
        assert another == pytest.approx(one, rel=1e-4)
    for (name, one), another in zip(
        computed.pipeline.model.named_parameters(), replayed.pipeline.model.parameters(), strict=True
    ):
        assert torch.allclose(one, another, atol=1e-4), name
    replayed.save_checkpoint(STEPS - 1)
    again = trainer_in(folder, "again", load_dir=replayed.checkpoint_dir)
    assert again._start_step == STEPS
    # checkpoints do not keep how long the proposal networks have rested
    samplers: list[Any] = [each.pipeline.model.proposal_sampler for each in (again, replayed)]
    for name in ("_step", "_steps_since_update"):
        setattr(samplers[0], name, getattr(samplers[1], name))
    further = range(STEPS, STEPS + 2)
    assert losses_of(again, further)[0] == pytest.approx(losses_of(replayed, further)[0], rel=1e-4)


@pytest.mark.parametrize("change", ["rays", "options", "trained"])
def test_what_was_not_recorded_is_computed_and_reported_once(folder, change, capsys):
    trainer = trainer_in(folder, "run")
    capture = with_graphs(trainer)
    losses_of(trainer, range(EAGER_STEPS + 4))
    replays = capture.replays
    pipeline: Any = trainer.pipeline
    model = pipeline.model
    assert replays == 4
    if change == "rays":
        pipeline.datamanager.train_pixel_sampler.num_rays_per_batch = 48
    elif change == "options":
        model.config.sky_loss_mult = 0.0
    else:
        next(model.field.parameters()).requires_grad_(False)
    found = losses_of(trainer, range(EAGER_STEPS + 4, EAGER_STEPS + 7))
    assert capture.replays == replays
    assert ("sky_loss" in found[-1]) == (change != "options")
    assert pipeline.graphs.recorded == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("continues without CUDA graphs") == 1 and "have changed" in said


def test_an_error_while_recording_loses_no_batch(folder, capsys):
    computed, trainer = (trainer_in(folder, name) for name in ("computed", "fails"))
    with_graphs(trainer)

    def fails(work: Any) -> Any:
        work()
        raise RuntimeError("operation not permitted when stream is capturing")

    pipeline: Any = trainer.pipeline
    pipeline.graphs._capture = fails
    steps = range(EAGER_STEPS + 2)
    seen = []
    for each in (computed, trainer):
        losses_of(each, steps)
        seen.append(each.pipeline.datamanager.trained_on)
    assert torch.equal(*seen)
    assert "operation not permitted when stream is capturing" in " ".join(capsys.readouterr().out.split())


def test_where_it_is_not_possible_training_says_so(folder, capsys):
    trainer = trainer_of(folder / "scene", folder / "run", cuda_graphs=True)
    assert trainer.pipeline.graphs is None  # pyright: ignore[reportAttributeAccessIssue]
    assert "without CUDA graphs: there is no GPU" in " ".join(capsys.readouterr().out.split())
    model: Any = trainer.pipeline.model
    assert why_not(model, "cuda:0", 1, False) is None
    assert why_not(model, "cuda:0", 2, False) == "several processes train together"
    assert why_not(model, "cuda:0", 1, True) == "gradients of several steps are added"
    for name, value, why in (("depth_loss", "urban-nerf-los", "changes"), ("predict_normals", True, "normals")):
        before = getattr(model.config, name)
        setattr(model.config, name, value)
        assert why in str(why_not(model, "cuda:0", 1, False))
        setattr(model.config, name, before)
