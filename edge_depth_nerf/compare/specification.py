"""What one run is, and the files in its folder. Light to import."""

from __future__ import annotations

from dataclasses import dataclass

from edge_depth_nerf.compare.methods import MethodName, Preset, Sigma

SPECIFICATION = "run.json"
"""What is trained."""
FIGURES = "figures.json"
"""What came out; written last."""
PROGRESS = "progress.json"
"""What was measured up to each checkpoint."""
VIEWS = "views"
"""Folder of the evaluated views."""

OF_A_MACHINE = ("machine.device_type", "pipeline.model.eval_num_rays_per_chunk", "viewer.num_rays_per_chunk")
"""Fields of the configuration that are set for a GPU or for a CPU."""
OF_A_RUN = ("machine.seed", "pipeline.datamanager.data", "output_dir", "experiment_name", *OF_A_MACHINE)
"""Fields of the configuration that any two runs may differ in."""


@dataclass(frozen=True)
class RunSpecification:
    """All that one training depends on."""

    scene: str
    """The scene folder."""
    scene_sha256: str
    """Of its transforms.json."""
    preset: Preset
    method: MethodName
    seed: int
    steps: int | None
    """None: the preset's."""
    weight: float | None = None
    """λ, where it is not the method's own."""
    sigma_m: Sigma | None = None
    """σ, metres, or own; None: the method's own."""
    whole_views: bool = True
    """Whether whole views are evaluated at the end, or only the random pixels."""
    detail: bool = False
    """Whether whole views are evaluated with the detail of training pictures, too."""
    layers_sha256: str = ""
    """Of the scene's masks and maps; empty: not known."""
