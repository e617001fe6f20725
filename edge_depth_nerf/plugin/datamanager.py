"""Serves training rays with colour and depth prior.

Host-facing. `setup_train` integrates the prior of each training picture once; ns-render and the viewer's thumbnails
never wait for it. The prior uses the frame's own maps: no training frame contains a sweep of a held-out frame. Its
calibration (`mono.calibration`) is measured on training frames alone, unless the scene has one.

Batches are read from a table of all valid pixels of all training pictures (`pixel_table`), which serves scenes of one
picture, of mixed sizes, with and without masks. It is kept on disk for the next training of the scene.
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import shlex
import tempfile
from collections import deque
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import tyro
from jaxtyping import UInt8
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader, RandIndicesEvalDataloader
from nerfstudio.model_components.ray_generators import RayGenerator
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from rich.progress import track
from torch import Tensor

from edge_depth_nerf.base.checked_cache import keep_last, used
from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.method.error_model import Calibration
from edge_depth_nerf.method.integration import INTEGRATED
from edge_depth_nerf.method.metrics import has_whole_window
from edge_depth_nerf.method.prior import (
    BESIDE_MOTION,
    CACHE_VERSION,
    CALIBRATED,
    PriorCache,
    PriorOptions,
    default_source,
    ray_angles,
    sky_of,
)
from edge_depth_nerf.mono.calibration import field_of_source, find_calibration
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig
from edge_depth_nerf.plugin.dataset import FisheyeDepthDataset
from edge_depth_nerf.plugin.pixel_table import (
    RECORD,
    TABLE_VERSION,
    PicturePixels,
    PixelBatch,
    PixelTable,
    decode,
    write_table,
)
from edge_depth_nerf.plugin.ray_table import TableRayGenerator
from edge_depth_nerf.plugin.upload import Stretch, batches_on
from edge_depth_nerf.scene.format import LAYERS, depth_sources

KEPT_TABLES = 8
"""This many tables of pixels are kept per scene, the last used ones. 300 pictures of 1400×1400 px take 6 GB."""
SHORT_NAMES = {"lidar": "LiDAR", "mono": "monocular"}
"""Of sources of the prior, in a line."""
SURFACE_SIGMA_M = 0.1
SURFACE_SIGMA_SHARE = 0.15
"""A prior is too vague for a surface if its sigma exceeds these metres plus this share of its distance."""


@dataclass
class PriorSourceOptions:
    """Our options, before nerfstudio's in the help."""

    depth_source: str = "auto"
    """The prior's source. integrated: LiDAR, monocular maps and motion; lidar, mono, motion or another: this one alone;
    none; auto: what the scene has."""
    prior: tyro.conf.Suppress[PriorOptions] = field(default_factory=PriorOptions)
    """How the prior is computed from these maps."""
    surface_rays_per_batch: int = 16384
    """Additional pixels in each batch, whose colour is compared with the field's at the prior's distance. 0: none."""
    cache_dir: Path | None = None
    """Folder for priors and tables of training pixels. Not set: .cache/ in the scene folder."""


@dataclass
class FisheyeDepthDataManagerConfig(VanillaDataManagerConfig, PriorSourceOptions):
    """Rays of fisheye pictures with an edge-aware integrated depth prior."""

    _target: type = field(default_factory=lambda: FisheyeDepthDataManager)
    """Target class to instantiate."""
    dataparser: AnnotatedDataParserUnion = field(default_factory=FisheyeDepthDataParserConfig)
    """Specifies the dataparser used to unpack the data."""

    def source_of_prior(self, sources: Collection[str]) -> str | None:
        """Return the depth source, of layers that all pictures have; `auto` becomes what the scene has. None: no prior.

        Raises:
            InputError: the depth source is unknown, or is not in the scene.
        """
        if self.depth_source == "none":
            return None
        if self.depth_source == "auto":
            return default_source(sources)
        known = ("auto", INTEGRATED, *depth_sources(), "none")
        if self.depth_source not in known:
            raise InputError(f"depth_source is {self.depth_source!r}; expected one of {', '.join(known)}.")
        needed = ("lidar", "mono") if self.depth_source == INTEGRATED else (self.depth_source,)
        missing = [LAYERS[name].words for name in needed if name not in sources]
        if missing:
            raise InputError(
                f"{self.dataparser.data}: the scene has no {' and no '.join(missing)}, but depth_source "
                f"{self.depth_source} needs them. Process the drive again (monocular maps alone: `edge-depth-nerf "
                "estimate-depth`), or choose another --pipeline.datamanager.depth-source "
                f"({', '.join(known[1:-1])}), or train without a prior by --pipeline.model.depth-loss none."
            )
        return self.depth_source


