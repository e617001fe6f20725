"""No data makes this program run code, leave its folder, or load more than weights; see ruff's rules S and TID, too."""

import ast
import pickle
import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from random import Random

import numpy as np
import pytest
import torch
import yaml
from bad_input import RIG, spoilt
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.utils import eval_utils
from scenes import transforms, write_scene
from test_bad_input import INPUTS, throw

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.films.training import read_dataparser
from edge_depth_nerf.mono.network import load_network
from edge_depth_nerf.plugin import compat
from edge_depth_nerf.plugin.config import edge_depth_nerf_lite
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig
from edge_depth_nerf.plugin.dataset import FisheyeDepthDataset
from edge_depth_nerf.process.rig_file import read_rig
from edge_depth_nerf.scene.reader import read_scene

PACKAGE = Path(compat.__file__).parents[1]
OUTSIDE = ("/etc/passwd", "../outside.png", "images/../../outside.png", "a\0b", "", "a" * 300, 7, None)


class Trap:
    """What a pickle of it does when it is loaded is to write a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.write_text, (self.path, "code has run")


# ---- checkpoints -----------------------------------------------------------------------------------------------
class Pipeline:
    def load_pipeline(self, *_) -> None:
        raise AssertionError("a checkpoint was loaded")


def object_scalar(inner: bytes):
    """A NumPy scalar of type object, which may be said to hold a pickle: its class is allowed in checkpoints."""

    class Scalar:
        def __reduce__(self):
            return np.float64(0).__reduce__()[0], (np.dtype("O"), inner)

    return Scalar()


@pytest.mark.parametrize("kind", ["in the state", "in a scalar", "plain pickle"])
def test_a_checkpoint_holds_weights_alone(tmp_path, kind):
    """As nerfstudio's commands load them, with what the plugin allows."""
    compat.allow_numpy_scalars_in_checkpoints()
    sign, folder = tmp_path / "sign", tmp_path / "models"
    folder.mkdir()
    trap = Trap(sign)
    checkpoint = folder / "step-000000007.ckpt"
    if kind == "in a scalar":
        torch.save({"step": object_scalar(pickle.dumps(trap)), "pipeline": {}}, checkpoint)
    elif kind == "plain pickle":
        checkpoint.write_bytes(pickle.dumps({"step": 7, "pipeline": trap}))
    else:
        torch.save({"step": 7, "pipeline": {"weight": torch.ones(2), "trap": trap}}, checkpoint)

    class Config:
        load_dir, load_step = folder, None

    with pytest.raises((pickle.UnpicklingError, AssertionError, RuntimeError)) as raised:
        eval_utils.eval_load_checkpoint(Config(), Pipeline())  # pyrefly: ignore[bad-argument-type]
    assert not sign.exists()
    if kind != "in a scalar":
        assert isinstance(raised.value, pickle.UnpicklingError)
    # the trap does work
    pickle.loads(pickle.dumps(trap))
    assert sign.exists()


def test_weights_are_no_pickle(tmp_path):
    sign = tmp_path / "sign"
    torch.save({"weight": Trap(sign)}, tmp_path / "a.safetensors")
    with pytest.raises(InputError, match="cannot be read as weights"):
        load_network(tmp_path / "a.safetensors")
    assert not sign.exists()


# ---- config.yml ------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    settings = edge_depth_nerf_lite.config
    parser = FisheyeDepthDataParserConfig(metres_per_unit=7.5, eval_interval=5)
    manager = replace(settings.pipeline.datamanager, dataparser=parser, data=Path("/drives/street"))  # pyrefly: ignore
    whole = replace(settings, pipeline=replace(settings.pipeline, datamanager=manager))
    path = tmp_path_factory.mktemp("config") / "config.yml"
    path.write_text(yaml.dump(whole))
    return path


def test_settings_are_those_that_nerfstudio_reads(config):
    host = yaml.load(config.read_text(), Loader=yaml.Loader).pipeline.datamanager
    found = read_dataparser(config)
    assert type(found) is type(host.dataparser)
    assert found.data == host.data == Path("/drives/street")
    for name in ("metres_per_unit", "eval_interval", "orientation_method", "auto_scale_poses", "mask_color"):
        assert getattr(found, name) == getattr(host.dataparser, name), name


