"""Numbers stay finite: losses and integration in half precision and at their limits, trainings on hostile scenes."""

import math
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scenes import copy_sample_drive, transforms
from trainings import trainer_of

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_distance_png, write_mask, write_png
from edge_depth_nerf.method import depth_losses
from edge_depth_nerf.method.depth_losses import EdgeLoss
from edge_depth_nerf.method.integration import IntegrationOptions, combined_sigma_m, integrate_depth, select_prior
from edge_depth_nerf.method.losses import Gaussian, edge_loss, urban_nerf_loss
from edge_depth_nerf.method.prior import PriorOptions
from edge_depth_nerf.plugin.step_losses import distortion_loss, interlevel_loss

HALVES = [torch.float16, torch.bfloat16]
PRECISIONS = pytest.mark.parametrize(
    ("dtype", "autocast"), [*((each, None) for each in HALVES), *((torch.float32, each) for each in (None, *HALVES))]
)
GAUSSIANS: tuple[Gaussian, ...] = ("point", "interval")


# ---- losses ----------------------------------------------------------------------------------------------------
def samples(dtype: torch.dtype, rays: int = 7, count: int = 12) -> tuple[torch.Tensor, ...]:
    """Edges and weights along rays: some of no length, some far, one backwards, some weights 0."""
    torch.manual_seed(1)
    edges = torch.cumsum(torch.rand(rays, count + 1), -1)
    edges[1] = 3.0
    edges[2] *= 1e4
    edges[3, 6:] = torch.inf
    edges[4] = edges[4].flip(-1)
    edges[5] *= 1e-7
    weights = torch.rand(rays, count) / count
    weights[0] = 0
    weights[1, 3:] = 0
    weights[2] = 1e-7
    return edges.to(dtype), weights.to(dtype)


LOSSES = [
    *(partial(edge_loss, gaussian=gaussian, divide_by_norm=norm) for gaussian in GAUSSIANS for norm in (False, True)),
    partial(urban_nerf_loss, expected=0.01, empty=1.0, near=1.0),
]


@pytest.mark.parametrize("loss_of", LOSSES)
@PRECISIONS
def test_a_depth_loss_is_finite(loss_of: Any, dtype: torch.dtype, autocast: Any) -> None:
    edges, weights = samples(dtype)
    weights.requires_grad_()
    prior = torch.tensor([2.0, 3.0, 250.0, 1e-3, 4.0, torch.nan, 0.0]).to(dtype)
    for sigma in (1e-3, 0.3, 300.0):
        with torch.autocast("cpu", autocast or torch.bfloat16, enabled=autocast is not None):
            # that of UrbanNeRF has one for all rays
            given = sigma if loss_of.func is urban_nerf_loss else torch.full_like(prior, sigma)
            loss = loss_of(weights, edges[:, :-1], edges[:, 1:], prior, given).sum()
        (gradient,) = torch.autograd.grad(loss, weights)
        assert loss.dtype == torch.float32 and math.isfinite(loss.item()), sigma
        # float16 ends at 65,504: a gradient beyond is infinite in it, and the scaler of mixed precision skips the step
        assert torch.isfinite(gradient).all() or dtype == torch.float16, sigma
        assert not torch.isnan(gradient).any() and (gradient.any() or sigma < 0.1), sigma


@pytest.mark.parametrize("dtype", [*HALVES, torch.float32])
def test_the_losses_of_samples_are_finite(dtype: torch.dtype) -> None:
    edges, weights = samples(dtype)
    # these are in the spacing of 0..1, ascending
    edges = (edges / 100).nan_to_num(posinf=1.0).clamp(0, 1).sort(-1).values
    outer = edges[:, ::3].contiguous()
    for loss_of, trained in (
        (lambda w: distortion_loss(edges, w), weights),
        (lambda w: interlevel_loss(edges, weights, outer, w), torch.zeros(7, 4, dtype=dtype)),
    ):
        given = trained.clone().requires_grad_()
        loss = loss_of(given)
        (gradient,) = torch.autograd.grad(loss, given)
        assert math.isfinite(loss.item()) and torch.isfinite(gradient).all()


