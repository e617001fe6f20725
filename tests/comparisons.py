"""Made-up runs and options for tests of comparisons."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from scenes import FLIP, fisheye, view, write_scene

from edge_depth_nerf.base.files import read_json, write_distance_png, write_json, write_png
from edge_depth_nerf.base.pictures import colour_distance
from edge_depth_nerf.compare.methods import MethodName, Preset
from edge_depth_nerf.compare.options import CompareOptions
from edge_depth_nerf.compare.results import RunResult
from edge_depth_nerf.compare.specification import RunSpecification
from edge_depth_nerf.report.compared_views import BY_VIEW, compared_views

QUIET = Console(quiet=True)


def fake(scene, method, seed, psnr=20.0, steps=100, seconds=10.0, named=(), **more):
    """A finished run that nobody trained, with these figures."""
    figures = {"truth_masked_psnr": psnr, "truth_masked_ssim": psnr / 40, "truth_abs_rel": 1 / psnr, **more}
    curve = [
        {"step": steps * share, "seconds": seconds * share, "cpu_seconds": seconds * share, "truth_psnr": psnr * share}
        for share in (0.5, 1.0)
    ]
    content = {
        "run": {"scene": f"/scenes/{scene}", "method": method, "seed": seed},
        "named": list(named),
        "configuration": {"a": "1", "machine.seed": str(seed)},
        "lambda": None if method == "nerfacto" else 0.01,
        "sigma": None if method == "nerfacto" else 0.5,
        "steps": steps,
        "device": "cpu",
        "source": "kitti360",
        "departures": [],
        "figures": figures,
        "curve": curve,
    }
    return RunResult(Path(f"/runs/{scene}/{method}_seed-{seed}"), content["run"], content)


@cache
def resolved(method: MethodName, preset: Preset = "lite", folder: Path | None = None, **changes: Any) -> dict[str, Any]:
    """A run's whole configuration, by dotted names."""
    from edge_depth_nerf.compare.configuration import configuration, flattened  # not before: it imports nerfstudio

    run = RunSpecification("/scenes/a", "", preset, method, 0, 10)
    return flattened(configuration(replace(run, **changes), folder)[0])


def differing(one: dict[str, Any], other: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Both values of the fields in which configurations differ."""
    return {name: (one[name], other[name]) for name in one if repr(one[name]) != repr(other[name])}


def copied(output: Path, folder: Path) -> Path:
    """A copy of what a comparison or a demo left; checkpoints, which are large and not written to again, are linked."""

    def copy(source: str, target: str) -> None:
        (os.link if source.endswith(".ckpt") else shutil.copy2)(source, target)

    return Path(shutil.copytree(output, folder, copy_function=copy))


def write_compared_scene(folder: Path) -> Path:
    """A small scene that has all that is compared: two held-out views, and true ones beside the first of them."""
    camera = fisheye(30, 26)
    meta = read_json(write_scene(folder, [camera], frames=13) / "transforms.json")
    for frame in meta["frames"]:
        frame["camera"] = "only"
    held_out = next(frame for frame in meta["frames"] if frame["file_path"] == meta["test_filenames"][0])
    meta["shifted_views"] = {}
    for metres in (1, 2):
        pose = np.array(held_out["transform_matrix"])
        pose[0, 3] += metres
        colours, distance, _ = view(camera, pose @ FLIP)
        files = {kind: f"truth/shifted_{metres}m/{kind}.png" for kind in ("rgb", "distance")}
        write_png(folder / files["rgb"], colours)
        write_distance_png(folder / files["distance"], distance)
        entry = {"camera": "only", "frame": 4, "transform_matrix": pose.tolist()}
        entry |= {f"truth_{kind}_file_path": path for kind, path in files.items()}
        meta["shifted_views"][str(metres)] = [entry]
    write_json(folder / "transforms.json", meta)
    return folder


def run_here(runs: Sequence[Any], *_: object) -> None:
    """Train and evaluate as a comparison's processes do, in this one, which has imported nerfstudio already."""
    from edge_depth_nerf.compare.worker import do_run

    for run in runs:
        do_run(run.folder.absolute())


def write_rendered(scene: Path, folder: Path, gain: float) -> None:
    """What a run that makes everything darker and nearer would leave."""
    for index, seen in enumerate(compared_views(scene, {})):
        rendered = (seen.rgb * gain).astype(np.uint8)
        write_png(folder / f"eval_img_{index:04d}.png", np.hstack([seen.rgb, rendered]))
        write_png(folder / f"eval_distance_{index:04d}.png", colour_distance(seen.distance_m * gain, seen.mask))
    write_json(folder / BY_VIEW, {"0": {"masked_psnr": 30 * gain, "lidar_delta_1_25": gain}})


def options(*scenes, **changes: Any):
    """Options of a comparison that writes nowhere unless `output` is given."""
    return CompareOptions(scenes=tuple(scenes), **dict[str, Any](output=Path("/nonexistent/out")) | changes)
