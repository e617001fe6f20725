"""What a training step and a view ask of a GPU, counted without one: kernels, bytes, copies, synchronisations.

    python -m benchmarks.speed.gpu_counts [CASE ...] [--scene data/sample_drive] [--json FILE]

A trainer is set up on the CPU as `ns-train` does it, then its tensors are replaced by fake ones of device cuda
(torch's FakeTensorMode: shape, type and device, but no numbers), and it takes a whole step: batch, forward, mixed
precision, losses, backward, scaler, optimisers, schedulers. A wrong device or type raises, as on a GPU. Each operation
that a GPU would be given is counted as one kernel, with the bytes that it reads and writes; Triton's kernels are
counted when they are launched, and are not run. A number that Python asks for (`item`) is a synchronisation, and so is
a copy between host and device, unless it is the non-blocking one of pinned memory: that is an upload.

torch's autograd takes no tensors of a device that does not exist. A library of two functions, compiled here and loaded
before torch, tells it during backward that there is one. It needs a C compiler, Linux, and a torch that was built for
CUDA.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import copy
import ctypes
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

DEVICE = "cuda:0"
STEP = 20_001
"""The step that is counted: proposal networks rest in most, and nothing is logged or checked."""
SHIM = "EDGE_DEPTH_NERF_FAKE_DEVICES"
"""Names the library, in the environment of the process that counts."""
SHIM_SOURCE = """
static signed char devices = 0;
void pretend_devices(int count) { devices = (signed char)count; }
/* c10::cuda::device_count() */
signed char _ZN3c104cuda12device_countEv(void) { return devices; }
/* of the driver: no context is active on any device */
int cuDevicePrimaryCtxGetState(int device, unsigned *flags, int *active) { *flags = 0; *active = 0; return 0; }
"""
DRIVER_FUNCTION = "int {name}(void) {{ return 100; }}"
"""For each other one that torch names: there is no device."""
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "full": ("edge_depth_nerf", {}),
    "full, proposals rest": ("edge_depth_nerf", {"updated": False}),
    "full, poses": ("edge_depth_nerf", {"poses": True}),
    "lite": ("edge_depth_nerf_lite", {}),
    "paper": ("edge_depth_nerf_paper", {}),
    "full, torch": ("edge_depth_nerf", {"implementation": "torch"}),
    "full, a view": ("edge_depth_nerf", {"view": True}),
}
"""The method in `plugin.config` and what differs from it."""
NO_KERNEL = {
    *("device", "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided"),
    *("resize_", "set_", "detach_", "lift_fresh"),
}
"""Operations without a kernel, beside those that torch knows for views."""
OURS = ("/edge_depth_nerf/", "/nerfstudio/", "/torch/amp/", "/torch/optim/")
"""The lines that are named for a copy or a synchronisation are of these folders."""


def why_not() -> str | None:
    """Why nothing can be counted on this machine; None where it can."""
    if sys.platform != "linux":
        return "fake CUDA tensors need Linux"
    if shutil.which("cc") is None:
        return "fake CUDA tensors need a C compiler (cc)"
    if torch.version.cuda is None:
        return "fake CUDA tensors need a torch that was built for CUDA"
    return None


@dataclass
class Part:
    """What a part of a step asks for."""

    kernels: int = 0
    bytes: int = 0
    """Read and written by torch's operations; Triton's are not known."""


@dataclass
class Counts:
    """What was counted in a case."""

    parts: dict[str, Part] = field(default_factory=lambda: collections.defaultdict(Part))
    names: collections.Counter[str] = field(default_factory=collections.Counter)
    """Operations by name; Triton's kernels as triton:NAME."""
    uploads: list[int] = field(default_factory=list)
    """Bytes of each non-blocking copy of pinned memory."""
    synchronisations: collections.Counter[str] = field(default_factory=collections.Counter)
    """What makes the host wait, or the device, and the line that asks for it."""
    without_gradient: list[str] = field(default_factory=list)
    """Parameters that backward left without one."""
    numba: list[str] = field(default_factory=list)
    """Modules of the CPU's kernels that were imported."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON, with the sums."""
        parts = {name: asdict(part) for name, part in self.parts.items()}
        return {
            "kernels": sum(part.kernels for part in self.parts.values()),
            "gigabytes": round(sum(part.bytes for part in self.parts.values()) / 1e9, 3),
            "triton_kernels": sum(count for name, count in self.names.items() if name.startswith("triton:")),
            "uploads": self.uploads,
            "synchronisations": dict(self.synchronisations),
            "parts": parts,
            "names": dict(self.names.most_common()),
            "without_gradient": self.without_gradient,
            "numba": self.numba,
        }


