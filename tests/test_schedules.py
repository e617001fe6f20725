"""Learning rates and warm-ups follow the length of the training."""

from __future__ import annotations

from contextlib import nullcontext
from copy import deepcopy
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import tyro
from models import build
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from scenes import fisheye, write_scene
from trainings import trainer_of

from edge_depth_nerf.plugin.config import read_method_file
from edge_depth_nerf.plugin.schedules import TrainingScheduleConfig, follow_training, in_steps
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainer

METHODS = [*read_method_file()["methods"]]
STEPS = 3


def optimizers_of(config: Any) -> Optimizers:
    """Its optimisers, each of one number that has no gradient."""
    groups = {name: [torch.nn.Parameter(torch.zeros(1))] for name in config.optimizers}
    return Optimizers(deepcopy(config.optimizers), groups)


def rates_of(optimizers: Optimizers, steps: int) -> dict[str, list[float]]:
    """Learning rates from the first step until after the last."""
    return {
        name: [scheduler.base_lrs[0] * scheduler.lr_lambdas[0](step) for step in range(steps + 1)]
        for name, scheduler in optimizers.schedulers.items()
    }


def rates_of_training(config: Any, steps: int) -> dict[str, list[float]]:
    optimizers = optimizers_of(config)
    follow_training(optimizers, steps)
    return rates_of(optimizers, steps)


def test_lite_has_at_its_own_length_the_rates_that_its_figures_were_made_with():
    config = deepcopy(all_methods["edge-depth-nerf-lite"])
    found = rates_of_training(config, 2000)
    for group, last, warmup in (("fields", 2e-3, 0), ("proposal_networks", 2e-3, 0), ("camera_opt", 1e-4, 200)):
        schedule = ExponentialDecaySchedulerConfig(lr_final=last, max_steps=2000, warmup_steps=warmup)
        config.optimizers[group]["scheduler"] = schedule
    assert found == rates_of(optimizers_of(config), 2000)
    assert found["fields"][0] == 0.02


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("steps", [1, 7, 5000])
def test_the_last_rate_is_lr_final_after_any_number_of_steps(method, steps):
    config = all_methods[method]
    rates = rates_of_training(config, steps)
    assert {"fields", "proposal_networks"} <= {*rates}
    for name, (first, *between, last) in rates.items():
        each = config.optimizers[name]
        assert last == pytest.approx(each["scheduler"].lr_final)
        after_warmup = between[in_steps(each["scheduler"].warmup_steps, steps) :]
        assert all(rate > last for rate in after_warmup)
        assert first == pytest.approx(each["optimizer"].lr) or (name == "camera_opt" and first < last)


def test_the_command_line_sets_ends_and_lengths():
    config = deepcopy(all_methods["edge-depth-nerf"])
    for group, options in {
        "fields": ("--lr-final", "0.0005", "--warmup-steps", "0.2"),
        "proposal_networks": ("--max-steps", "10"),
        "camera_opt": ("--warmup-steps", "20"),
    }.items():
        default = config.optimizers[group]["scheduler"]
        config.optimizers[group]["scheduler"] = tyro.cli(TrainingScheduleConfig, default=default, args=options)
    found = rates_of_training(config, 50)
    fields, proposals, poses = (found[name] for name in ("fields", "proposal_networks", "camera_opt"))
    assert (max(fields), fields.index(max(fields)), fields[-1]) == pytest.approx((0.01, 10, 0.0005))
    assert proposals[9] > proposals[10] == pytest.approx(1e-3) == proposals[-1]
    assert poses.index(max(poses)) == 20
    # a warm-up as long as the training has no end to divide by
    config.optimizers["fields"]["scheduler"].warmup_steps = 50.0
    assert rates_of_training(config, 50)["fields"][-1] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("length", "steps", "expected"),
    [(0.25, 2000, 500), (0.25, 1000, 250), (500.0, 1000, 500), (1.0, 1000, 1), (0.25, 1, 1), (1 / 6, 30_000, 5000)],
)
def test_warm_ups_of_the_proposals_are_shares_or_steps(length, steps, expected):
    model = build(proposal_warmup=length, proposal_weights_anneal_max_num_iters=length)
    trainer = SimpleNamespace(_start_step=steps // 4, config=SimpleNamespace(max_num_iterations=steps - steps // 4))
    optimizers = optimizers_of(SimpleNamespace(optimizers={}))
    given: Any = {"optimizers": optimizers, "grad_scaler": None, "pipeline": None, "trainer": trainer}
    anneal = model.get_training_callbacks(TrainingCallbackAttributes(**given))[0]
    every, slope = model.config.proposal_update_every, model.config.proposal_weights_anneal_slope
    for step in (0, expected // 3, expected, 2 * expected):
        share = min(1.0, step / expected)
        assert model.proposal_sampler.update_sched(step) == pytest.approx(max(1.0, every * share))
        anneal.func(step=step)
        assert model.proposal_sampler._anneal == pytest.approx(slope * share / ((slope - 1) * share + 1))


def test_the_schedules_of_nerfstudios_own_are_left_to_it():
    config = deepcopy(all_methods["edge-depth-nerf-lite"])
    config.optimizers["fields"]["scheduler"] = ExponentialDecaySchedulerConfig(lr_final=2e-3, max_steps=100)
    optimizers = optimizers_of(config)
    before = dict(optimizers.schedulers)
    follow_training(optimizers, 10)
    kept = {name for name, scheduler in optimizers.schedulers.items() if scheduler is before[name]}
    assert kept == {"fields"}


@pytest.mark.slow
def test_a_resumed_training_has_the_schedules_of_one_in_one_go(tmp_path):
    """Of six steps; the first three of them may have been all that was asked for."""
    scene = write_scene(tmp_path / "scene", [fisheye(24, 20)])
    poses = deepcopy(all_methods["edge-depth-nerf-lite"].pipeline.model.camera_optimizer)
    poses.mode = "SO3xR3"

    def training(name: str, **changes: Any) -> EdgeDepthTrainer:
        changes |= {"model__camera_optimizer": poses, "data__surface_rays_per_batch": 256}
        return trainer_of(scene, tmp_path / name, **changes)

    def watched(trainer: EdgeDepthTrainer, until: int) -> list[Any]:
        found, step_of = [], trainer.train_iteration
        sampler: Any = trainer.pipeline.model.proposal_sampler

        def train_iteration(step: int) -> Any:
            if step == until:
                raise KeyboardInterrupt
            found.append((rates(trainer), sampler._anneal, sampler.update_sched(step)))
            return step_of(step)

        trainer.train_iteration = train_iteration
        trainer.train()
        return found

    def rates(trainer: EdgeDepthTrainer) -> dict[str, float]:
        return {name: each.param_groups[0]["lr"] for name, each in trainer.optimizers.optimizers.items()}

    whole = watched(training("whole", max_num_iterations=2 * STEPS), 2 * STEPS)
    assert len(whole) == 2 * STEPS and {*whole[0][0]} == {"fields", "proposal_networks", "camera_opt"}
    for asked_for_first in (STEPS, 2 * STEPS):
        first = training(f"first_{asked_for_first}", max_num_iterations=asked_for_first)
        with nullcontext() if asked_for_first == STEPS else pytest.raises(SystemExit):
            before = watched(first, STEPS)
            assert before != whole[:STEPS]
        folder = first.checkpoint_dir
        resumed = training(f"resumed_{asked_for_first}", max_num_iterations=STEPS, load_dir=folder)
        assert watched(resumed, 2 * STEPS) == whole[STEPS:]
        assert rates(resumed)["fields"] == pytest.approx(2e-3)
