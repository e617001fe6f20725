"""One of several processes that train together on the CPU: `python distributed_rank.py RANK WORLD_SIZE SCENE FOLDER`.

nerfstudio's own worker asserts CUDA; this does what it does, over gloo, and writes down what the test looks at.
"""

import sys
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from nerfstudio.pipelines import base_pipeline
from torch.nn.parallel import DistributedDataParallel
from trainings import trainer_of

from edge_depth_nerf.plugin import datamanager, ray_table

STEPS = 2


class OnCpu(DistributedDataParallel):
    """nerfstudio names a GPU, which modules on the CPU have not."""

    def __init__(self, module: torch.nn.Module, device_ids: Any, **options: Any) -> None:
        super().__init__(module, **options)


def counted(module: Any, name: str, counts: dict[str, int]) -> None:
    original = getattr(module, name)

    def count(*given: Any, **named: Any) -> Any:
        counts[name] = counts.get(name, 0) + 1
        return original(*given, **named)

    setattr(module, name, count)


def parameters(model: torch.nn.Module) -> dict[str, torch.Tensor]:
    """All but the empty one by which nerfstudio tells the device."""
    return {name: p for name, p in model.named_parameters() if len(p)}


def gradients(model: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: p.grad.clone() for name, p in parameters(model).items() if p.grad is not None}


def main() -> None:
    rank, world_size, scene, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]), Path(sys.argv[4])
    torch.set_num_threads(1)
    store = f"file://{folder / 'store'}"
    dist.init_process_group("gloo", init_method=store, rank=rank, world_size=world_size, timeout=timedelta(seconds=120))
    base_pipeline.DDP = OnCpu
    barrier = dist.barrier
    dist.barrier = lambda device_ids=None: barrier()  # pyrefly: ignore
    made: dict[str, int] = {}
    counted(datamanager, "write_table", made)
    counted(ray_table, "_make", made)
    barrier()
    trainer = trainer_of(
        scene, folder / "out", rank, world_size, max_num_iterations=STEPS, data__surface_rays_per_batch=256
    )
    pipeline: Any = trainer.pipeline
    manager: Any = pipeline.datamanager
    assert isinstance(pipeline._model, OnCpu)

    # this process's own gradient, of the batch that the first step will draw
    torch.manual_seed(100 + rank)
    pipeline.train()
    rays, batch = manager.next_train(0)
    outputs = pipeline.model(rays, batch)
    losses = pipeline.model.get_loss_dict(outputs, batch, pipeline.model.get_metrics_dict(outputs, batch))
    total: Any = sum(losses.values())
    total.backward()
    own = gradients(pipeline.model)
    mean = {name: gradient.clone() for name, gradient in own.items()}
    for gradient in mean.values():
        dist.all_reduce(gradient)
        gradient /= world_size
    manager.train_pixel_sampler._drawn = manager._surface_sampler._drawn = 0

    drawn, surface = [], []
    serve = manager._serve

    def note(pixels: Any, generator: Any) -> Any:
        if generator is manager.train_ray_generator:
            surface.append(pixels.indices[len(manager.trained_on) :])
        return serve(pixels, generator)

    manager._serve = note
    before = {name: p.detach().clone() for name, p in parameters(pipeline.model).items()}
    torch.manual_seed(100 + rank)
    averaged: dict[str, torch.Tensor] = {}
    for step in range(STEPS):
        trainer.step = step
        trainer.train_iteration(step)
        drawn.append(manager.trained_on)
        averaged = averaged or gradients(pipeline.model)
    trainer.save_checkpoint(STEPS - 1)
    torch.save(
        {
            "made": made,
            "losses": sorted(losses),
            "own": own,
            "mean": mean,
            "averaged": averaged,
            "drawn": drawn,
            "further": surface,
            "before": before,
            "after": {name: p.detach().clone() for name, p in parameters(pipeline.model).items()},
            "checkpoints": [str(path) for path in trainer.checkpoint_dir.glob("*.ckpt")],
        },
        folder / f"{rank}.pt",
    )
    barrier()
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
