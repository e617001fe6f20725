"""Options of `estimate-depth` and `fisheye-depth`; a module of its own so that the command line starts fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.jobs.cluster_address import check_address

Preset = Literal["lite", "full"]
HfOutput = Literal["auto", "metric", "relative", "inverse"]
MapsKind = Literal["metric", "relative", "inverse"]
Along = Literal["ray", "z"]
TrainedOn = Literal["scene", "elsewhere"]


@dataclass(frozen=True)
class EstimateDepthOptions:
    """Write monocular distance maps into scenes: from a network trained on their LiDAR, another network, or files.

    Held-out pictures are never used for training. If you stop a training, run the same command again to resume it; maps
    begin again.
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """Scene folders; one network is trained on all of them."""
    model: Path | None = None
    """Weights to start from. Without --train-steps they are used as given, and the scenes need no LiDAR."""
    train_steps: int | None = None
    """Steps of training. Not set: the preset's number, or none with --model."""
    seconds: float | None = None
    """Maximum seconds of training."""
    preset: Preset = "lite"
    """lite: minutes on a laptop's CPU; full: a larger network on larger pictures, for a GPU."""
    output: Path | None = None
    """Where the trained weights go. Not set: mono_network.safetensors in the first scene."""
    hf: str | None = None
    """Instead, a network of the transformers library: its folder, or its name in Hugging Face's cache. Needs `pip
    install '.[hf]'`."""
    hf_output: HfOutput = "auto"
    """What its maps are: metric (z in metres), relative or inverse (up to scale and shift); auto: as its config
    states."""
    maps: Path | None = None
    """Instead, maps of another tool for all pictures of one scene: a folder with CAMERA/FRAME.npy or .png (16 bit)."""
    maps_kind: MapsKind | None = None
    """What they are: metric (metres), or up to scale and shift relative (depth) or inverse (one over depth)."""
    maps_along: Along | None = None
    """Whether they are along the ray (distance) or along the optical axis (z)."""
    metres_per_count: float | None = None
    """Of PNGs with metric maps, such as 0.00390625 (1/256)."""
    maps_trained_on: TrainedOn | None = None
    """scene: their network was trained on LiDAR only, so above its field they count only with motion. Not set:
    elsewhere."""

    predict: bool = True
    """Write maps. Off: only train a network, for `--model` later."""
    cluster: str | None = None
    """Run on a Dask cluster: local, or a scheduler's address (docs/cluster.md)."""

    def check(self) -> None:
        """Check the ranges.

        Raises:
            InputError: an option is out of its range.
        """
        if not self.scenes:
            raise InputError("no scene is given; `estimate-depth` takes one or more scene folders.")
        if self.train_steps is not None and self.train_steps < 1:
            raise InputError(f"--train-steps {self.train_steps}: expected 1 or more.")
        if self.seconds is not None and not self.seconds > 0:
            raise InputError(f"--seconds {self.seconds:g}: expected more than 0.")
        if self.output is not None and self.output.suffix != ".safetensors":
            raise InputError(f"--output {self.output}: expected a file that ends in .safetensors.")
        check_address(self.cluster)
        self._check_sources()
        if not self.predict and (self.hf is not None or self.maps is not None or not self.trains):
            raise InputError("--no-predict: without training, there is nothing to do. Leave it out.")

    def _check_sources(self) -> None:
        """Check that one source of maps is chosen, and that all options belong to it."""
        own = {"--model": self.model, "--train-steps": self.train_steps, "--seconds": self.seconds}
        own |= {"--output": self.output, "--preset": None if self.preset == "lite" else self.preset}
        of_hf = {"--hf-output": None if self.hf_output == "auto" else self.hf_output}
        of_files = {"--maps-kind": self.maps_kind, "--maps-along": self.maps_along}
        of_files |= {"--metres-per-count": self.metres_per_count, "--maps-trained-on": self.maps_trained_on}
        if self.hf is not None and self.maps is not None:
            raise InputError("--hf and --maps: expected one source of maps. Leave one of them out.")
        source = "--maps" if self.maps is not None else "--hf" if self.hf is not None else "a network of our own"
        for owner, options in (("a network of our own", own), ("--hf", of_hf), ("--maps", of_files)):
            given = [name for name, value in options.items() if value is not None]
            if owner != source and given:
                raise InputError(
                    f"{', '.join(given)}: for {owner}, but the maps come from {source}. Leave out one of them."
                )
        if self.maps is None:
            return
        if len(self.scenes) > 1:
            raise InputError(
                f"--maps {self.maps}: contains the maps of one scene, but {len(self.scenes)} scenes are given."
            )
        if self.maps_kind is None or self.maps_along is None:
            raise InputError(
                f"--maps {self.maps}: describe its values with --maps-kind metric, relative or inverse, and "
                "--maps-along ray or z."
            )
        check_count(self.metres_per_count)

    @property
    def trains(self) -> bool:
        """Whether anything is trained."""
        return self.model is None or self.train_steps is not None or self.seconds is not None


