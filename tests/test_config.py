import inspect
import re
import subprocess
import sys
from copy import deepcopy
from dataclasses import fields
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion, all_methods
from nerfstudio.plugins.types import MethodSpecification

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.method.depth_losses import EdgeLoss
from edge_depth_nerf.method.integration import IntegrationOptions
from edge_depth_nerf.method.prior import PriorOptions
from edge_depth_nerf.plugin import compat, config
from edge_depth_nerf.plugin.dataparser import LARGEST_METRES_PER_UNIT

ROOT = Path(__file__).parents[1]
DECLARED = config.read_method_file()


def lookup(node: Any, dotted: str) -> Any:
    for part in dotted.split("."):
        node = node[part] if isinstance(node, dict) else getattr(node, part)
    return node


def test_entry_points_and_declarations_name_the_same_methods():
    points = {p.name: p for p in entry_points(group="nerfstudio.method_configs") if "edge_depth_nerf" in p.value}
    assert set(points) == set(DECLARED["methods"])
    for name, point in points.items():
        specification = point.load()
        assert isinstance(specification, MethodSpecification)
        assert specification.config.method_name == name
        assert specification.description == DECLARED["methods"][name]["description"]
        assert all_methods[name] is specification.config


@pytest.mark.parametrize("name", DECLARED["methods"])
def test_configurations_hold_what_the_file_says(name):
    method = all_methods[name]
    overrides = DECLARED["presets"][DECLARED["methods"][name]["preset"]]
    constants = {key: entry["value"] for key, entry in DECLARED["constants"].items()}
    assert constants
    for dotted, value in {**constants, **overrides}.items():
        found = lookup(method, dotted)
        assert (list(found) if isinstance(found, tuple) else found) == value, dotted
        assert type(found) is type(lookup(config.base_config(name), dotted)), dotted
    # the scale is chosen for the grid: metres of the finest cell, of which so many are 4 units long
    assert 4 * LARGEST_METRES_PER_UNIT / method.pipeline.model.max_res == 0.25
    assert method.viewer.websocket_host == "127.0.0.1"  # this machine only


def test_adams_decay_reaches_the_optimiser():
    """As Instant NGP has it where steps are few, torch's elsewhere."""
    found = {}
    for name, specification in config.make_specifications(config.read_method_file()).items():
        made = specification.config.optimizers["fields"]["optimizer"].setup([torch.nn.Parameter(torch.zeros(1))])
        found[name] = made.param_groups[0]["betas"]
    assert found == {
        "edge-depth-nerf": (0.9, 0.999),
        "edge-depth-nerf-lite": (0.9, 0.99),
        "edge-depth-nerf-paper": (0.9, 0.999),
    }


def test_the_paper_preset_is_the_literal_form():
    model, data = (getattr(all_methods["edge-depth-nerf-paper"].pipeline, part) for part in ("model", "datamanager"))
    assert (model.losses.edge, model.depth_loss_levels) == (EdgeLoss(gaussian="point", divide_by_norm=False), "final")
    assert data.prior == PriorOptions(
        align="none", sigma_mode="constant", sigma_constant_m=0.3, motion=False, integration=IntegrationOptions()
    )
    how = data.prior.integration
    assert (how.normalise, how.keep_returns) == ("pooled", False)
    assert (how.alpha, how.kernel_size, how.sigma_space_px, how.sigma_depth_m) == (0.7, 9, 3.0, 1.0)


def test_all_that_is_wrong_is_said_in_one_error():
    base = config.base_config("x")
    with pytest.raises(InputError) as error:
        config.apply_overrides(
            base,
            {
                "pipeline.model.num_level": 3,
                "pipeline.datamanager.prior.integration.alpha": "much",
                "optimizers.field.optimizer.lr": 0.1,
                "steps_per_save": 10,
            },
            "here",
        )
    message = str(error.value)
    assert message.startswith("here: ")
    assert "did you mean 'num_levels'" in message
    assert "alpha: expected float, found 'much'" in message
    assert "did you mean 'fields'" in message
    assert "steps_per_save" not in message


def test_an_unknown_preset_is_named():
    declared = deepcopy(DECLARED)
    declared["methods"]["edge-depth-nerf"]["preset"] = "huge"
    with pytest.raises(InputError, match="'huge'; there are full, lite, paper"):
        config.make_specifications(declared)


def test_methods_share_no_state():
    specifications = config.make_specifications(DECLARED)
    models = [specifications[name].config.pipeline.model for name in ("edge-depth-nerf", "edge-depth-nerf-lite")]
    arguments = [lookup(model, "proposal_net_args_list")[0] for model in models]
    arguments[0]["max_res"] = -1
    assert arguments[1]["max_res"] == 128


def test_the_file_at_the_top_is_the_shipped_one():
    shipped = ROOT / "edge_depth_nerf" / config.METHOD_FILE
    assert (ROOT / "nerfstudio_method.toml").read_text() == shipped.read_text()


def test_the_command_line_imports_nothing_heavy():
    """Nor do the options of any command, all of which it imports."""
    heavy = "{'numpy', 'torch', 'cv2', 'trimesh', 'embreex', 'nerfstudio', 'scipy'}"
    code = f"import sys, edge_depth_nerf.cli; sys.exit(', '.join({heavy} & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_frame_of_the_importer_has_its_module():
    """Which Python would search for in all modules, again and again while nerfstudio is imported."""
    compat.know_modules_of_importer()
    found = inspect.getmodule(compile("0", "<frozen importlib._bootstrap>", "exec"))
    assert found is not None and found.__name__ == "importlib._bootstrap"