class TablePixelSampler:
    """Says which records of a table are the next batch; nerfstudio's exporter sets `num_rays_per_batch`.

    Processes that train together (torch.distributed) each read a part of every batch. All start at the same record,
    and no two read the same records.
    """

    def __init__(self, table: PixelTable, num_rays_per_batch: int, device: torch.device | str = "cpu"):
        self.table = table
        self.num_rays_per_batch = num_rays_per_batch
        # another seed starts at another record
        first = torch.randint(len(table), ())
        self._rank, self._world_size = 0, 1
        if dist.is_available() and dist.is_initialized():
            self._rank, self._world_size = dist.get_rank(), dist.get_world_size()
            first = first.to(device)
            dist.broadcast(first, src=0)
        self._first = int(first)
        self._drawn = 0

    def draw(self, step: int = 0) -> Stretch:
        """Return which records are the next batch; at a later step, the batch of that step."""
        # a resumed training continues at its record; the exporter always passes 0
        self._drawn = max(self._drawn, step * self.num_rays_per_batch)
        start = self._first + self._drawn * self._world_size + self._rank * self.num_rays_per_batch
        self._drawn += self.num_rays_per_batch
        return Stretch(start, self.num_rays_per_batch, self.num_rays_per_batch * self._world_size)


class FisheyeDepthDataManager(VanillaDataManager[FisheyeDepthDataset]):
    """DataManager of fisheye scenes.

    A batch contains image (n×3), indices (n×3: picture, row, column), prior_distance_m and prior_sigma_m (n×1, metres,
    0 = no prior), and sky (n×1, bool: shows the sky). For the additional pixels, these names start with surface_, and
    surface_rays are their rays. On the CPU the batch only has the useful additional pixels. On a GPU it always has all
    of them, because counting them would wait for the GPU; surface_counts (n×1, bool) marks the useful ones.
    """

    config: FisheyeDepthDataManagerConfig
    train_dataset: FisheyeDepthDataset
    eval_dataset: FisheyeDepthDataset
    train_pixel_sampler: TablePixelSampler | None = None  # pyrefly: ignore
    eval_pixel_sampler: TablePixelSampler | None = None  # pyrefly: ignore
    trained_on: Tensor
    """Picture, row and column of each ray of the last training batch."""

    def __init__(self, config: FisheyeDepthDataManagerConfig, *args: Any, **kwargs: Any):
        self._temporary: list[tempfile.TemporaryDirectory[str]] = []
        super().__init__(config, *args, **kwargs)

    def setup_train(self) -> None:
        """Integrate the prior of each training picture and write the table of their pixels, or open an existing one."""
        # if several processes train on a scene, the first one makes what they share
        with only_writer(self._cache_dir(), CONSOLE):
            table = self._table(self.train_dataset, "Integrating depth", with_prior=True)
            self.train_ray_generator = self._ray_generator(self.train_dataset)
        self.train_pixel_sampler = TablePixelSampler(table, self.config.train_num_rays_per_batch, self.device)
        self._batches = batches_on(self.device, table)
        self._surface_sampler = None
        if self.config.surface_rays_per_batch > 0 and table.share_with_prior > 0:
            self._surface_sampler = TablePixelSampler(table, self.config.surface_rays_per_batch, self.device)
        said = f"{len(self.train_dataset)} training pictures, {len(table):,} pixels."
        if table.share_with_prior > 0:
            shares = (f"{SHORT_NAMES.get(name, name)} {share:.0%}" for name, share in table.shares_of_sources.items())
            said += f" Prior: {table.share_with_prior:.0%} of them; {', '.join(shares)}"
            said += f"; `edge-depth-nerf inspect {shlex.quote(str(self.config.dataparser.data))}` shows it."
        say(CONSOLE, said)

    def setup_eval(self) -> None:
        """Write or open the table of held-out pixels (no prior), and prepare the loaders of whole views."""
        with only_writer(self._cache_dir(), CONSOLE):
            table = self._table(self.eval_dataset, "Reading held-out pictures", with_prior=False)
            self.eval_ray_generator = self._ray_generator(self.eval_dataset)
        self.eval_pixel_sampler = TablePixelSampler(table, self.config.eval_num_rays_per_batch, self.device)
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(
            input_dataset=self.eval_dataset, device=self.device
        )
        self.eval_dataloader = RandIndicesEvalDataloader(input_dataset=self.eval_dataset, device=self.device)

    def next_train(self, step: int) -> tuple[RayBundle, dict[str, Any]]:
        """Return the rays of the next training batch and their supervision; surface_…: additional pixels, if any."""
        self.set_next(step)
        return self.batch_of(self.packed(), chooses=torch.device(self.device).type == "cpu")

    def _samplers(self) -> list[TablePixelSampler]:
        return [sampler for sampler in (self.train_pixel_sampler, self._surface_sampler) if sampler is not None]

    def rays_of_a_step(self) -> list[int]:
        """Count the rays of a training batch, and its additional pixels."""
        return [sampler.num_rays_per_batch for sampler in self._samplers()]

    def set_next(self, step: int) -> None:
        """Say which pixels `packed` gives next: those after the last ones, or of a later step."""
        self.train_count += 1
        self._batches.set_next([sampler.draw(step) for sampler in self._samplers()])

    def packed(self) -> UInt8[Tensor, "n 15"]:
        """Give the packed records of the training batch and of all additional pixels on the device, at once."""
        return self._batches.packed()

    def batch_of(self, packed: UInt8[Tensor, "n 15"], chooses: bool = False) -> tuple[RayBundle, dict[str, Any]]:
        """Return the rays of a packed batch and their supervision; with all additional pixels, or the useful ones."""
        assert self.train_pixel_sampler is not None
        pixels, count = decode(packed), self.train_pixel_sampler.num_rays_per_batch
        self.trained_on = pixels.indices[:count]
        if chooses:
            pixels = pixels.where(torch.cat([torch.ones(count, dtype=torch.bool), _useful(pixels[count:])[:, 0]]))
        every, values = self._serve(pixels, self.train_ray_generator)
        batch = {name: value[:count] for name, value in values.items()}
        # the mean over no pixels would be NaN
        if len(every) > count:
            batch["surface_rays"] = every[count:]
            batch |= _of_surface({name: value[count:] for name, value in values.items()})
            if not chooses:
                batch["surface_counts"] = _useful(pixels[count:])
        return every[:count], batch

    def pictures_of(self, rays: Tensor | None = None) -> list[str]:
        """Return the names of the pictures of the last training batch, or of some of its rays."""
        pictures = self.trained_on[:, 0].cpu()
        chosen = pictures if rays is None else pictures[rays.cpu()]
        return [str(self.train_dataset.image_filenames[image_idx]) for image_idx in chosen.unique().tolist()]

    def next_eval(self, step: int) -> tuple[RayBundle, dict[str, Any]]:
        """Return the rays of a batch of held-out pixels, and their colours."""
        self.eval_count += 1
        assert self.eval_pixel_sampler is not None
        stretch = self.eval_pixel_sampler.draw()
        packed = self.eval_pixel_sampler.table.packed(stretch.start, stretch.count)
        return self._serve(decode(packed.to(self.device)), self.eval_ray_generator)

    def _ray_generator(self, dataset: FisheyeDepthDataset) -> RayGenerator:
        """Return the table of rays if the cameras allow one, else nerfstudio's generator."""
        cameras = dataset.cameras.to(self.device)
        if TableRayGenerator.suits(cameras):
            return TableRayGenerator(cameras, self._cache_dir() / "rays")
        # its grid of pixels must be on the device of the indices
        return RayGenerator(cameras).to(self.device)

    def _cache_dir(self) -> Path:
        data = Path(self.config.dataparser.data)
        return self.config.cache_dir or (data.parent if data.suffix == ".json" else data) / ".cache"

    def _serve(self, batch: PixelBatch, generator: RayGenerator) -> tuple[RayBundle, dict[str, Any]]:
        indices = batch.indices.to(self.device)
        return generator(indices), {
            "image": batch.rgb.to(self.device),
            "indices": batch.indices,
            "prior_distance_m": batch.prior_distance_m.to(self.device),
            "prior_sigma_m": batch.prior_sigma_m.to(self.device),
            "sky": batch.sky.to(self.device),
        }

    def _priors(self, dataset: FisheyeDepthDataset) -> PriorCache | None:
        """Return what makes the priors of a split's pictures; None without a prior."""
        options, scene = self.config.prior, dataset.scene
        sources = dataset.sources()
        source = self.config.source_of_prior(sources)
        if source is None:
            return None
        calibration: Calibration | None = None
        if source in CALIBRATED and {"lidar", "mono"} <= sources and options.wants_calibration(source):
            calibration = find_calibration(
                scene, options, self._cache_dir(), dataset.image_filenames, CONSOLE, source, self.device
            )
        elif source == "mono" and options.sigma_mode == "calibrated":
            calibration = field_of_source(scene)
        elif self.config.depth_source == "auto" and source == "lidar":
            CONSOLE.log(
                f"[yellow]Depth prior: LiDAR alone, because the scene has no monocular maps, or not all of them. To "
                f"make them, run `edge-depth-nerf estimate-depth {escape(str(self.config.dataparser.data))}`."
            )
        return PriorCache(self._cache_dir() / "prior", source, options, calibration, self.device)

    def _table(self, dataset: FisheyeDepthDataset, description: str, with_prior: bool) -> PixelTable:
        """Return the table of a split's pixels: the one on disk if it matches, else a new one."""
        cache = self._priors(dataset) if with_prior else None
        path = self._cache_dir() / "pixels" / f"{_table_key(dataset, cache)}.npy"
        try:
            table = PixelTable(path)
            used(path)
            return table
        except (OSError, InputError):
            pass  # absent or incomplete: it is made now
        if not _writable(path.parent):
            # the scene folder is read-only: the table is deleted with this object
            self._temporary.append(tempfile.TemporaryDirectory(prefix="edge-depth-nerf-"))
            path = Path(self._temporary[-1].name) / path.name
        most = int((dataset.cameras.width * dataset.cameras.height).sum())
        try:
            loaded = _load(dataset, cache, whole_windows=not with_prior)
            bar = track(loaded, f"{description}…", len(dataset), console=CONSOLE, transient=True)
            write_table(path, most, bar)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise
            raise InputError(
                # pyrefly: ignore[bad-argument-type]
                f"{path.parent}: the table of pixels cannot be written ({os.strerror(error.errno)}); it needs up to "
                f"{most * RECORD.itemsize / 1e9:.2g} GB. Free some space there, or choose another folder with "
                "--pipeline.datamanager.cache-dir."
            ) from error
        keep_last(path.parent, "*.npy", KEPT_TABLES)
        if cache is not None:
            cache.remove_old(len(dataset))
        return PixelTable(path)