def test_settings_of_the_hosts_parser(config, tmp_path):
    parser = NerfstudioDataParserConfig(mask_color=(0.0, 0.5, 1.0), downscale_factor=2)
    text = config.read_text()
    head, _, tail = text.partition("    dataparser: ")
    inner = "\n".join(f"      {line}" for line in yaml.dump(parser).splitlines()[1:])
    rest = re.sub(r"\A.*?(?=^    \w)", "", tail, flags=re.DOTALL | re.MULTILINE)
    tag = yaml.dump(parser).splitlines()[0]
    (tmp_path / "config.yml").write_text(f"{head}    dataparser: {tag}\n{inner}\n{rest}")
    found = read_dataparser(tmp_path / "config.yml")
    assert isinstance(found, NerfstudioDataParserConfig) and not isinstance(found, FisheyeDepthDataParserConfig)
    assert found.mask_color == (0.0, 0.5, 1.0) and found.downscale_factor == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("metres_per_unit: 7.5", "metres_per_unit: {call}", "metres_per_unit is"),
        ("eval_interval: 5", "eval_interval: {call}", "eval_interval is"),
        ("dataparser.FisheyeDepthDataParserConfig", "trainer.EdgeDepthTrainer", "its dataparser is"),
        ("max_num_iterations: 2000", "max_num_iterations: {call}", None),
        ("metres_per_unit: 7.5", "metres_per_unit: .nan", "metres_per_unit is nan"),
        ("orientation_method: none", "orientation_method: sideways", "orientation_method is 'sideways'"),
    ],
)
def test_a_config_runs_nothing(config, tmp_path, old, new, message):
    sign = tmp_path / "sign"
    call = f"!!python/object/apply:os.mkdir ['{sign}']"
    text = config.read_text()
    assert old in text
    path = tmp_path / "config.yml"
    path.write_text(text.replace(old, new.format(call=call)))
    if message is None:
        read_dataparser(path)
    else:
        with pytest.raises(InputError, match=message):
            read_dataparser(path)
    assert not sign.exists()
    if "{call}" in new:
        yaml.load(path.read_text(), Loader=yaml.Loader)
        assert sign.exists()  # what nerfstudio's own loader does with it


def test_a_spoilt_config(config, tmp_path):
    path, whole = tmp_path / "config.yml", config.read_bytes()
    laughs = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
        f"{chr(98 + n)}: &{chr(98 + n)} [{','.join([f'*{chr(97 + n)}'] * 9)}]\n" for n in range(20)
    )
    for content in (laughs.encode(), b"[" * 30_000, b"{a: " * 7_500, b"- " * 9_000, b"a: 1\n" * 6_500, b"x" * 70_000):
        path.write_bytes(content)
        throw(read_dataparser, path)
    rng = Random(0)
    for _ in range(max(5, INPUTS // 4)):
        path.write_bytes(spoilt(whole, "text", rng))
        throw(read_dataparser, path)


def test_a_spoilt_scene_as_training_reads_it(tmp_path):
    path = write_scene(tmp_path, frames=4) / "transforms.json"
    whole, rng = path.read_bytes(), Random(0)

    def read(scene: Path) -> None:
        dataset = FisheyeDepthDataset(FisheyeDepthDataParserConfig(data=scene).setup().get_dataparser_outputs("train"))
        for index in range(len(dataset)):
            dataset[index]

    for _ in range(INPUTS):
        path.write_bytes(spoilt(whole, "json", rng))
        throw(read, path)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"depth_unit_scale_factor": None}, "depth_unit_scale_factor is None"), ({"fl_x": None}, "fl_x is None")],
)
def test_a_null_is_no_number(tmp_path, change, message):
    scene = write_scene(tmp_path, frames=2)
    write_json(scene / "transforms.json", {**read_json(scene / "transforms.json"), **change})
    with pytest.raises(InputError, match=message):
        FisheyeDepthDataParserConfig(data=scene).setup().get_dataparser_outputs("train")


