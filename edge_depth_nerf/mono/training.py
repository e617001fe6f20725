"""Training of the monocular network on LiDAR: losses, augmentation, the loop with its checkpoints.

Augmentation keeps the lens's geometry true: whatever moves a pixel moves its ray with it, and a mirrored picture gets
mirrored rays. Distances along rays change in none of it. A step's randomness comes only from the seed and the step's
number, so that a killed training resumes as if it had not been interrupted.
"""

from __future__ import annotations

import functools
import json
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.mono.examples import Examples, fingerprint
from edge_depth_nerf.mono.network import (
    DepthNetwork,
    NetworkSettings,
    distance_m,
    ray_geometry,
    read_tensors,
    write_tensors,
)
from edge_depth_nerf.mono.optimizer import HiddenMuon


@dataclass(frozen=True)
class TrainingOptions:
    """How a network is trained."""

    steps: int
    """Steps at most."""
    seconds: float | None = None
    """Wall time at most, of all calls together; the learning rate follows whichever ends first."""
    batch: int = 4
    """Pictures a step."""
    learning_rate: float = 1.2e-2
    """AdamW's at its highest, after the first twentieth; falls to nothing along a cosine. With a third of it, the low
    ceiling of a car park is not found in time: the last layer has to grow for that."""
    hidden_learning_rate: float | None = 2e-2
    """Muon's at its highest, for all convolutions but the last; None: AdamW for these, too."""
    weight_decay: float = 1e-2
    """What the learning rate of AdamW takes from the weights, as a share of it."""
    balance: float = 0.5
    """Share of a picture's mean error that the scale-invariant loss forgives."""
    smoothness: float = 0.1
    """Weight of the smoothness term."""
    crop: float = 0.875
    """Least side of a crop, as a share of the picture's. Sides are whole blocks of `NetworkSettings.multiple_px`, and
    the least one is rounded up: below 8 blocks a share of 0.875 cuts nothing."""
    jitter: float = 0.15
    """Standard deviation of the logarithm of brightness and contrast; colours get a third."""
    evaluate_every: int = 50
    """Steps between two looks at the pictures kept for stopping."""
    patience: int = 10
    """Stops after so many looks without improvement."""
    seed: int = 0
    """Of the first weights and of each step."""


@dataclass
class Trained:
    """How far a training is; in the end with the weights of the best look."""

    network: DepthNetwork
    steps: int = 0
    """Steps taken."""
    best_step: int = 0
    """The step of the best look, which the weights are of."""
    abs_rel: float = math.inf
    """Mean relative error on the pictures kept for stopping at the best look, infinite before the first; NaN without
    any."""
    seconds: float = 0.0
    """Wall time of all calls together."""
    stopped_early: bool = False
    """Whether it was stopped because nothing improved any more."""
    looks_since_best: int = 0

    def is_best(self, abs_rel: float) -> bool:
        """Take note of a look; whether none before was as good."""
        if not abs_rel < self.abs_rel:
            self.looks_since_best += 1
            return False
        self.abs_rel, self.best_step, self.looks_since_best = abs_rel, self.steps, 0
        return True


@dataclass(frozen=True)
class Batch:
    """Pictures on their way into the network."""

    rgb: Float[Tensor, "n 3 h w"]
    """0 to 1."""
    geometry: Float[Tensor, "n 5 h w"]
    """See `network.ray_geometry`."""
    log_room: Float[Tensor, "n h w"]
    usable: Bool[Tensor, "n h w"]
    lidar_m: Float[Tensor, "n h w"]
    """0 = no LiDAR point."""
    weight: Float[Tensor, "n h w"]
    """Of each distance, 0 to 1."""

    def each(self, change: Callable[[Tensor], Tensor]) -> Batch:
        """All of it changed in the same way."""
        return Batch(*(change(getattr(self, entry.name)) for entry in fields(self)))


def scale_invariant_loss(
    log_error: Float[Tensor, "n h w"],
    valid: Bool[Tensor, "n h w"],
    balance: float,
    weight: Float[Tensor, "n h w"] | float = 1.0,
) -> Float[Tensor, ""]:
    """Scale-invariant log loss (Eigen et al., NIPS 2014, Eq. 4): mean(e²) - balance·mean(e)², over pictures.

    Its square root is taken, so that a few wrong LiDAR points do not dominate it. e is log(predicted / measured
    distance) where `valid`; pictures without a measurement count for nothing. With a balance of 1 a picture's scale
    does not matter; `weight` is how much each measurement counts in the means.
    """
    weight = valid * weight
    counts = weight.sum((1, 2))
    error = torch.where(valid, log_error, 0.0)
    mean = (weight * error).sum((1, 2)) / counts.clamp(min=1)
    square = (weight * error.square()).sum((1, 2)) / counts.clamp(min=1)
    # the root's slope at 0 is infinite
    loss = (square - balance * mean.square() + 1e-6).sqrt()
    measured = counts > 0
    return torch.where(measured, loss, 0.0).sum() / measured.sum().clamp(min=1)