def _useful(pixels: PixelBatch) -> Tensor:
    """Say whether pixels show the sky, or a surface whose prior is not too vague."""
    clear = pixels.prior_sigma_m.sub(pixels.prior_distance_m, alpha=SURFACE_SIGMA_SHARE) <= SURFACE_SIGMA_M
    return pixels.sky | (pixels.prior_distance_m > 0) & clear


def _of_surface(values: dict[str, Tensor]) -> dict[str, Tensor]:
    """Rename a batch's entries to those of additional pixels."""
    names = {"prior_distance_m": "distance_m", "prior_sigma_m": "sigma_m"}
    return {f"surface_{names.get(name, name)}": value for name, value in values.items()}


def _load(dataset: FisheyeDepthDataset, cache: PriorCache | None, whole_windows: bool) -> Iterator[PicturePixels]:
    """Yield colours, mask, prior with sigma, and sky of each picture.

    Raises:
        InputError: a file cannot be used. With `whole_windows`, also: a mask leaves too few pixels for evaluation.
    """

    def load(image_idx: int) -> PicturePixels:
        rgb = dataset.rgb(image_idx)
        mask = dataset.mask(image_idx)
        if whole_windows and not has_whole_window(torch.from_numpy(mask)):
            image = dataset.image_filenames[image_idx]
            raise InputError(
                f"{dataset.pictures[image_idx].files.get('mask', image)}: the mask of the held-out picture "
                f"{image.name} leaves too few pixels for evaluation (no window of SSIM, 11×11 px). Correct the mask "
                "(255 = use the pixel), or do not hold out this picture."
            )
        if cache is None:
            return PicturePixels(rgb, mask)
        maps = {layer: dataset.distance_m(image_idx, layer) for layer in cache.layers}
        for layer in BESIDE_MOTION:
            if maps.get(layer) is None:
                # a scene without keeps the priors that it has
                maps.pop(layer, None)
        picture, mono = dataset.pictures[image_idx], maps.get("mono")
        view = ray_angles(picture.lens, picture.up_in_camera) if mono is not None else None
        prior = cache.prior(maps, mask, view if cache.calibration is not None else None)
        sky = None if mono is None or view is None else sky_of(mono, maps.get("lidar"), view, rgb, mask)
        if sky is not None and (motion := maps.get("motion")) is not None:
            # a pixel that was matched between pictures is not sky
            sky &= ~(motion > 0)
        sources = {name: found > 0 for name in depth_sources() if (found := maps.get(name)) is not None}
        return PicturePixels(rgb, mask, prior.distance_m, prior.sigma_m, sky, sources)

    # OpenCV and torch release the interpreter's lock, so two threads read and integrate at the same time. They are only
    # a few pictures ahead, which limits memory.
    with ThreadPoolExecutor(max_workers=2) as pool:
        waiting = deque(pool.submit(load, image_idx) for image_idx in range(min(3, len(dataset))))
        for ahead in range(len(dataset)):
            pixels = waiting.popleft().result()
            if ahead + 3 < len(dataset):
                waiting.append(pool.submit(load, ahead + 3))
            yield pixels


def _table_key(dataset: FisheyeDepthDataset, cache: PriorCache | None) -> str:
    """Return a hash of all that a table depends on: files by name, size and date, cameras, the prior's settings."""
    layers = ["image", "mask", *(cache.layers if cache else ())]
    files = [picture.files[layer] for layer in layers for picture in dataset.pictures if layer in picture.files]
    stats = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    scene = dataset.scene
    described = {
        "versions": [TABLE_VERSION, CACHE_VERSION],
        "files": stats,
        **({} if scene.crop_radius_px is None else {"crop_radius_px": scene.crop_radius_px}),
        "scene": [scene.theta_max_rad, scene.lidar_metres_per_count, scene.lidar_is_z_depth],
        "lenses": [repr((picture.lens, picture.up_in_camera.tolist())) for picture in dataset.pictures],
        "prior": None if cache is None else [cache.depth_source, dataclasses.asdict(cache.options)],
        "trust": None if cache is None or cache.calibration is None else cache.calibration.to_dict(),
    }
    return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:32]


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
