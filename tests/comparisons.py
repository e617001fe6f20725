"""Made-up runs and options for tests of comparisons."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from edge_depth_nerf.compare.options import CompareOptions
from edge_depth_nerf.compare.results import RunResult

ROOT = Path(__file__).parents[1]
QUIET = Console(quiet=True)


def fake(scene, method, seed, psnr=20.0, steps=100, seconds=10.0, named=(), **more):
    """A finished run that nobody trained, with these figures."""
    figures = {"truth_masked_psnr": psnr, "truth_masked_ssim": psnr / 40, "truth_abs_rel": 1 / psnr, **more}
    curve = [
        {"step": steps * share, "seconds": seconds * share, "cpu_seconds": seconds * share, "truth_psnr": psnr * share}
        for share in (0.5, 1.0)
    ]
    content = {
        "run": {"scene": f"/scenes/{scene}", "method": method, "seed": seed, "implementation": "same"},
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


def options(*scenes, **changes):
    """Options of a comparison that writes nowhere unless `output` is given."""
    return CompareOptions(scenes=tuple(scenes), **{"output": Path("/nonexistent/out"), **changes})