# ---- integration -----------------------------------------------------------------------------------------------
@PRECISIONS
@pytest.mark.parametrize("normalise", ["pooled", "residual"])
def test_integration_is_finite(dtype: torch.dtype, autocast: Any, normalise: Any) -> None:
    torch.manual_seed(2)
    lidar, mono = torch.rand(20, 23) * 80, torch.rand(20, 23) * 80
    lidar[torch.rand(20, 23) > 0.1] = 0
    mono[0, :5] = torch.tensor([torch.nan, torch.inf, -torch.inf, -3.0, 60000.0])
    mono[3, 3], lidar[3, 3] = 1e-6, 60000.0
    options = IntegrationOptions(normalise=normalise, sigma_depth_growth_per_m=0.005)
    one = torch.zeros(20, 23, dtype=torch.bool)
    one[7, 8] = True
    for valid in (torch.ones_like(one), one, torch.zeros_like(one)):
        with torch.autocast("cpu", autocast or torch.bfloat16, enabled=autocast is not None):
            found = integrate_depth(lidar.to(dtype), mono.to(dtype), valid, options)
            sigma = combined_sigma_m(found, mono.to(dtype))
            assert torch.isfinite(sigma).all() and ((sigma > 0) == (found.distance_m > 0)).all()
        for values in (found.distance_m, found.spread_m, found.mono_share):
            assert torch.isfinite(values).all() and (values[~valid] == 0).all()
        assert (found.distance_m > 0).sum() <= valid.sum()


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (0, 4), (0, 0)])
def test_maps_of_next_to_nothing(shape: tuple[int, ...]) -> None:
    ones = torch.ones(shape)
    for source in ("integrated", "lidar", "mono"):
        found = select_prior(source, {"lidar": ones, "mono": ones}, ones > 0)
        assert found.distance_m.shape == shape and torch.isfinite(found.distance_m).all()


# ---- hostile scenes --------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera's first frames of the sample drive that nothing was done to, with what trainings keep beside them."""
    folder = copy_sample_drive(tmp_path_factory.mktemp("plain") / "scene")
    with transforms(folder) as meta:
        kept = [f for f in meta["frames"] if f["camera"] == "image_02" and f["frame"] < 6]
        for frame in kept:
            for key in [key for key in frame if key.startswith("truth")]:
                del frame[key]
        names = {frame["file_path"] for frame in kept}
        meta["frames"] = kept
        for key in ("train_filenames", "val_filenames", "test_filenames"):
            meta[key] = [name for name in meta[key] if name in names]
        meta.pop("shifted_views")
    for path in folder.rglob("*.png"):
        if path.parent.parent.name in ("images", "lidar", "mono") and f"images/image_02/{path.name}" not in names:
            path.unlink()
    shutil.rmtree(folder / "truth")
    return folder


def every(scene: Path, kind: str) -> list[Path]:
    return sorted((scene / kind / "image_02").glob("*.png"))


def fill(kind: str, metres: float) -> Callable[[Path], None]:
    def change(scene: Path) -> None:
        for path in every(scene, kind):
            write_distance_png(path, np.full((128, 128), metres))

    return change


def paint(value: int) -> Callable[[Path], None]:
    def change(scene: Path) -> None:
        for path in every(scene, "images"):
            write_png(path, np.full((128, 128, 3), value, np.uint8))

    return change


def one_lidar_point(scene: Path) -> None:
    fill("lidar", 0.0)(scene)
    single = np.zeros((128, 128))
    single[64, 70] = 5.0
    write_distance_png(every(scene, "lidar")[0], single)


def one_pixel(scene: Path) -> None:
    """Masks of training pictures; a held-out one may not be so small."""
    with transforms(scene) as meta:
        keep = np.zeros((128, 128), bool)
        keep[70, 64] = True
        write_mask(scene / "masks/one.png", keep)
        for frame in meta["frames"]:
            if frame["file_path"] in meta["train_filenames"]:
                frame["mask_path"] = "masks/one.png"