def smoothness_loss(
    log_ratio: Float[Tensor, "n h w"], rgb: Float[Tensor, "n 3 h w"], usable: Bool[Tensor, "n h w"]
) -> Float[Tensor, ""]:
    """Edge-aware smoothness: |difference of neighbours| · exp(-10·colour difference), mean over usable pairs.

    `log_ratio` is log(predicted distance / the room's distance): floors and walls as such cost nothing. The colour
    difference is the mean of the channels' absolute differences (RGB 0 to 1).
    """
    total, count = log_ratio.new_zeros(()), log_ratio.new_zeros(())
    for axis, pair in zip((1, 2), _usable_pairs(usable), strict=True):
        step = log_ratio.diff(dim=axis).abs()
        weight = torch.exp(-10.0 * rgb.diff(dim=axis + 1).abs().mean(1))
        total = total + torch.where(pair, step * weight, 0.0).sum()
        count = count + pair.sum()
    return total / count.clamp(min=1)


# ---- batches ---------------------------------------------------------------------------------------------------


def make_batch(examples: Examples, indices: np.ndarray, settings: NetworkSettings, device: torch.device) -> Batch:
    """Put some examples together, unchanged."""

    def on_device(values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(device)

    rays, up = examples.rays[examples.lens[indices]], examples.up_in_camera[indices]
    lidar_m, height_m = examples.lidar_m[indices], examples.camera_height_m[indices]
    weight = np.ones_like(lidar_m) if examples.weight is None else examples.weight[indices]
    rgb = on_device(examples.rgb[indices]).permute(0, 3, 1, 2).float() / 255.0
    geometry, log_room = ray_geometry(on_device(rays), on_device(up), on_device(height_m), settings)
    usable, lidar, weights = (on_device(each) for each in (examples.usable[indices], lidar_m, weight))
    return Batch(rgb, geometry, log_room, usable, lidar, weights)


def augmented(batch: Batch, options: TrainingOptions, multiple_px: int, generator: np.random.Generator) -> Batch:
    """Mirror some pictures, cut all to one part of them, change their light and colours.

    A side is cut by whole blocks of `multiple_px`, down to `options.crop` of it: 512 px in blocks of 64 become 448 or
    stay, 192 px in blocks of 32 always stay.
    """
    mirrored = torch.from_numpy(generator.random(len(batch.rgb)) < 0.5).to(batch.rgb.device)
    batch = _mirror(batch, mirrored)
    height, width = batch.usable.shape[1:]
    rows, row = _cut(height, options.crop, multiple_px, generator)
    columns, column = _cut(width, options.crop, multiple_px, generator)
    part = (..., slice(row, row + rows), slice(column, column + columns))
    batch = batch.each(lambda values: values[part])
    return replace(batch, rgb=_jittered(batch.rgb, options.jitter, generator))


def _mirror(batch: Batch, which: Bool[Tensor, "n"]) -> Batch:
    """Swap left and right of some pictures, and the sign of their rays' x."""

    def chosen(values: Tensor) -> Tensor:
        return torch.where(which.reshape(-1, *[1] * (values.ndim - 1)), values.flip(-1), values)

    sign = torch.ones_like(batch.geometry[:, :, :1, :1])
    sign[:, 0] = torch.where(which, -1.0, 1.0)[:, None, None]
    batch = batch.each(chosen)
    return replace(batch, geometry=batch.geometry * sign)


def _cut(length: int, least: float, multiple: int, generator: np.random.Generator) -> tuple[int, int]:
    """Length and start of a part, the length a multiple of `multiple`."""
    blocks = length // multiple
    taken = int(generator.integers(max(math.ceil(least * blocks), 1), blocks + 1)) * multiple
    return taken, int(generator.integers(0, length - taken + 1))


def _jittered(rgb: Tensor, strength: float, generator: np.random.Generator) -> Tensor:
    count = len(rgb)
    gain = generator.normal(0, strength, (count, 1, 1, 1)) + generator.normal(0, strength / 3, (count, 3, 1, 1))
    contrast = generator.normal(0, strength, (count, 1, 1, 1))
    gain, contrast = (torch.from_numpy(np.exp(values)).to(rgb) for values in (gain, contrast))
    mean = rgb.mean((1, 2, 3), keepdim=True)
    return (((rgb - mean) * contrast + mean) * gain).clamp(0.0, 1.0)


# ---- the loop --------------------------------------------------------------------------------------------------


def identity_of(
    examples: Examples, settings: NetworkSettings, options: TrainingOptions, start: DepthNetwork | None
) -> dict[str, Any]:
    """What tells one training from another, as read back from JSON: tuples are lists."""
    weights = {name: tensor.cpu().numpy() for name, tensor in start.state_dict().items()} if start else {}
    prints = {"examples": fingerprint(vars(examples)), "start": fingerprint(weights) if start else None}
    return json.loads(json.dumps({"training": asdict(options), "settings": asdict(settings), **prints}))


def train(
    examples: Examples,
    kept: Examples | None,
    settings: NetworkSettings,
    options: TrainingOptions,
    *,
    start: DepthNetwork | None = None,
    checkpoint: Path | None = None,
    checkpoint_seconds: float = 20.0,
    report: Callable[[float, float], None] = lambda share, abs_rel: None,
) -> Trained:
    """Train a network, or resume an interrupted training; on the GPU if there is one.

    `kept` are pictures kept for stopping, with LiDAR points; None to take the last weights. `start` has the same
    settings. A killed training resumes from its checkpoint; that of another one is replaced. `report` is called after
    each step with the share done and the least error so far, infinite before the first look.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        network = DepthNetwork(settings)
    if start is not None:
        network.load_state_dict(start.state_dict())
    network = network.to(device).to(memory_format=torch.channels_last)
    optimizer = HiddenMuon(
        network,
        network.head,
        learning_rate=options.learning_rate,
        hidden_learning_rate=options.hidden_learning_rate,
        weight_decay=options.weight_decay,
    )
    trained, best = Trained(network), _copied(network)
    identity = identity_of(examples, settings, options, start)
    if checkpoint is not None and checkpoint.is_file():
        _resume(checkpoint, identity, trained, optimizer, best)

    started = time.monotonic() - trained.seconds
    saved = time.monotonic()
    with _workers(device) as workers:
        while not trained.stopped_early and (share := _share(trained, options)) < 1.0:
            _step(trained, share, optimizer, examples, options, device, workers)
            trained.steps += 1
            trained.seconds = time.monotonic() - started
            share = _share(trained, options)
            if kept is not None and (share >= 1.0 or trained.steps % options.evaluate_every == 0):
                if trained.is_best(abs_rel(network, kept, device)):
                    best = _copied(network)
                trained.stopped_early = share < 1.0 and trained.looks_since_best >= options.patience
            finished = share >= 1.0 or trained.stopped_early
            if checkpoint is not None and (finished or time.monotonic() - saved >= checkpoint_seconds):
                _save(checkpoint, identity, trained, optimizer, best)
                saved = time.monotonic()
            report(1.0 if finished else share, trained.abs_rel)

    if kept is None:
        trained.abs_rel, trained.best_step = math.nan, trained.steps
    else:
        network.load_state_dict(best)
    network.cpu().eval()
    return trained


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch work with so many threads, in this thread and in those that begin meanwhile."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _workers(device: torch.device) -> Iterator[ThreadPoolExecutor | None]:
    """Two threads for the halves of each step, if torch may use two; else None.

    The network is so small that torch's own threads mostly wait for each other: two take half as much processor time
    again, and save an eighth of the time.
    """
    each = torch.get_num_threads() // 2
    if device.type != "cpu" or each < 1:
        yield None
        return
    with torch_threads(each), ThreadPoolExecutor(2, initializer=torch.set_num_threads, initargs=(each,)) as workers:
        yield workers


def _copied(network: DepthNetwork) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in network.state_dict().items()}


def _share(trained: Trained, options: TrainingOptions) -> float:
    """How much of the training is done: of its steps, or of its time."""
    by_time = trained.seconds / options.seconds if options.seconds else 0.0
    return min(max(trained.steps / options.steps, by_time), 1.0)


def _rate(share: float) -> float:
    """Learning rate as a share of the highest: a short rise, then a cosine."""
    return min(share / 0.05 + 0.02, 1.0) * (0.5 + 0.5 * math.cos(math.pi * share))


def _step(
    trained: Trained,
    share: float,
    optimizer: HiddenMuon,
    examples: Examples,
    options: TrainingOptions,
    device: torch.device,
    workers: ThreadPoolExecutor | None,
) -> None:
    mapped, network, settings = map if workers is None else workers.map, trained.network, trained.network.settings
    generator = np.random.default_rng([options.seed, trained.steps])
    indices = generator.choice(len(examples), min(options.batch, len(examples)), replace=False)
    batch = augmented(make_batch(examples, indices, settings, device), options, settings.multiple_px, generator)
    parameters = optimizer.parameters
    found = mapped(lambda loss: torch.autograd.grad(loss(), parameters), _losses(network, batch, options))
    # always in this order: the sum is the same, whichever worker was done first
    for parameter, *gradients in zip(parameters, *found, strict=True):
        parameter.grad = functools.reduce(torch.add, gradients)
    torch.nn.utils.clip_grad_norm_(parameters, 1.0)
    optimizer.step(_rate(share), mapped)


def _losses(network: DepthNetwork, batch: Batch, options: TrainingOptions) -> list[Callable[[], Tensor]]:
    """Give what computes a batch's loss: on the CPU in two parts, the halves of its pictures, whose sum it is."""
    count = len(batch.rgb)
    half = -(-count // 2) if batch.rgb.device.type == "cpu" else count
    parts = [batch.each(lambda values, first=first: values[first : first + half]) for first in range(0, count, half)]
    measured, pairs = (torch.stack(counts) for counts in zip(*map(_counts, parts), strict=True))
    shares = zip(measured / measured.sum().clamp(min=1), pairs / pairs.sum().clamp(min=1), strict=True)
    return [functools.partial(_loss, network, part, options, *share) for part, share in zip(parts, shares, strict=True)]


def _counts(batch: Batch) -> tuple[Tensor, Tensor]:
    """What the two losses are means over: pictures with a measurement, and usable pairs of neighbours."""
    measured = ((batch.lidar_m > 0) & batch.usable & (batch.weight > 0)).flatten(1).any(1)
    rows, columns = (pair.sum() for pair in _usable_pairs(batch.usable))
    return measured.sum(), rows + columns


def _usable_pairs(usable: Bool[Tensor, "n h w"]) -> Iterator[Bool[Tensor, "n _ _"]]:
    """Where a pixel and the next one are usable: down the columns, then along the rows."""
    for axis in (1, 2):
        length = usable.shape[axis] - 1
        yield usable.narrow(axis, 0, length) & usable.narrow(axis, 1, length)


def _loss(
    network: DepthNetwork, batch: Batch, options: TrainingOptions, of_pictures: Tensor, of_pairs: Tensor
) -> Float[Tensor, ""]:
    """A part's share of the loss, where it has these shares of the measured pictures and of the usable pairs."""
    log_ratio = network(batch.rgb, batch.geometry, batch.usable)
    valid = (batch.lidar_m > 0) & batch.usable
    log_error = log_ratio + batch.log_room - batch.lidar_m.clamp(min=1e-3).log()
    loss = of_pictures * scale_invariant_loss(log_error, valid, options.balance, batch.weight)
    return loss + options.smoothness * of_pairs * smoothness_loss(log_ratio, batch.rgb, batch.usable)


@torch.no_grad()
def abs_rel(network: DepthNetwork, examples: Examples, device: torch.device) -> float:
    """Mean of |predicted - measured| / measured over all LiDAR points of the examples."""
    total, count = 0.0, 0
    for first in range(0, len(examples), 4):
        batch = make_batch(examples, np.arange(first, min(first + 4, len(examples))), network.settings, device)
        predicted_m = distance_m(network(batch.rgb, batch.geometry, batch.usable), batch.log_room)
        valid = (batch.lidar_m > 0) & batch.usable
        total += float(((predicted_m - batch.lidar_m).abs() / batch.lidar_m.clamp(min=1e-3))[valid].double().sum())
        count += int(valid.sum())
    return total / count if count else math.nan


# ---- checkpoints -----------------------------------------------------------------------------------------------


def _save(
    path: Path, identity: dict[str, Any], trained: Trained, optimizer: HiddenMuon, best: dict[str, Tensor]
) -> None:
    tensors = {f"network/{name}": tensor for name, tensor in trained.network.state_dict().items()}
    tensors |= {f"best/{name}": tensor for name, tensor in best.items()}
    tensors |= {f"optimizer/{name}": tensor for name, tensor in optimizer.tensors()}
    reached = {entry.name: getattr(trained, entry.name) for entry in fields(Trained) if entry.name != "network"}
    # JSON has no infinity
    reached["abs_rel"] = None if math.isinf(trained.abs_rel) else trained.abs_rel
    write_tensors(path, tensors, {"identity": identity, "reached": reached})


def _resume(
    path: Path, identity: dict[str, Any], trained: Trained, optimizer: HiddenMuon, best: dict[str, Tensor]
) -> None:
    """Load a checkpoint into all that `train` has; one of another training changes nothing."""
    try:
        tensors, header = read_tensors(path)
    except InputError:
        return
    if header.get("identity") != identity:
        return
    groups: dict[str, dict[str, Tensor]] = {"network": {}, "best": {}, "optimizer": {}}
    for name, tensor in tensors.items():
        kind, _, rest = name.partition("/")
        groups[kind][rest] = tensor
    trained.network.load_state_dict(groups["network"])
    best.update(groups["best"])
    optimizer.load(groups["optimizer"])
    for name, value in header["reached"].items():
        setattr(trained, name, math.inf if value is None else value)
