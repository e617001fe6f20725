"""Additional layers in nerfstudio's viewer: LiDAR points, the prior, a rendered scan, the path, the lenses.

Host-facing, through nerfstudio's own hooks: nerfstudio finds the `ViewerControl` in the pipeline, and the control
installs the switches. A layer is made in a thread of its own when it is first switched on. Switching it off hides it.
So neither a training nor a command without a viewer waits for it.
"""

from __future__ import annotations

import math
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
import viser
import viser.transforms
from jaxtyping import Float, Float64, Int, UInt8
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO
from nerfstudio.viewer.viewer_elements import ViewerCheckbox, ViewerControl, ViewerDropdown
from numpy.typing import NDArray
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import as_people_count
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.base.pictures import DISTANCE, SIGMA
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.plugin.coarse_to_fine import render_coarse_to_fine
from edge_depth_nerf.plugin.compat import outlive_leaving_browsers
from edge_depth_nerf.plugin.evaluation import evaluated
from edge_depth_nerf.plugin.scanning import Caster, SceneToModel, some_of
from edge_depth_nerf.scene.sweeps import SCANNERS, scanners_of

if TYPE_CHECKING:
    from nerfstudio.viewer.viewer import Viewer

    from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManager

ROOT = "/drive"
"""Parent of all our scene nodes in the viewer."""
HOST_FRUSTA = "/cameras"
"""Parent of nerfstudio's own frusta."""
MOST_POINTS = 200_000
"""Most points of a cloud. The browser receives 15 bytes for each."""
MOST_LENSES = 256
"""Most lenses that are drawn, spread over the drive."""
LENS_RADIUS_M = 0.3
"""Radius of a lens's cap at nerfstudio's default --viewer.camera-frustum-scale."""
HOST_FRUSTUM_SCALE = 0.1
"""nerfstudio's default --viewer.camera-frustum-scale."""
POINT_SIZE_M = 0.06
"""Side of a point of a cloud."""
THUMBNAIL_PX = 128
"""Longer side of the picture on a lens's cap."""
AZIMUTHS, RINGS = 48, 10
"""Corners of a cap: around the axis, and from the axis to the rim."""
SPOKES = 6
"""Lines from a lens's centre to its rim."""
THETA_STEPS = 720
"""Accuracy of the rim: theta_max / THETA_STEPS."""
PATH_COLOURS = ((230, 120, 20), (40, 160, 220), (120, 190, 60), (200, 80, 180), (230, 200, 40), (120, 120, 220))
"""One per camera; repeated if there are more."""
FOLDER = "Layers of the drive"
"""Heading of the switches in the panel."""
COLOURS = ("height", "picture", "sigma")
"""What a point's colour can show."""


@dataclass(frozen=True)
class Cloud:
    """Points in the model's coordinates (scene units)."""

    points: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    """The points' colours in the pictures."""
    height_m: Float[np.ndarray, "n"]
    """Height above the scene's origin."""
    sigma_m: Float[np.ndarray, "n"] | None
    """Standard deviation of the prior, or error of a rendered scan; LiDAR has none."""

    def colours(self, meaning: str) -> UInt8[np.ndarray, "n 3"]:
        """Return the points' colours: from the picture, or by sigma or height. Without sigma, by height."""
        if meaning == "picture":
            return self.rgb
        if meaning == "sigma" and self.sigma_m is not None:
            return SIGMA.coloured(self.sigma_m[:, None], np.ones((len(self.sigma_m), 1), bool))[:, 0]
        if not len(self.height_m):
            return self.rgb
        low, high = np.percentile(self.height_m, (2, 98))
        place = np.clip((self.height_m - low) / max(high - low, 1e-6), 0, 1)
        return DISTANCE.colours[np.rint(255 * (1 - place)).astype(int)]


def rim_rad(camera: Camera, theta_max_rad: float) -> Float64[np.ndarray, "azimuths"]:
    """Return the largest angle off-axis that a lens sees, for each azimuth (from x to y, evenly spaced).

    It is limited by the picture's border, the lens model's validity, and `theta_max_rad`.
    """
    theta = torch.linspace(0, min(theta_max_rad, camera.theta_max_rad), THETA_STEPS + 1, dtype=torch.float64)
    azimuth = _azimuths()
    pixels, valid = camera.project(_directions(theta[None, :], azimuth[:, None]))
    seen = (camera.inside(pixels) & valid).int().cumprod(-1).sum(-1)
    return theta[(seen - 1).clamp(min=0)].numpy()