class Counter(TorchDispatchMode):
    """Counts the operations on fake tensors of device cuda."""

    def __init__(self) -> None:
        super().__init__()
        self.counts = Counts()
        self.part = "other"
        self._pinned: torch.Tensor | None = None

    def pin(self, tensor: torch.Tensor) -> torch.Tensor:
        """What `Tensor.pin_memory` does here: remember the tensor."""
        self._pinned = tensor
        return tensor

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func._schema.name.partition("::")[2]
        given = [each for each in tree_leaves((args, kwargs)) if isinstance(each, torch.Tensor)]
        on_device = any(each.device.type == "cuda" for each in given)
        if on_device and name == "_local_scalar_dense":
            self._waits(name)
            return True if given[0].dtype == torch.bool else 1.0 if given[0].dtype.is_floating_point else 1
        # torch has no fake form of it, and it returns nothing
        result = None if name == "_fused_adam_" else func(*args, **(kwargs or {}))
        made = [each for each in tree_leaves(result) if isinstance(each, torch.Tensor)]
        kinds = {each.device.type for each in (*given, *made)}
        size = sum(each.numel() * each.element_size() for each in made)
        if kinds == {"cpu", "cuda"} and name in ("_to_copy", "copy_"):
            if (kwargs or {}).get("non_blocking") and given[-1] is self._pinned:
                self.counts.uploads.append(size)
            else:
                self._waits(f"{name} of {size} bytes")
        elif "cuda" in kinds and name not in NO_KERNEL and not func.is_view:
            self._kernel(name, sum(e.numel() * e.element_size() for e in given if e.device.type == "cuda") + size)
        return result

    def launch(self, kernel: Any, *args: Any, **options: Any) -> None:
        """What the launch of a Triton kernel does here."""
        tensors = [each for each in (*args, *options.values()) if isinstance(each, torch.Tensor)]
        assert tensors, f"{kernel.__name__} is given no tensor"
        for each in tensors:
            assert each.device.type == "cuda", f"{kernel.__name__} is given a tensor of the {each.device}"
        self._kernel(f"triton:{kernel.__name__}", 0)

    def _kernel(self, name: str, size: int) -> None:
        self.counts.names[name] += 1
        part = self.counts.parts[self.part]
        part.kernels += 1
        part.bytes += size

    def _waits(self, what: str) -> None:
        frames = [each for each in traceback.extract_stack() if any(name in each.filename for name in OURS)]
        last = frames[-1] if frames else None
        where = f"{'/'.join(Path(last.filename).parts[-3:])}:{last.lineno} {last.line}" if last else "elsewhere"
        self.counts.synchronisations[f"{what} at {where}"] += 1

    @contextlib.contextmanager
    def during(self, part: str) -> Iterator[None]:
        """Count what comes, or what the decorated function does, as of a part."""
        before, self.part = self.part, part
        try:
            yield
        finally:
            self.part = before


@contextlib.contextmanager
def replaced(*changes: tuple[Any, str, Any]) -> Iterator[None]:
    """Other attributes of objects, for a while."""
    with contextlib.ExitStack() as stack:
        for change in changes:
            stack.enter_context(mock.patch.object(*change))
        yield


class NoCapture:
    """Takes steps as those that are recorded, and records none."""

    def stream(self) -> contextlib.AbstractContextManager[None]:
        """The present one."""
        return contextlib.nullcontext()


