"""A small convolutional network that gives one fisheye picture's distances, and its weights as a file.

Beside the colours it sees where each pixel looks: the ray in the camera's frame, the ray's height against gravity,
and the distance of a plain room, which has a flat floor at the camera's height and a round upright wall. What it
predicts is the logarithm of distance over the room's: it begins as the room, and where nothing is known it stays near.

Pure. Distances are metres along the ray; pictures N×3×H×W in 0 to 1; rays in the camera's frame (x right, y down, z
forward).
"""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from pydantic import Field, TypeAdapter, ValidationError
from torch import Tensor, nn

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_bytes

ARCHITECTURE = "edge-depth-nerf/u-net-1"
"""Raised whenever the same weights would give another prediction."""
_FAMILY = "edge-depth-nerf/"
"""What all architectures of ours begin with."""
NEAREST_M, FARTHEST_M = 0.1, 1000.0
"""Predictions never leave these."""
_GROUPS = 8
_STEEPEST_COSINE = 0.1
"""The room's wall is no farther than ten radii, straight up too."""
_GEOMETRY_CHANNELS = 5
_INPUT_CHANNELS = 3 + _GEOMETRY_CHANNELS + 1


@dataclass(frozen=True)
class NetworkSettings:
    """What fixes a network's form and its units; kept in the weights' file."""

    channels: Annotated[
        tuple[Annotated[int, Field(gt=0, le=1024, multiple_of=_GROUPS)], ...], Field(min_length=2, max_length=8)
    ]
    """Features at a half, a quarter, an eighth … of the working size; multiples of 8."""
    working_px: Annotated[int, Field(ge=16, le=4096)]
    """Longer side of the pictures it is shown; larger ones are averaged down to it."""
    camera_height_m: Annotated[float, Field(gt=0, lt=1e4)]
    """Height of the cameras above the ground, in the training drives; for drives without LiDAR."""
    room_radius_m: Annotated[float, Field(gt=0, lt=1e4)]
    """Horizontal distance that the room's wall has."""

    @property
    def multiple_px(self) -> int:
        """What both sides of its input must be multiples of."""
        return 2 ** len(self.channels)


