"""The slider page of the site: held-out views of a rendered drive, nerfacto against ours.

    python docs/slider_page.py outputs/demo

stores the pictures of a finished `edge-depth-nerf demo` in docs/slider/. The site's hook makes slider.html of them.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Mapping
from pathlib import Path

from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, write_bytes, write_json
from edge_depth_nerf.demo.options import DemoOptions
from edge_depth_nerf.jobs.runs import command_line
from edge_depth_nerf.report.build import Commands, Facts, Report, build_report
from edge_depth_nerf.report.views import ShownDrive, ShownView, make_drives

FOLDER = Path(__file__).resolve().parent / "slider"
CONTENT = "content.json"
MOST_BYTES = 2_000_000
"""Largest size of the folder."""
LINKS = {"← Results": "results.html", "Home": "index.html"}
"""The way back: pages of the site beside this one."""


def store(demo: Path, folder: Path = FOLDER) -> None:
    """Store a demo's pictures, figures and settings.

    Args:
        demo: output folder of `edge-depth-nerf demo`, finished.
        folder: folder to write to; its former content is removed.

    Raises:
        InputError: the pictures are too large.
    """
    results = read_json(demo / "results.json")
    options = results["options"]
    compared = demo / "comparison" / "runs" / options["scene"]
    runs = {"nerfacto": "nerfacto", "ours": "edge"}
    views_of = {title: compared / f"{method}_seed-0" / "views" for title, method in runs.items()}
    drive = make_drives({options["scene"]: (demo / "scenes" / options["scene"], views_of)}, Console())[0]
    shutil.rmtree(folder, ignore_errors=True)

    def stored(pictures: Mapping[str, bytes], name: str) -> dict[str, str]:
        for kind, content in pictures.items():
            write_bytes(folder / f"{name}_{kind}.webp", content)
        return {kind: f"{name}_{kind}.webp" for kind in pictures}

    views = [
        {
            "title": view.title,
            "width": view.width,
            "height": view.height,
            "truth": stored(view.truth, f"{number}_truth"),
            "rendered": {title: stored(view.rendered[title], f"{number}_{title}") for title in runs},
            "figures": view.figures,
        }
        for number, view in enumerate(drive.views)
    ]
    content = {
        "note": drive.note,
        "options": {name.replace("_", " "): str(value) for name, value in options.items()},
        "versions": results["versions"],
        "command": command_line(["edge-depth-nerf", "demo"], DemoOptions(**options)),
        "views": views,
    }
    write_json(folder / CONTENT, content)
    size = sum(path.stat().st_size for path in folder.iterdir())
    if size > MOST_BYTES:
        raise InputError(f"{folder}: {size:,} bytes, more than {MOST_BYTES:,}. Use fewer frames or smaller pictures.")


def page(folder: Path = FOLDER) -> str:
    """Build the page from the stored pictures."""
    content = read_json(folder / CONTENT)

    def read(names: Mapping[str, str]) -> dict[str, bytes]:
        return {kind: (folder / name).read_bytes() for kind, name in names.items()}

    views = [
        ShownView(
            title=view["title"],
            width=view["width"],
            height=view["height"],
            truth=read(view["truth"]),
            rendered={title: read(names) for title, names in view["rendered"].items()},
            figures=view["figures"],
        )
        for view in content["views"]
    ]
    options = content["options"]
    return build_report(
        Report(
            title="Held-out views: nerfacto and ours",
            lead=f"The same model was trained twice for {options['steps']} steps on a rendered {options['scene']}: "
            "without depth, and with the edge loss on the integrated prior. This is a short training; the results page "
            "has the figures of longer ones.",
            drives=[ShownDrive(options["scene"], views, content["note"])],
            tables=[],
            plots=[],
            facts=[Facts("Drive and training", options), Facts("Versions", content["versions"])],
            commands=[Commands("The command that makes these pictures", [content["command"]])],
            methods=list(content["views"][0]["rendered"]),
            links=LINKS,
        )
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Store the pictures of a demo for the site's slider page.")
    parser.add_argument("demo", type=Path, help="output folder of a finished `edge-depth-nerf demo`")
    store(parser.parse_args().demo)