class FakeGpu:
    """Fake tensors of a GPU, and what stands in for what only a driver could do."""

    def __init__(self) -> None:
        self.mode = FakeTensorMode(allow_non_fake_inputs=True)
        self.counter = Counter()
        self._shim = ctypes.CDLL(os.environ[SHIM])

    def tensor(self, tensor: torch.Tensor) -> torch.Tensor:
        """A fake of a tensor, on the GPU."""
        with self.mode:
            return self.mode.from_tensor(tensor.detach().contiguous()).to(DEVICE)

    def move(self, module: torch.nn.Module) -> None:
        """Replace parameters and buffers by fakes."""
        for part in module.modules():
            for name, parameter in part._parameters.items():
                if parameter is not None:
                    moved = torch.nn.Parameter(self.tensor(parameter), requires_grad=parameter.requires_grad)
                    vars(moved).update(vars(parameter))
                    part._parameters[name] = moved
            for name, buffer in part._buffers.items():
                if buffer is not None:
                    part._buffers[name] = self.tensor(buffer)

    def backward(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """What torch's functions for gradients do here."""
        with self.counter.during("backward"), torch.autograd.set_multithreading_enabled(False):
            self._shim.pretend_devices(64)
            try:
                return function(*args, **kwargs)
            finally:
                self._shim.pretend_devices(0)

    @contextlib.contextmanager
    def counting(self) -> Iterator[None]:
        """Count what is done, anew."""
        import torch.cuda.amp.common
        from triton.runtime.jit import JITFunction

        counter = self.counter
        counter.counts = Counts()
        with (
            replaced(
                (torch.cuda.amp.common, "amp_definitely_not_available", lambda: False),
                (torch.cuda, "device_of", lambda _: contextlib.nullcontext()),
                (torch.autograd, "grad", partial(self.backward, torch.autograd.grad)),
                (torch.Tensor, "backward", lambda tensor, *a, **k: self.backward(torch.autograd.backward, tensor)),
                (torch.Tensor, "pin_memory", lambda tensor: counter.pin(tensor)),
                (JITFunction, "run", lambda kernel, *a, grid, warmup, **k: counter.launch(kernel, *a, **k)),
            ),
            self.mode,
            counter,
        ):
            yield


def fake_trainer(gpu: FakeGpu, method: str, scene: Path, folder: Path, **changes: Any) -> Any:
    """A trainer of a method whose tensors are fakes on a GPU, at its step `STEP`."""
    import torch.cuda.amp.common

    from edge_depth_nerf.plugin import config as methods
    from edge_depth_nerf.plugin.step_graphs import StepGraphs, why_not
    from edge_depth_nerf.plugin.upload import TableOnDevice

    config: Any = copy.deepcopy(getattr(methods, method).config)
    config.machine.device_type, config.vis = "cuda", "tensorboard"
    config.output_dir, config.experiment_name, config.timestamp = folder / "outputs", "counted", "run"
    config.logging.local_writer.enable = False
    config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = scene
    config.pipeline.datamanager.cache_dir = folder / "cache"
    config.pipeline.model.implementation = changes.get("implementation", "fused")
    config.pipeline.model.eval_num_rays_per_chunk = methods.RAYS_AT_ONCE["cuda"]
    if changes.get("poses"):
        config.pipeline.model.camera_optimizer.mode = "SO3xR3"
    torch.manual_seed(0)
    with replaced((torch.cuda.amp.common, "amp_definitely_not_available", lambda: False)):
        trainer = config.setup(local_rank=0, world_size=1)
    trainer.device = "cpu"  # where it is built
    trainer.setup(test_mode="val")
    trainer.device = DEVICE
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    for module in (model, manager.train_ray_generator, manager.eval_ray_generator):
        gpu.move(module)
    manager.device = DEVICE
    trainer.pipeline._odd_steps = gpu.tensor(trainer.pipeline._odd_steps)
    manager._batches = TableOnDevice(manager.train_pixel_sampler.table, "cpu")
    manager._batches._records = gpu.tensor(manager._batches._records)
    trainer.optimizers = trainer.setup_optimizers()
    if why_not(trainer) is None:
        capture: Any = NoCapture()
        with gpu.mode:
            trainer.graphs = StepGraphs(trainer, capture)
    sampler = model.proposal_sampler
    sampler._step, sampler._steps_since_update = STEP, 100 if changes.get("updated", True) else 0
    return trainer


def counted_step(gpu: FakeGpu, trainer: Any) -> Counts:
    """Count a training step; one is taken before it, which makes what stays."""
    from nerfstudio.engine.callbacks import TrainingCallbackLocation as At

    model, manager, counter = trainer.pipeline.model, trainer.pipeline.datamanager, gpu.counter
    for name in ("next_train", "batch_of", "packed"):
        setattr(manager, name, counter.during("data")(getattr(manager, name)))
    if trainer.graphs is not None:
        trainer.graphs._work = counter.during("scaler and optimisers")(trainer.graphs._work)
    model.forward = counter.during("forward")(model.forward)
    for name in ("get_metrics_dict", "get_loss_dict"):
        setattr(model, name, counter.during("metrics and losses")(getattr(model, name)))
    sampler = model.proposal_sampler
    rest = sampler._steps_since_update
    for step in (STEP, STEP + 1):
        sampler._steps_since_update = rest
        with gpu.counting(), counter.during("scaler and optimisers" if trainer.graphs is None else "beside the graph"):
            for callback in trainer.callbacks:
                callback.run_callback_at_location(step, location=At.BEFORE_TRAIN_ITERATION)
            trainer.train_iteration(step)
    counts, named = counter.counts, model.named_parameters()
    counts.without_gradient = [name for name, each in named if each.requires_grad and each.grad is None]
    for name, each in model.named_parameters():
        assert each.grad is None or (each.grad.device, each.grad.dtype) == (each.device, each.dtype), name
    return counts


def counted_view(gpu: FakeGpu, trainer: Any) -> Counts:
    """Count a view as the viewer and the judges ask for it, of as many rays as are rendered at once."""
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.cameras.rays import RayBundle

    from edge_depth_nerf.plugin import model as model_module

    model = trainer.pipeline.model
    side = int(model.config.eval_num_rays_per_chunk**0.5)

    def rays_of(*_: Any, **__: Any) -> RayBundle:
        """nerfstudio's own look at the numbers of their cameras."""
        ones = torch.ones(side, side, 1, device=DEVICE)
        directions = ones.expand(side, side, 3)
        return RayBundle(directions, directions, pixel_area=ones, camera_indices=ones.long())

    trainer.pipeline.eval()
    camera = trainer.pipeline.datamanager.eval_dataset.cameras[0:1]
    with replaced((Cameras, "generate_rays", rays_of), (model_module, "without_undefined_ray", lambda camera: camera)):
        for _ in range(2):
            with gpu.counting(), torch.no_grad(), gpu.counter.during("a view"):
                model.get_outputs_for_camera(camera)
    return gpu.counter.counts


def forget_numba() -> None:
    """Forget the modules of the CPU's kernels, which the set-up on the CPU has imported."""
    for name in [each for each in sys.modules if each.endswith("_numba")]:
        parent, _, child = name.rpartition(".")
        del sys.modules[name]
        vars(sys.modules[parent]).pop(child, None)


def counted(case: str, scene: Path, folder: Path) -> dict[str, Any]:
    """Count a case, in a process that was started by `in_a_process`."""
    from edge_depth_nerf.kernels import back_ends

    method, changes = CASES[case]
    if changes.get("view"):
        back_ends._tried.clear()  # as in a new process: it may be the first that needs the kernels
    gpu = FakeGpu()
    trainer = fake_trainer(gpu, method, scene, folder, **changes)
    forget_numba()
    found = counted_view(gpu, trainer) if changes.get("view") else counted_step(gpu, trainer)
    found.numba = sorted(name for name in sys.modules if name.endswith("_numba"))
    return found.to_dict()


def in_a_process(cases: list[str], scene: Path, folder: Path, timeout_s: float = 600) -> dict[str, Any]:
    """Count cases in a process of its own, with the library in front of torch.

    Raises:
        RuntimeError: the process failed; it says how.
    """
    folder.mkdir(parents=True, exist_ok=True)
    source, library, found = folder / "devices.c", folder / "devices.so", folder / "counts.json"
    torchs = (Path(torch.__file__).parent / "lib" / "libcaffe2_nvrtc.so").read_bytes()
    names = set(re.findall(r"\0(cu[A-Z]\w+)(?=\0)", torchs.decode("latin-1"))) - {"cuDevicePrimaryCtxGetState"}
    source.write_text(SHIM_SOURCE + "\n".join(DRIVER_FUNCTION.format(name=name) for name in sorted(names)) + "\n")
    # under the driver's name, so that torch finds it loaded
    compiler = ["cc", "-shared", "-fPIC", "-Wl,-soname,libcuda.so.1", "-o", str(library), str(source)]
    subprocess.run(compiler, check=True, timeout=60)
    command = [sys.executable, __file__, *cases, "--scene", str(scene), "--folder", str(folder), "--json", str(found)]
    preloaded = ":".join(filter(None, (str(library), os.environ.get("LD_PRELOAD"))))
    environment = {**os.environ, "LD_PRELOAD": preloaded, SHIM: str(library), "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=timeout_s)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: status {done.returncode}\n{done.stderr[-4000:]}")
    return json.loads(found.read_text())


def main() -> None:
    """Count and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(CASES), metavar="CASE", help=f"of {', '.join(CASES)}")
    parser.add_argument("--scene", type=Path, default=Path("data/sample_drive"))
    parser.add_argument("--folder", type=Path, help="for what is written on the way")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if reason := why_not():
        parser.exit(2, f"{reason}\n")
    folder = options.folder or Path(tempfile.mkdtemp())
    if SHIM in os.environ:
        from nerfstudio.utils.rich_utils import CONSOLE

        CONSOLE.quiet = True
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="The fused .* does not work")
        results = {case: counted(case, options.scene, folder) for case in options.cases}
    else:
        results = in_a_process(options.cases, options.scene, folder)
        print("| | kernels | of Triton | GB of torch | uploads | synchronisations |\n|---|---:|---:|---:|---:|---:|")
        for case, found in results.items():
            waits = sum(found["synchronisations"].values())
            print(
                f"| {case} | {found['kernels']:,} | {found['triton_kernels']} | {found['gigabytes']:.1f} "
                f"| {len(found['uploads'])} | {waits} |"
            )
        for case, found in results.items():
            print(f"\n{case}:")
            for part, counts in found["parts"].items():
                print(f"  {part}: {counts['kernels']} kernels, {counts['bytes'] / 1e9:.2f} GB")
            for what, times in found["synchronisations"].items():
                print(f"  {times} × {what}")
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