UNCHANGED = """
import importlib.metadata as metadata
import sys
found, metadata.entry_points = metadata.entry_points, lambda **_: metadata.EntryPoints()
import nerfstudio.scripts.eval, nerfstudio.scripts.train, nerfstudio.scripts.viewer.run_viewer  # without plugins
from nerfstudio.plugins import registry, registry_dataparser
import contextlib, logging, os, random, signal, threading, types, warnings
import numpy as np, torch

assert not [name for name in sys.modules if name.startswith("edge_depth_nerf")]
sys.argv[0] = "ns-train"
registry.entry_points = registry_dataparser.entry_points = found

def settings():
    return {
        "hooks": (sys.excepthook, sys.unraisablehook, threading.excepthook),
        "safe globals": set(torch.serialization.get_safe_globals()),
        "filters of warnings": list(warnings.filters),
        "environment": dict(os.environ),
        "path": list(sys.path),
        "signals": [signal.getsignal(number) for number in signal.valid_signals()],
        "threads": (torch.get_num_threads(), threading.active_count()),
        "numbers": (torch.get_default_dtype(), np.geterr(), torch.are_deterministic_algorithms_enabled()),
        "seeds": (random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()),
        "logging": (logging.root.level, list(logging.root.handlers)),
    }

def names():
    found = {}
    for module in [each for each in sys.modules.values() if type(each) is types.ModuleType]:
        if module.__name__.partition(".")[0] in ("nerfstudio", "torch", "tyro", "viser", "yaml", "json", "pathlib"):
            for name, value in list(vars(module).items()):
                found[module.__name__, name] = value
                if isinstance(value, type) and value.__module__ == module.__name__:
                    found |= {(module.__name__, name, each): what for each, what in list(vars(value).items())}
    return found

before, named, imported = settings(), names(), set(sys.modules)
methods, dataparsers = registry.discover_methods()[0], registry_dataparser.discover_dataparsers()[0]
after, named_after = settings(), names()
assert "edge-depth-nerf-lite" in methods and "fisheye-depth-data" in dataparsers and len(named) > 10_000
changed = [what for what in before if before[what] != after[what]]
changed += [name for name, value in named.items() if named_after.get(name, named) is not value]
assert not changed, changed
# what takes long is imported when it is needed
heavy = {"numba", "torchmetrics", "trimesh", "transformers", "scipy.stats"}
assert not heavy & imported and not heavy & set(sys.modules), heavy & set(sys.modules)
with contextlib.suppress(Exception):  # there is no scene
    methods["edge-depth-nerf-lite"].pipeline.setup(device="cpu")
after = settings()
changed = [what for what in before if before[what] != after[what]]
assert changed == ["hooks", "safe globals", "filters of warnings"], changed
"""


@pytest.mark.slow
def test_users_of_other_methods_are_left_alone():
    """Every ns-* command loads the entry points; hooks, settings and others' classes stay the same."""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", UNCHANGED], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_options_that_pages_and_messages_name_can_be_typed(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    options = r"--(?:pipeline|optimizers|machine|viewer)\.[a-z0-9.-]*[a-z0-9]|fisheye-depth-data[\s\"]+--[a-z-]+"
    files = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "edge_depth_nerf").rglob("*.py")]
    named = {re.sub(r"[\s\"]+", " ", name) for file in files for name in re.findall(options, file.read_text("utf-8"))}
    named -= {"--pipeline.model.losses.ratio.delta", "--pipeline.model"}  # of the page's example; with its name behind
    typed = set()
    for of_scene in ([], ["fisheye-depth-data"]):
        with pytest.raises(SystemExit):
            tyro.cli(AnnotatedBaseConfigUnion, args=["edge-depth-nerf-lite", *of_scene, "--help"])
        helped = re.findall(r"--[a-zA-Z0-9.-]+", capsys.readouterr().out)
        typed |= {" ".join((*of_scene, name)) for name in helped}
    assert len(named) > 25
    assert sorted(named - typed) == []


@pytest.mark.parametrize(
    ("part", "first"),
    [
        ("", ["data", "max_num_iterations", "cuda_graphs", "pipeline"]),
        ("pipeline.datamanager", ["depth_source", "prior", "surface_rays_per_batch", "cache_dir"]),
        ("pipeline.datamanager.dataparser", ["metres_per_unit", "depth_kind"]),
        ("pipeline.model", ["near_m", "far_m", "depth_loss", "losses", "depth_loss_mult"]),
    ],
)
def test_our_options_come_first_in_the_help(part, first):
    """nerfstudio's stay as they are: their order, and defaults that no method sets."""
    found = lookup(config.edge_depth_nerf.config, part) if part else config.edge_depth_nerf.config
    names = [entry.name for entry in fields(found)]
    assert names[: len(first)] == first
    theirs = next(base for base in type(found).__mro__[1:] if base.__module__.startswith("nerfstudio."))
    kept = [entry.name for entry in fields(theirs) if entry.name not in first]
    assert [name for name in names if name in kept] == kept
    if not part:
        assert type(found)().max_num_iterations == theirs().max_num_iterations
