"""What judging costs beside training, in a run of `compare`.

    python benchmarks/judging.py SCENE [--steps 800] [--page docs/speed.md]

Does what `compare` does for our method, and times what it consists of: the start, the training, the random pixels that
are judged meanwhile, the held-out views, and the views beside the path. The scene of `edge-depth-nerf demo` has ten
held-out views. Run it on an idle machine. Writes benchmarks/judging.json and, with `--page`, the table.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import pages
import run
import speed
from step_parts import Clock

from edge_depth_nerf.base.files import write_json, write_text
from edge_depth_nerf.compare import judging, worker
from edge_depth_nerf.compare.judging import ViewJudge
from edge_depth_nerf.compare.specification import FIGURES, SPECIFICATION, RunSpecification
from edge_depth_nerf.compare.worker import MeasuredTrainer
from edge_depth_nerf.plugin.model import EdgeDepthNerfModel

RESULTS = Path(__file__).with_name("judging.json")
PART = "speed: judging"
PARTS = {
    "import": "import of nerfstudio and torch (processor seconds)",
    "start": "tables, model and checkpoint",
    "training": "training",
    "pixels": "random pixels during it",
    "rendering": "held-out views: rendering",
    "figures": "… PSNR, SSIM, depth errors",
    "pictures": "… pictures that are saved",
    "beside": "views beside the path: rendering, figures",
}
JUDGING = ("pixels", "rendering", "figures", "pictures", "beside")


def measured(scene: Path, steps: int) -> dict[str, Any]:
    """Seconds of a run's parts, and how many views it judged."""
    clock = Clock()
    for holder, name, part in (
        (worker, "do_run", "start"),
        (MeasuredTrainer, "train", "training"),
        (MeasuredTrainer, "save_checkpoint", "start"),
        (worker, "judge_pixels", "pixels"),
        (ViewJudge, "held_out", "figures"),
        (EdgeDepthNerfModel, "get_outputs_for_camera", "rendering"),
        (judging, "_save", "pictures"),
        (ViewJudge, "shifted", "beside"),
    ):
        clock.measure(holder, name, part)
    clock.seconds["import"] = time.process_time()
    specification = RunSpecification(str(scene), "", "lite", "edge", seed=0, steps=steps)
    with tempfile.TemporaryDirectory() as folder:
        write_json(Path(folder) / SPECIFICATION, specification.to_dict())
        worker.do_run(Path(folder))
        assert (Path(folder) / FIGURES).is_file()
        views = len(list(Path(folder).glob("views/eval_img_*.png")))
    return {"steps": steps, "views": views, "seconds": dict(clock.seconds)}


def table(results: dict[str, Any]) -> str:
    """Seconds of the parts, and what they are of the training; as Markdown."""
    seconds = results["seconds"]
    lines = ["| | s | of the training |", "|---|---:|---:|"]
    for name, title in PARTS.items():
        lines.append(f"| {title} | {seconds[name]:.1f} | {seconds[name] / seconds['training']:.0%} |")
    judging_s = sum(seconds[name] for name in JUDGING)
    return "\n".join([*lines, f"| **all judging** | **{judging_s:.1f}** | **{judging_s / seconds['training']:.0%}** |"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--page", type=Path)
    options = parser.parse_args()
    found = measured(options.scene.resolve(), options.steps)
    results = {"commit": run.commit(), "machine": speed.machine(), "scene": options.scene.name, **found}
    write_json(RESULTS, results)
    print(table(results))
    if options.page:
        text = options.page.read_text(encoding="utf-8")
        write_text(options.page, pages.with_part(text, PART, table(results)))


if __name__ == "__main__":
    main()