@dataclass(frozen=True)
class FisheyeDepthOptions:
    """Get distance maps of fisheye pictures from any depth network, without LiDAR, poses or training.

    Without --hf and --maps it cuts pinhole views for a network of yours.
    """

    pictures: tyro.conf.Positional[Path]
    """The folder of one camera's pictures."""
    calibration: Path
    """Its lens: a file of Kalibr (.yaml), Basalt (.json) or OCamCalib (.txt), or keys as in rig.toml (docs/rig.md)."""
    output: Path
    """The folder to write to."""
    camera: str | None = None
    """Which of the file's cameras, where there are several."""
    mask: Path | None = None
    """A picture that is 0 where nothing is to be used, such as the vehicle."""
    theta_max_deg: float = 95.0
    """The largest angle from the optical axis that is used, degrees."""
    hf: str | None = None
    """A network of the transformers library, as for `estimate-depth`."""
    hf_output: HfOutput = "auto"
    """What its maps are; auto: as its config states."""
    maps: Path | None = None
    """A folder with a network's map of each view, under its name: .npy or .png (16 bit)."""
    maps_kind: MapsKind | None = None
    """What they are: metric (metres), or up to scale and shift relative (depth) or inverse (one over depth)."""
    maps_along: Along = "z"
    """Whether they are along the view's axis (z) or along the ray."""
    metres_per_count: float | None = None
    """Of PNGs with metric maps, such as 0.001."""

    def check(self) -> None:
        """Check the options before any file is read.

        Raises:
            InputError: an option is out of its range, or does not fit the others.
        """
        if not 0 < self.theta_max_deg <= 180:
            raise InputError(f"--theta-max-deg {self.theta_max_deg:g}: expected degrees above 0, up to 180.")
        if self.hf is not None and self.maps is not None:
            raise InputError("--hf and --maps: expected one source of maps. Leave one of them out.")
        if self.hf is None and self.hf_output != "auto":
            raise InputError(f"--hf-output {self.hf_output}: is for --hf, which is not given.")
        if (self.maps is None) != (self.maps_kind is None):
            raise InputError("--maps and --maps-kind: give both of them, or none.")
        if self.maps_along == "ray" and self.maps_kind in ("relative", "inverse"):
            raise InputError(
                f"--maps-along ray: with --maps-kind {self.maps_kind} nothing tells the maps' shift, as views of any "
                "shift agree. Make maps along z, or metric ones."
            )
        check_count(self.metres_per_count)


def check_count(metres_per_count: float | None) -> None:
    """Raise an InputError for a unit that no PNG has."""
    if metres_per_count is not None and not 0 < metres_per_count < 1000:
        raise InputError(f"--metres-per-count {metres_per_count:g}: expected more than 0, below 1000.")
