"""`edge-depth-nerf estimate-depth --cluster`: one task trains the network, then each scene's maps are a task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from edge_depth_nerf.jobs.tasks import Task, do_tasks, own_command
from edge_depth_nerf.mono.estimate import WEIGHTS, opened, training_split
from edge_depth_nerf.mono.options import EstimateDepthOptions

LOG = "estimate_depth.log"
"""In a scene: what the task said that made its maps."""


def estimate_on_cluster(options: EstimateDepthOptions, console: Console | None = None) -> None:
    """Do on a cluster what `estimate_depth` does here.

    Raises:
        FileNotFoundError: a scene, the weights or a map are not there.
        InputError: an option, a scene, the weights, a map or the cluster cannot be used.
    """
    console = console or Console()
    # faults are told before anything travels
    *_, scenes = opened(options)
    folders = [scene.folder.absolute() for scene in scenes]
    here = replace(options, cluster=None)
    if options.hf is not None and Path(options.hf).is_dir():
        here = replace(here, hf=str(Path(options.hf).absolute()))
    if options.hf is None and options.maps is None and options.trains:
        for scene in scenes:
            training_split(scene)
        weights = (options.output or scenes[0].folder / WEIGHTS).absolute()
        words = own_command(("estimate-depth",), replace(here, predict=False))
        task = Task("depth network", words, weights.with_suffix(".log"), weights, trains=True)
        _do(options, [task], folders, console)
        if not options.predict:
            return
        here = EstimateDepthOptions((), model=weights)
    tasks = []
    for path, folder in zip(options.scenes, folders, strict=True):
        words = own_command(("estimate-depth",), replace(here, scenes=(path,)))
        tasks.append(Task(f"maps of {path}", words, folder / LOG, folder / "transforms.json"))
    _do(options, tasks, folders, console)


def _do(options: EstimateDepthOptions, tasks: Sequence[Task], folders: Sequence[Path], console: Console) -> None:
    from edge_depth_nerf.jobs.cluster import on_cluster  # imports Dask

    assert options.cluster is not None
    with on_cluster(options.cluster, tasks, folders, console) as place:
        do_tasks(tasks, place, console)