def lens_cap(
    camera: Camera, theta_max_rad: float
) -> tuple[Float64[np.ndarray, "vertices 3"], Float64[np.ndarray, "vertices 2"], Int[np.ndarray, "faces 3"]]:
    """Return the part of the unit sphere that a lens sees as a mesh, in the lens's frame (OpenCV).

    Returns:
        Corners, ring by ring from the axis to the rim; the pixel (x, y) of each; triangles.
    """
    ring = torch.linspace(0, 1, RINGS + 1, dtype=torch.float64)
    theta = ring[:, None] * torch.from_numpy(rim_rad(camera, theta_max_rad))
    directions = _directions(theta, _azimuths()[None, :].expand_as(theta)).reshape(-1, 3)
    pixels, _ = camera.project(directions)
    inner = np.arange(RINGS * AZIMUTHS)
    following = inner - inner % AZIMUTHS + (inner + 1) % AZIMUTHS
    triangles = [(inner, inner + AZIMUTHS, following), (following, inner + AZIMUTHS, following + AZIMUTHS)]
    return directions.numpy(), pixels.numpy(), np.concatenate([np.stack(corners, -1) for corners in triangles])


def _azimuths() -> Float64[Tensor, "azimuths"]:
    return torch.arange(AZIMUTHS, dtype=torch.float64) * (2 * math.pi / AZIMUTHS)


def _directions(theta: Float64[Tensor, "*#shape"], azimuth: Float64[Tensor, "*#shape"]) -> Float64[Tensor, "*shape 3"]:
    sine = theta.sin()
    return torch.stack(torch.broadcast_tensors(sine * azimuth.cos(), sine * azimuth.sin(), theta.cos()), -1)