def test_a_split_that_is_not_listed(tmp_path):
    with transforms(scene := write_scene(tmp_path, frames=2)) as meta:
        del meta["val_filenames"]
    with pytest.raises(InputError, match="names no pictures in val_filenames"):
        FisheyeDepthDataParserConfig(data=scene).setup().get_dataparser_outputs("train")


# ---- paths -----------------------------------------------------------------------------------------------------
OTHER_FILES = ("mask_path", "depth_file_path", "lidar_file_path", "mono_file_path", "truth_rgb_file_path")


@pytest.mark.parametrize(
    ("key", "name"), [*product(["file_path"], OUTSIDE), *product(OTHER_FILES, ("../outside.png", None))]
)
def test_a_scene_names_its_own_files(tmp_path, key, name):
    scene = write_scene(tmp_path / "scene", frames=2)
    with transforms(scene) as meta:
        meta["frames"][1][key] = name
    for read in (read_scene, lambda path: FisheyeDepthDataParserConfig(data=path).setup().get_dataparser_outputs()):
        with pytest.raises(InputError, match=rf"frame 1(: {key} is .*not leading out of it| has no file_path)"):
            read(scene)


@pytest.mark.slow
def test_links_in_a_scene_are_followed(tmp_path):
    """They are of whoever made the folder: a way to keep pictures elsewhere."""
    scene = write_scene(tmp_path / "scene", frames=2)
    (scene / "images").rename(tmp_path / "elsewhere")
    (scene / "images").symlink_to(tmp_path / "elsewhere")
    found = read_scene(scene)
    assert found.maps(found.pictures[0]).rgb.any()


@pytest.mark.parametrize("name", ["/etc", "../other", "images/../../other", "/etc/*.png", "../*"])
@pytest.mark.parametrize("key", ["images", "times_file", "masks", "file", "scans"])
def test_a_rig_names_files_of_the_recording(tmp_path, key, name):
    path = tmp_path / "rig.toml"
    path.write_text(re.sub(rf'^{key} = "[^"]*"', f'{key} = "{name}"', RIG, flags=re.MULTILINE))
    with pytest.raises(InputError, match=rf"{key} is .*not leading out of it"):
        read_rig(path, tmp_path)


# ---- the host ----------------------------------------------------------------------------------------------------
def test_what_reads_data_is_told_not_to_run_it():
    unsafe = re.compile(r"(allow_pickle|trust_remote_code\"?|\bshell)[=:](?! ?False)|weights_only\"?[=:](?! ?True)")
    assert unsafe.search("np.load(path, allow_pickle=asked)") and not unsafe.search("np.load(path, allow_pickle=False)")
    assert not [path for path in PACKAGE.rglob("*.py") if unsafe.search(path.read_text(encoding="utf-8"))]


def test_each_workaround_names_its_issue_and_its_end():
    found = [value for name, value in vars(compat).items() if getattr(value, "__module__", "") == compat.__name__]
    assert len(found) >= 3
    for function in found:
        text = function.__doc__ or ""
        assert re.search(r"Works around: https://github\.com/[\w.-]+/[\w.-]+/(issues|pull)/\d+\.$", text, re.MULTILINE)
        assert re.search(r"Ends with: \S.*\.$", text, re.MULTILINE), function


def changes_of_the_host(source: str) -> set[str]:
    """Which attributes of what is imported from nerfstudio, torch or torchmetrics a module sets."""
    nodes, host = [*ast.walk(ast.parse(source))], set()
    for node in nodes:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            module = node.module or "" if isinstance(node, ast.ImportFrom) else ""
            for name in node.names:
                if (module or name.name).split(".")[0] in ("nerfstudio", "torch", "torchmetrics"):
                    host.add((name.asname or name.name).split(".")[0])
    return {
        ast.unparse(target)
        for node in nodes
        if isinstance(node, (ast.Assign, ast.AugAssign))
        for whole in (node.targets if isinstance(node, ast.Assign) else [node.target])
        for target in ast.walk(whole)
        if isinstance(target, ast.Attribute) and ast.unparse(target).split(".")[0] in host
    }


def test_no_module_but_one_changes_the_host():
    paths = PACKAGE.rglob("*.py")
    changing = [path for path in paths if changes_of_the_host(path.read_text(encoding="utf-8"))]
    assert changing == [PACKAGE / "plugin/compat.py"]
