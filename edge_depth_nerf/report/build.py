"""Builds report.html. The page contains all that it shows, loads nothing, and runs only its own scripts."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from edge_depth_nerf.base.files import write_text
from edge_depth_nerf.report.tables import MadeTable
from edge_depth_nerf.report.views import KINDS, ShownDrive, data_uri, legend


@dataclass(frozen=True)
class Plot:
    """A plot in two colour schemes, as SVG."""

    title: str
    light: bytes
    dark: bytes


@dataclass(frozen=True)
class Facts:
    """Names and values."""

    title: str
    entries: Mapping[str, str]
    folded: bool = False
    """Whether they are hidden until the reader opens them."""


@dataclass(frozen=True)
class Commands:
    """Commands that were typed, or that the reader can type."""

    title: str
    lines: Sequence[str]


@dataclass(frozen=True)
class Report:
    """The content of the page. Texts are plain; the page escapes them."""

    title: str
    lead: str
    """What was compared, in a sentence or two."""
    drives: Sequence[ShownDrive]
    tables: Sequence[MadeTable]
    plots: Sequence[Plot]
    facts: Sequence[Facts]
    commands: Sequence[Commands]
    methods: Sequence[str]
    """The methods that have pictures; the page starts with the first one beside the last one."""
    notes: Sequence[str] = field(default_factory=tuple)
    settings: Sequence[MadeTable] = field(default_factory=tuple)
    links: Mapping[str, str] = field(default_factory=dict)
    """Other pages beside this one: their titles, with their addresses."""
    verdict: str = ""
    """The result in a sentence."""


def build_report(report: Report) -> str:
    """Build the page."""
    folder = files("edge_depth_nerf.report")
    style, template = (folder.joinpath(name).read_text(encoding="utf-8") for name in ("style.css", "template.html.j2"))
    # the library and the view in 3D are only needed for points
    in_3d = ["ogl.min.js", "points.js"] if any(drive.points for drive in report.drives) else []
    scripts = [folder.joinpath(name).read_text(encoding="utf-8") for name in (*in_3d, "script.js")]
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.globals["svg"] = lambda content: data_uri(content, "image/svg+xml")  # pyrefly: ignore
    # only these scripts and this style are allowed, even if a text contains others
    policy = (
        "default-src 'none'; base-uri 'none'; form-action 'none'; img-src data:; "
        f"script-src {' '.join(map(_digest, scripts))}; style-src {_digest(style)}"
    )
    return environment.from_string(template).render(
        report=report, policy=policy, scripts=scripts, in_3d=bool(in_3d), style=style, data=_pictures(report)
    )


def write_report(path: Path, report: Report) -> None:
    """Write the page, complete or not at all."""
    write_text(path, build_report(report))


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _pictures(report: Report) -> dict[str, object]:
    """Return the data for the page's script: kinds, methods, and each drive's views."""

    def addresses(pictures: Mapping[str, bytes]) -> dict[str, str]:
        return {kind: data_uri(content, "image/webp") for kind, content in pictures.items()}

    return {
        "kinds": [
            {
                "key": kind.key,
                "title": kind.title,
                "explanation": kind.explanation,
                "legend": None if kind.scale is None else legend(kind.scale),
            }
            for kind in KINDS
        ],
        "drives": [
            {
                "title": drive.title,
                "note": drive.note,
                "points": drive.points,
                "methods": [name for name in report.methods if all(name in view.rendered for view in drive.views)],
                "views": [
                    {
                        **vars(view),
                        "truth": addresses(view.truth),
                        "rendered": {name: addresses(pictures) for name, pictures in view.rendered.items()},
                    }
                    for view in drive.views
                ],
            }
            for drive in report.drives
        ],
    }