class DepthNetwork(nn.Module):
    """A U-Net: each level halves the size; the last step gives four pixels for each one at half size."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        channels = settings.channels
        self.stem = nn.Conv2d(_INPUT_CHANNELS, channels[0], 3, stride=2, padding=1)
        pairs = list(itertools.pairwise(channels))
        self.down = nn.ModuleList(nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in pairs)
        self.encoder = nn.ModuleList(_Residual(count) for count in channels)
        self.lateral = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairs)
        self.decoder = nn.ModuleList(_Residual(fine) for fine in channels[:-1])
        self.head = nn.Conv2d(channels[0], 4, 3, padding=1)
        nn.init.zeros_(self.head.weight)
        assert self.head.bias is not None
        nn.init.zeros_(self.head.bias)

    def forward(
        self, picture: Float[Tensor, "n 3 h w"], geometry: Float[Tensor, "n 5 h w"], usable: Bool[Tensor, "n h w"]
    ) -> Float[Tensor, "n h w"]:
        """Predict log(distance / the room's distance) from RGB (0 to 1) and what `ray_geometry` gives.

        Where the picture is not usable, it is blacked out.
        """
        seen = usable[:, None].to(picture.dtype)
        features = torch.cat(((picture - 0.5) * 4.0 * seen, geometry, seen), 1)
        features = self.encoder[0](self.stem(features).relu_())
        skipped = [features]
        for down, encode in zip(self.down, list(self.encoder)[1:], strict=True):
            features = encode(down(features).relu_())
            skipped.append(features)
        for level in reversed(range(len(self.decoder))):
            finer = skipped[level]
            above = F.interpolate(_pointwise(self.lateral[level], features), size=finer.shape[-2:], mode="nearest")
            features = self.decoder[level](finer + above)
        return F.pixel_shuffle(self.head(features), 2)[:, 0]


def _pointwise(convolution: nn.Module, features: Tensor) -> Tensor:
    """Apply a convolution of 1×1 pixels as a matrix product.

    On one thread torch would copy the features into another order for it.
    """
    weight, bias = convolution.get_parameter("weight"), convolution.get_parameter("bias")
    return F.linear(features.permute(0, 2, 3, 1), weight[:, :, 0, 0], bias).permute(0, 3, 1, 2)


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        self.first_norm = nn.GroupNorm(_GROUPS, channels)
        self.second_norm = nn.GroupNorm(_GROUPS, channels)

    def forward(self, features: Tensor) -> Tensor:
        inner = self.second(self.first_norm(self.first(features)).relu_())
        return self.second_norm(inner).add_(features).relu_()


def log_room_distance(
    height_sine: Float[Tensor, "*batch"], camera_height_m: Float[Tensor, "*#batch"] | float, room_radius_m: float
) -> Float[Tensor, "*batch"]:
    """Natural logarithm of the distance, in metres, to the floor or the wall of the plain room.

    `height_sine` is the sine of a ray's elevation above the horizon.
    """
    cosine = (1.0 - height_sine.square()).clamp(min=_STEEPEST_COSINE**2).sqrt()
    wall_m = room_radius_m / cosine
    # where a ray does not fall, the floor is out of reach
    floor_m = camera_height_m / (-height_sine).clamp(min=1e-6)
    return torch.minimum(wall_m, floor_m).log()


def ray_geometry(
    rays: Float[Tensor, "n h w 3"],
    up_in_camera: Float[Tensor, "n 3"],
    camera_height_m: Float[Tensor, "n"],
    settings: NetworkSettings,
) -> tuple[Float[Tensor, "n 5 h w"], Float[Tensor, "n h w"]]:
    """Make what the network sees beside the picture, and the room's log distance.

    The ray, the sine of its elevation, and the room's log distance, centred. Rays are unit vectors, zeros where a pixel
    has none; `up_in_camera` is the unit vector against gravity.
    """
    height_sine = torch.einsum("nhwc,nc->nhw", rays, up_in_camera).clamp(-1.0, 1.0)
    room = log_room_distance(height_sine, camera_height_m[:, None, None], settings.room_radius_m)
    centred = (room - math.log(settings.room_radius_m))[..., None]
    return torch.cat((rays, height_sine[..., None], centred), -1).permute(0, 3, 1, 2).contiguous(), room


def distance_m(prediction: Float[Tensor, "*batch"], log_room: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Turn what the network gives into metres along the ray."""
    return (prediction + log_room).clamp(math.log(NEAREST_M), math.log(FARTHEST_M)).exp()


# ---- weights on disk -------------------------------------------------------------------------------------------


def save_network(path: Path, network: DepthNetwork, about: dict[str, Any]) -> None:
    """Write weights and settings as safetensors, atomically; `about` is JSON that says how the network was made."""
    write_tensors(path, network.state_dict(), {"settings": asdict(network.settings), "about": about})


def load_network(path: Path) -> tuple[DepthNetwork, dict[str, Any]]:
    """Read what `save_network` wrote: the network, on the CPU, and what was said about it.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is broken, or holds another architecture.
    """
    tensors, header = read_tensors(path)
    try:
        settings = TypeAdapter(NetworkSettings).validate_json(json.dumps(header.get("settings")), strict=True)
    except (ValidationError, RecursionError):
        raise InputError(
            f"{path}: its settings describe no network: {header.get('settings')}. Expected channels (multiples of "
            f"{_GROUPS}), working_px, camera_height_m and room_radius_m. Train it again, without --model."
        ) from None
    # without memory: settings may describe a network far larger than the file
    with torch.device("meta"):
        expected = {name: tuple(tensor.shape) for name, tensor in DepthNetwork(settings).state_dict().items()}
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if differing := sorted(name for name in {*expected, *found} if expected.get(name) != found.get(name)):
        name = differing[0]
        raise InputError(
            f"{path}: its tensors are not those of the network that its settings describe: {name} is "
            f"{found.get(name, 'missing')}, expected {expected.get(name, 'no such tensor')} ({len(differing)} differ). "
            "Train it again, without --model."
        )
    if not all(torch.isfinite(tensor).all() for tensor in tensors.values()):
        raise InputError(f"{path}: holds weights that are not finite. Train it again, without --model.")
    network = DepthNetwork(settings)
    network.load_state_dict(tensors)
    about = header.get("about")
    return network.eval(), dict(about) if isinstance(about, dict) else {}


def is_ours(path: Path) -> bool:
    """Whether this project wrote a file of tensors, of this or of another architecture."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            return (file.metadata() or {}).get("architecture", "").startswith(_FAMILY)
    except (SafetensorError, OSError):
        return False


def write_tensors(path: Path, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    """Write tensors with a JSON header and this architecture's name, atomically; the same ones as the same bytes."""
    from safetensors.torch import save

    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    metadata = {"architecture": ARCHITECTURE, "header": json.dumps(header, allow_nan=False)}
    stored = save(plain, metadata)
    # the library puts the header's keys into an order of chance: its length (8 bytes), JSON, then the tensors
    end = 8 + int.from_bytes(stored[:8], "little")
    ordered = json.dumps(json.loads(stored[8:end]), sort_keys=True, separators=(",", ":")).encode()
    ordered += b" " * (-len(ordered) % 8)
    write_bytes(path, len(ordered).to_bytes(8, "little") + ordered + stored[end:])


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `write_tensors` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is not such a file, or of another architecture.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file. --model takes weights that `estimate-depth` has written.")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("architecture") == ARCHITECTURE:
                header = json.loads(metadata["header"])
                if not isinstance(header, dict):
                    raise KeyError("its header is no JSON object")
                return {name: file.get_tensor(name) for name in file.keys()}, header
            names = list(file.keys())
    except (SafetensorError, KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{path}: cannot be read as weights ({error}). --model takes a .safetensors file that `estimate-depth` has "
            "written; copy or train it again."
        ) from error
    declared = metadata.get("architecture")
    raise InputError(
        f"{path}: holds weights of another architecture: {declared or 'none is declared'}, tensors such as "
        f"{', '.join(names[:3]) or 'none'}; expected {ARCHITECTURE}. Give weights that `estimate-depth` has written, "
        "or train without --model."
    )
