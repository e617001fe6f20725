"""Ready-made networks for depth from one picture, as the transformers library knows them.

They are taken from a folder or from Hugging Face's cache on this machine; nothing is downloaded. Depth Anything, DPT,
ZoeDepth, GLPN and others whose config belongs to AutoModelForDepthEstimation. They know pinholes only, so they are
shown pinhole views.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.mono.options import HfOutput
from edge_depth_nerf.mono.pinhole_views import PinholeView
from edge_depth_nerf.mono.relative import Kind, Layer

Predict = Callable[[Sequence[NDArray[np.uint8]]], Sequence[NDArray[np.float32]]]
"""Pictures (H×W×3, RGB) to maps (H×W) of z, of z up to scale and shift, or of its inverse."""

_METRIC_TYPES = ("chmv2", "depth_pro", "glpn", "tipsv2_dpt", "zoedepth")
_INVERSE_TYPES = ("dpt",)


class ReadyNetwork:
    """A network of the transformers library, with what prepares its pictures."""

    def __init__(self, name: str, model: Any, processor: Any, kind: Kind):
        self.name = name
        self.kind: Kind = kind
        self.model_type = str(model.config.model_type)
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._model = model.to(self._device).eval()
        self._processor = processor
        self._takes_source_sizes = (
            "source_sizes" in inspect.signature(processor.post_process_depth_estimation).parameters
        )

    @torch.inference_mode()
    def __call__(self, pictures: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.float32]]:
        """Predict pictures of one size; each map has its picture's size."""
        maps = []
        # one by one: large networks fill the memory, and ZoeDepth takes the same one of its heads for all of a batch
        for picture in pictures:
            inputs = self._processor(images=[picture], input_data_format="channels_last", return_tensors="pt")
            outputs = self._model(**inputs.to(self._device))
            size = picture.shape[:2]
            more = {"source_sizes": [size]} if self._takes_source_sizes else {}
            (found,) = self._processor.post_process_depth_estimation(outputs, target_sizes=[size], **more)
            # a side of one pixel is squeezed away
            maps.append(found["predicted_depth"].float().cpu().numpy().reshape(size))
        return maps


def weight_files(folder: Path) -> list[Path]:
    """The files of a network in a folder; none of one in Hugging Face's cache, which is named otherwise."""
    return sorted(path for kind in ("*.json", "*.safetensors", "*.bin") for path in folder.glob(kind))


def load_ready_network(name: str, output: HfOutput = "auto") -> ReadyNetwork:
    """Load a network from a folder that save_pretrained or a download made, or by name from Hugging Face's cache.

    Raises:
        InputError: it is not there, is no depth network, or misses some of its weights.
    """
    try:
        import transformers
    except ImportError as error:
        raise InputError(
            f"--hf {name}: the transformers library is missing ({error}). Install it with `pip install '.[hf]'`."
        ) from None
    folder = Path(name)
    if folder.exists() and not (folder / "config.json").is_file():
        raise InputError(
            f"{name}: has no config.json. --hf takes the folder of a network as the transformers library saves it "
            "(config.json, preprocessor_config.json, model.safetensors); for a network of this project, use --model."
        )
    local: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False}
    config = _load(name, lambda: transformers.AutoConfig.from_pretrained(name, **local))
    if type(config) not in transformers.MODEL_FOR_DEPTH_ESTIMATION_MAPPING:
        known = sorted({known.model_type for known in transformers.MODEL_FOR_DEPTH_ESTIMATION_MAPPING})
        raise InputError(
            f"{name}: {config.model_type} is not a depth network. Expected one of {', '.join(known)}, such as "
            "depth-anything/Depth-Anything-V2-Small-hf."
        )
    kind = _kind(name, config, output)
    load = transformers.AutoModelForDepthEstimation.from_pretrained
    model, loaded = _load(name, lambda: load(name, dtype=torch.float32, output_loading_info=True, **local))
    if missing := sorted(loaded["missing_keys"]):
        raise InputError(
            f"{name}: misses {len(missing)} of its network's weights, such as {missing[0]}: a trunk without its depth "
            "head, or weights of another architecture. Take a network that was trained for depth."
        )
    processor = _load(name, lambda: transformers.AutoImageProcessor.from_pretrained(name, **local))
    return ReadyNetwork(name, model, processor, kind)


def _load(name: str, load: Callable[[], Any]) -> Any:
    from transformers.utils import logging

    had_bar, verbosity = logging.is_progress_bar_enabled(), logging.get_verbosity()
    logging.disable_progress_bar()
    # what is missing is told in our words
    logging.set_verbosity_error()
    try:
        return load()
    except Exception as error:  # the library raises whatever its readers meet
        first_line = str(error).strip().split("\n")[0]
        if Path(name).is_dir():
            raise InputError(
                f"{name}: cannot be loaded as a depth network ({type(error).__name__}: {first_line}). Copy or download "
                "the folder again."
            ) from error
        raise InputError(
            f"--hf {name}: neither a folder here nor a whole network in Hugging Face's cache. Nothing is downloaded "
            f"here: run `hf download {name}` first, on this machine, or on another and give the folder."
        ) from error
    finally:
        logging.set_verbosity(verbosity)
        if had_bar:
            logging.enable_progress_bar()


def _kind(name: str, config: Any, output: HfOutput) -> Kind:
    """What the network's maps are."""
    if output != "auto":
        return output
    declared = getattr(config, "depth_estimation_type", None)
    if declared == "metric" or config.model_type in _METRIC_TYPES:
        return "metric"
    if declared == "relative" or config.model_type in _INVERSE_TYPES:
        return "inverse"
    raise InputError(
        f"{name}: its config ({config.model_type}) does not state the unit of its maps. Give --hf-output metric "
        "(metres), relative (depth up to scale and shift) or inverse (disparity up to scale and shift)."
    )


def view_layers(predict: Predict, views: Sequence[PinholeView], rgb: NDArray[np.uint8]) -> list[Layer]:
    """Predict the pinhole views of a picture."""
    maps = predict([view.cut(rgb) for view in views])
    return [view.layer(found) for view, found in zip(views, maps, strict=True)]