def _glb(camera: Camera, theta_max_rad: float, picture: NDArray[np.uint8], radius: float) -> bytes:
    """Return a lens as a glTF file for the browser: a cap with the picture, and lines from the centre to the rim."""
    from PIL import Image
    from trimesh import Scene, Trimesh, load_path  # takes half a second, too long for all commands
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    corners, pixels, triangles = lens_cap(camera, theta_max_rad)
    corners = corners * radius
    scale = THUMBNAIL_PX / max(camera.width, camera.height)
    size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    # a JPEG has a tenth of the size that trimesh would write
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    thumbnail = Image.open(BytesIO(cv2.imencode(".jpg", small[..., ::-1])[1].tobytes()))
    # emissive, because the browser's lamps would shade it
    material = PBRMaterial(
        baseColorFactor=[0, 0, 0, 255],
        emissiveTexture=thumbnail,
        emissiveFactor=[1.0, 1.0, 1.0],
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    uv = pixels / (camera.width, camera.height)
    visual = TextureVisuals(uv=np.stack((uv[:, 0], 1 - uv[:, 1]), -1), material=material)
    cap = Trimesh(corners, triangles, visual=visual, process=False)
    rim = corners[-AZIMUTHS:]
    spokes = np.stack([np.stack((np.zeros(3), end)) for end in rim[:: AZIMUTHS // SPOKES]])
    lines: Any = load_path(np.concatenate((np.stack((rim, np.roll(rim, -1, 0)), 1), spokes)))
    lines.colors = np.tile((255, 211, 105, 255), (len(lines.entities), 1))
    data = BytesIO()
    Scene([cap, lines]).export(data, file_type="glb")
    return data.getvalue()


def _viser_rotation(pose: Float64[np.ndarray, "3 4"]) -> viser.transforms.SO3:
    """Convert the rotation of a nerfstudio camera, which looks along -z, to viser's, which looks along z."""
    return viser.transforms.SO3.from_matrix(pose[:, :3] * (1.0, -1.0, -1.0))


class DriveLayers(ViewerControl):
    """Draws the layers. nerfstudio calls `_setup` when its viewer is ready."""

    def __init__(self, manager: FisheyeDepthDataManager, detail: bool) -> None:
        self.manager = manager
        sampler = manager.train_pixel_sampler
        has_prior = sampler is not None and sampler.table.share_with_prior > 0
        has_lidar = "lidar" in manager.train_dataset.sources()
        has_sweeps = bool(manager.train_dataset.scene.meta.get(SCANNERS))
        of_scan = "The distances that the model now gives along a recorded sweep, a held-out one if there is any"
        layers = {
            "lidar": ("LiDAR points", "LiDAR points of the training pictures", has_lidar),
            "prior": ("Depth prior", "The distances that supervise the training", has_prior),
            "scan": ("Rendered scan", of_scan, has_sweeps),
            "lenses": ("Lenses", "What each camera sees; replaces nerfstudio's pyramids", True),
            "path": ("Path", "A line through the positions of each camera", True),
        }
        self.switches = {layer: self._switch(layer, *about) for layer, about in layers.items()}
        self.meaning = ViewerDropdown(
            "Colour of points",
            COLOURS[0],
            list(COLOURS),
            cb_hook=lambda _: self._recolour(),
            hint="Sigma of the prior, or the error of the scan: dark is 0.05 m, bright is 20 m",
        )
        self.detail = ViewerCheckbox(
            "Detail of training pictures",
            detail,
            cb_hook=lambda _: self.viewer._trigger_rerender(),
            hint="Not in training: adds what training pictures show beyond their renderings. New places take longer",
        )
        self._frames: dict[str, viser.FrameHandle] = {}
        self._clouds: dict[str, Cloud] = {}

    def _switch(self, layer: str, label: str, hint: str, available: bool) -> ViewerCheckbox:
        hint = hint if available else "This training has none"
        # from inside a lens, its picture would look like a perfect rendering; clouds take time
        shown = layer == "path"
        return ViewerCheckbox(label, shown, disabled=not available, cb_hook=lambda _: self._update(layer), hint=hint)

    def _setup(self, viewer: Viewer) -> None:
        """Install the panel, and draw the layers that are on at the start."""
        super()._setup(viewer)
        outlive_leaving_browsers(viewer)
        gui = viewer.viser_server.gui
        # above the panel's tabs, where they are visible at once
        with gui.add_folder(FOLDER, order=viewer.stats_markdown.order + 0.5):
            for element in (*self.switches.values(), self.meaning, self.detail):
                element.install(viewer.viser_server)
        labels = ", ".join(switch.name for switch in self.switches.values() if not switch.disabled)
        CONSOLE.print(f"The viewer's panel switches these layers on and off: {labels}.")
        viewer.viser_server.on_client_connect(self._welcome)
        # created before nerfstudio's frusta, this parent hides all of them
        viewer.viser_server.scene.add_frame(HOST_FRUSTA, show_axes=False, visible=False)
        if viewer.trainer is None or viewer.trainer.training_state == "completed":
            self.end_training()
        # nerfstudio asks for no other picture when a training is paused
        viewer.pause_train.on_click(lambda _: self._ask_for_detail())
        # our switch does what these do
        viewer.hide_images.visible = viewer.show_images.visible = False
        for layer in self.switches:
            self._update(layer)

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Start a browser at a training picture: the middle one of the drive's first camera."""
        dataset = self.manager.train_dataset
        folder = dataset.image_filenames[0].parent
        of_camera = [index for index, file in enumerate(dataset.image_filenames) if file.parent == folder]
        index = of_camera[len(of_camera) // 2]
        pose = dataset.cameras.camera_to_worlds[index].double().cpu().numpy()
        first = self.viewer.get_camera_state(client)
        with client.atomic():
            client.camera.position = pose[:, 3] * VISER_NERFSTUDIO_SCALE_RATIO
            client.camera.wxyz = _viser_rotation(pose).wxyz
        self.viewer.current_camera_idx = index
        self.viewer.update_step(self.viewer.step)
        render_coarse_to_fine(self.viewer, client, first, self.shows_detail)

    def shows_detail(self) -> bool:
        """Return whether complete pictures have detail: never during a training, which changes it at each step."""
        trainer = self.viewer.trainer
        return bool(self.detail.value) and (trainer is None or trainer.training_state != "training")

    def _ask_for_detail(self) -> None:
        """Ask for another picture, if that one has detail."""
        if self.detail.value:
            self.viewer._trigger_rerender()

    def end_training(self) -> None:
        """Take away the buttons that pause and resume a training."""
        self.viewer.pause_train.visible = self.viewer.resume_train.visible = False

    def _update(self, layer: str) -> None:
        """Show or hide a layer's nodes, according to its switch."""
        shown = bool(self.switches[layer].value)
        if layer in self._frames:
            self._frames[layer].visible = shown
        elif shown:
            self.switches[layer].set_disabled(True)
            Thread(target=self._make, args=(layer,), daemon=True).start()

    def _make(self, layer: str) -> None:
        """Draw a layer for the first time."""
        node = f"{ROOT}/{layer}"
        frame = self.viser_server.scene.add_frame(node, show_axes=False, visible=False)
        try:
            if layer == "lenses":
                self._draw_lenses(node)
            elif layer == "path":
                self._draw_path(node)
            else:
                self._clouds[layer] = {"lidar": self._lidar, "prior": self._prior, "scan": self._scan}[layer]()
                self._draw_cloud(layer)
        except (InputError, OSError) as error:
            CONSOLE.print(f"The viewer cannot show this layer ({layer}). {error}", style="yellow", markup=False)
            self.switches[layer].value = False
            return
        finally:
            self.switches[layer].set_disabled(False)
        self._frames[layer] = frame
        self._update(layer)

    # ---- lenses and path ----------------------------------------------------------------------------------------

    def _draw_lenses(self, node: str) -> None:
        dataset = self.manager.train_dataset
        limit_rad = dataset.scene.theta_max_rad
        radius = self._units(LENS_RADIUS_M) * self.viewer.config.camera_frustum_scale / HOST_FRUSTUM_SCALE
        for index in spread_over(len(dataset), MOST_LENSES):
            pose = dataset.cameras.camera_to_worlds[index].double().cpu().numpy()
            lens = self.viser_server.scene.add_glb(
                f"{node}/{index:05d}",
                _glb(dataset.pictures[index].lens, limit_rad, dataset.rgb(index), radius),
                wxyz=_viser_rotation(pose).wxyz,
                position=pose[:, 3] * VISER_NERFSTUDIO_SCALE_RATIO,
            )
            lens.on_click(partial(self._go_there, index))

    def _go_there(self, index: int, event: viser.SceneNodePointerEvent[viser.GlbHandle]) -> None:
        """Move the browser to the camera, as a click on nerfstudio's own frusta does."""
        with event.client.atomic():
            event.client.camera.position = event.target.position
            event.client.camera.wxyz = event.target.wxyz
            self.viewer.current_camera_idx = index

    def _draw_path(self, node: str) -> None:
        """Draw one line for each folder of pictures, with the held-out ones."""
        places: dict[Path, list[tuple[Path, NDArray]]] = {}
        for dataset in (self.manager.train_dataset, self.manager.eval_dataset):
            positions = dataset.cameras.camera_to_worlds[:, :3, 3].cpu().numpy()
            for file, position in zip(dataset.image_filenames, positions, strict=True):
                places.setdefault(file.parent, []).append((file, position))
        named = Counter(folder.name for folder in places)
        for number, (folder, camera) in enumerate(sorted(places.items())):
            line = np.stack([position for _, position in sorted(camera, key=lambda place: as_people_count(place[0]))])
            if len(line) < 2:
                continue
            self.viser_server.scene.add_spline_catmull_rom(
                f"{node}/{folder.name if named[folder.name] == 1 else f'{folder.parent.name}_{folder.name}'}",
                line * VISER_NERFSTUDIO_SCALE_RATIO,
                line_width=3,
                color=PATH_COLOURS[number % len(PATH_COLOURS)],
                segments=4 * len(line),
            )

    # ---- clouds -------------------------------------------------------------------------------------------------

    def _lidar(self) -> Cloud:
        """Collect LiDAR points of the training pictures, a share of each picture."""
        dataset = self.manager.train_dataset
        rng = np.random.default_rng(0)
        pixels, distances, colours = [], [], []
        for index in range(len(dataset)):
            distance_m = dataset.distance_m(index, "lidar")
            assert distance_m is not None
            row, column = np.nonzero(dataset.mask(index) & np.isfinite(distance_m) & (distance_m > 0))
            chosen = rng.permutation(len(row))[: MOST_POINTS // len(dataset)]
            row, column = row[chosen], column[chosen]
            pixels.append(np.stack((np.full(len(row), index), row, column), 1))
            distances.append(distance_m[row, column])
            colours.append(dataset.rgb(index)[row, column])
        return self._cloud(np.concatenate(pixels), np.concatenate(distances), np.concatenate(colours), None)

    def _prior(self) -> Cloud:
        """Collect the first pixels with a prior from the training's table, whose order is random."""
        assert self.manager.train_pixel_sampler is not None
        table = self.manager.train_pixel_sampler.table
        batch = table.batch(0, min(len(table), round(MOST_POINTS / table.share_with_prior)))
        known = batch.prior_distance_m[:, 0] > 0
        colours = (batch.rgb[known].numpy() * 255).round().astype(np.uint8)
        distance_m, sigma_m = (values[known, 0].numpy() for values in (batch.prior_distance_m, batch.prior_sigma_m))
        return self._cloud(batch.indices[known].numpy(), distance_m, colours, sigma_m)

    def _scan(self) -> Cloud:
        """Cast the rays of a recorded sweep into the present model; sigma is their error."""
        dataset, model = self.manager.train_dataset, self.viewer.pipeline.model
        scanners = scanners_of(dataset.scene.meta, dataset.scene.path).values()
        sweeps = [sweep for scanner in scanners for sweep in scanner.sweeps]
        sweeps = [sweep for sweep in sweeps if sweep.held_out] or sweeps
        rays, place = sweeps[len(sweeps) // 2].read(), SceneToModel.of(dataset._dataparser_outputs, dataset.scene.meta)
        chosen = some_of(np.ones(len(rays.ring), bool))
        origin_m, along = (each[chosen].astype(np.float64) for each in (rays.origin_m, rays.direction))
        with self.viewer.train_lock or nullcontext(), evaluated(model):
            cast = Caster(model, place).cast(origin_m, along, colours=True)
        points_m = origin_m + along * cast.distance_m[:, None]
        error_m = np.abs(cast.distance_m - rays.distance_m[chosen])
        assert cast.rgb is not None
        colours = (255 * cast.rgb.clip(0, 1)).round().astype(np.uint8)
        return Cloud(place.points(points_m).astype(np.float32), colours, points_m[:, 2], error_m)

    def _cloud(
        self,
        pixels: Int[np.ndarray, "n 3"],
        distance_m: Float[np.ndarray, "n"],
        rgb: UInt8[np.ndarray, "n 3"],
        sigma_m: Float[np.ndarray, "n"] | None,
    ) -> Cloud:
        """Convert pixels (picture, row, column) with distances to points in the scene."""
        metadata = self.manager.train_dataset.metadata
        rays = self.manager.train_ray_generator(torch.from_numpy(pixels).to(self.manager.device))
        along = torch.from_numpy(distance_m)[:, None] / metadata["metres_per_unit"]
        points = (rays.origins.cpu() + rays.directions.cpu() * along).float().numpy()
        transform = self.manager.train_dataset._dataparser_outputs.dataparser_transform
        up = (transform[:3, :3].double() @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).numpy()
        return Cloud(points, rgb, points @ up * metadata["metres_per_unit"], sigma_m)

    def _draw_cloud(self, layer: str) -> None:
        cloud = self._clouds[layer]
        self.viser_server.scene.add_point_cloud(
            f"{ROOT}/{layer}/points",
            cloud.points * VISER_NERFSTUDIO_SCALE_RATIO,
            cloud.colours(self.meaning.value),
            point_size=self._units(POINT_SIZE_M),
        )

    def _recolour(self) -> None:
        for layer in self._clouds:
            self._draw_cloud(layer)

    def _units(self, length_m: float) -> float:
        """Convert a length to the browser's units."""
        return length_m / self.manager.train_dataset.metadata["metres_per_unit"] * VISER_NERFSTUDIO_SCALE_RATIO