def moved(first_m: float, next_m: float) -> Callable[[Path], None]:
    """All three coordinates of each pose get more."""

    def apply(scene: Path) -> None:
        with transforms(scene) as meta:
            for number, frame in enumerate(meta["frames"]):
                for row in frame["transform_matrix"][:3]:
                    row[3] += first_m + number * next_m

    return apply


def in_one_place(scene: Path) -> None:
    with transforms(scene) as meta:
        for frame in meta["frames"]:
            frame["transform_matrix"] = np.eye(4).tolist()


def one_training_picture(scene: Path) -> None:
    with transforms(scene) as meta:
        meta["train_filenames"] = meta["train_filenames"][:1]


def both(*changes: Callable[[Path], None]) -> Callable[[Path], None]:
    def apply(scene: Path) -> None:
        for change in changes:
            change(scene)

    return apply


def same(scene: Path) -> None:
    """Only options are hostile."""


HOSTILE: dict[str, tuple[Callable[[Path], Any], dict[str, Any]]] = {
    "no LiDAR return": (fill("lidar", 0.0), {}),
    "one LiDAR return": (one_lidar_point, {}),
    "mono of nothing": (fill("mono", 0.0), {}),
    "mono far": (fill("mono", 255.9), {}),
    "all far": (both(fill("mono", 255.9), fill("lidar", 255.9)), {}),
    "all at 4 mm": (both(fill("mono", 1 / 256), fill("lidar", 1 / 256)), {}),
    "flat maps, no alignment, literal sigma": (
        both(fill("mono", 7.0), fill("lidar", 7.0)),
        {"data__prior": PriorOptions(align="none", sigma_mode="constant"), "losses__edge": EdgeLoss(gaussian="point")},
    ),
    "masks of one pixel": (one_pixel, {}),
    "one training pixel": (both(one_training_picture, one_pixel), {}),
    "black": (paint(0), {}),
    "white": (paint(255), {}),
    "all in one place": (in_one_place, {}),
    "far from the origin": (moved(1e7, 0), {}),
    "far from each other": (moved(0, 1e6), {}),
    "a metre is a speck": (same, {"parser__metres_per_unit": 1e6}),
    "a metre is a world": (same, {"parser__metres_per_unit": 1e-6}),
    "far plane at 1e9 m": (same, {"model__far_m": 1e9}),
    "near plane at 0.1 mm": (same, {"model__near_m": 1e-4}),
    "large weight": (same, {"model__depth_loss_mult": 1e4}),
    **{
        f"{name} at the limit": (
            same,
            {
                "model__depth_loss": name,
                # pyrefly: ignore[unexpected-keyword]
                f"losses__{name.replace('-', '_')}": replace(depth_losses.LOSSES[name](), sigma_m=1e-3),
            },
        )
        for name in ("ds-nerf", "urban-nerf", "urban-nerf-los")
    },
}


REFUSED: dict[str, str] = {
    "mono of nothing": "no training pixel has a depth prior",
    "all at 4 mm": "no depth prior is between the near plane",
    "a metre is a world": "metres-per-unit",
    "far plane at 1e9 m": "far-m",
}
"""Said before the first step: what is said."""


@pytest.mark.slow
@pytest.mark.parametrize("case", HOSTILE)
def test_a_step_on_a_hostile_scene_is_finite_or_refused(tmp_path: Path, plain: Path, case: str) -> None:
    change, options = HOSTILE[case]
    scene = plain
    if change is not same:
        scene = Path(shutil.copytree(plain, tmp_path / "scene", ignore=shutil.ignore_patterns(".cache")))
        change(scene)
    try:
        trainer = trainer_of(scene, tmp_path / "runs", **options)
    except InputError as error:
        assert case in REFUSED and re.search(REFUSED[case], str(error)), (case, error)
        return
    assert case not in REFUSED
    for step in range(3):
        loss, losses, _ = trainer.train_iteration(step)
        assert math.isfinite(loss), (case, losses)
    for name, parameter in trainer.pipeline.model.named_parameters():
        assert torch.isfinite(parameter).all(), (case, name)
    trainer.save_checkpoint(2)


@pytest.mark.slow
@pytest.mark.parametrize("implementation", ["fused", "torch"])
def test_a_step_under_autocast_is_finite(tmp_path: Path, plain: Path, implementation: str) -> None:
    trainer = trainer_of(plain, tmp_path / "runs", model__implementation=implementation)
    trainer.mixed_precision = True  # nerfstudio has it on GPUs alone
    for step in range(3):
        assert math.isfinite(trainer.train_iteration(step)[0])


# ---- where it is not finite ------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def short(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    trainer = trainer_of(plain, tmp_path_factory.mktemp("short"), save_only_latest_checkpoint=False)
    for step in range(4):
        trainer.train_iteration(step)
        trainer.save_checkpoint(step)
    return trainer


def test_training_stops_with_the_pictures_name(short: Any) -> None:
    """A pose that became NaN: the rays of that picture are not finite."""
    poses = short.pipeline.datamanager.train_ray_generator.poses
    whole = poses.clone()
    name = short.pipeline.datamanager.train_dataset.image_filenames[2].name
    poses[2] = torch.nan
    before = {name: parameter.detach().clone() for name, parameter in short.pipeline.model.named_parameters()}
    try:
        with pytest.raises(InputError) as error:
            short.train_iteration(4)
    finally:
        poses[:] = whole
    said = str(error.value)
    assert said.startswith("Step 4: ") and "rgb_loss is nan" in said and f"from 1 pictures: {short.config.data}" in said
    assert name in said and "step-000000003.ckpt, is kept; resume with --load-dir" in said and "\n" not in said
    # the step was not taken
    assert all(torch.equal(before[name], parameter) for name, parameter in short.pipeline.model.named_parameters())
    assert math.isfinite(short.train_iteration(5)[0])


def test_no_checkpoint_with_a_parameter_that_is_not_finite(short: Any) -> None:
    table = next(parameter for parameter in short.pipeline.model.parameters() if parameter.numel() > 1000)
    kept = sorted(short.checkpoint_dir.iterdir())
    with torch.no_grad():
        whole = table.view(-1)[7].item()
        table.view(-1)[7] = math.inf
        try:
            with pytest.raises(InputError, match=r"not finite after step 9.*step-000000003\.ckpt, is kept"):
                short.save_checkpoint(9)
        finally:
            table.view(-1)[7] = whole
    assert sorted(short.checkpoint_dir.iterdir()) == kept


def test_a_checkpoint_that_cannot_be_written_leaves_the_one_before(short: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = sorted(short.checkpoint_dir.iterdir())

    def full(content: Any, path: Path) -> None:
        Path(path).write_bytes(b"half")
        raise RuntimeError("PytorchStreamWriter failed writing file data/3: file write failed")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(InputError, match=r"checkpoint of step 9 cannot be written.*step-000000003\.ckpt, is kept"):
        short.save_checkpoint(9)
    assert sorted(short.checkpoint_dir.iterdir()) == kept
    assert not (short.base_dir / ".unfinished_checkpoint").exists()


# ---- taken up again --------------------------------------------------------------------------------------------
def test_the_last_whole_checkpoint_is_taken_up(short: Any, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(short.checkpoint_dir, tmp_path / "checkpoints"))
    newest = folder / "step-000000003.ckpt"
    newest.write_bytes(newest.read_bytes()[:-1000])
    (folder / "notes.txt").write_text("nerfstudio would stumble over this")
    again = trainer_of(short.config.data, tmp_path / "runs", load_dir=folder)
    assert again._start_step == 3  # after step 2
    assert again.config.load_step is None
    saved = torch.load(folder / "step-000000002.ckpt", weights_only=True)["pipeline"]
    for name, tensor in again.pipeline.state_dict().items():
        assert torch.equal(tensor, saved[name]), name
    for path in folder.glob("*.ckpt"):
        path.write_bytes(b"")
    with pytest.raises(InputError, match=r"found 4 checkpoints, none of them complete; --load-dir takes"):
        trainer_of(short.config.data, tmp_path / "runs", load_dir=folder)
    with pytest.raises(InputError, match="found no checkpoint"):
        trainer_of(short.config.data, tmp_path / "runs", load_dir=tmp_path / "nowhere")
