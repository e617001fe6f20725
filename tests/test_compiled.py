"""Whether what Numba compiles lies on disk already."""

from __future__ import annotations

import subprocess
import sys

from edge_depth_nerf.kernels import compiled


def test_it_is_known_whether_kernels_lie_compiled_on_disk(tmp_path, monkeypatch):
    folders = [tmp_path / name for name in ("a", "b")]
    for folder in folders:
        folder.mkdir()
    monkeypatch.setattr(compiled, "_folders", set(folders))
    assert not compiled.compiled_before(())
    (folders[0] / "kernel.nbi").touch()
    assert not compiled.compiled_before(())  # those of the other folder are still to be compiled
    (folders[1] / "kernel.nbi").touch()
    assert compiled.compiled_before(())
    monkeypatch.setattr(compiled, "_folders", set())  # no folder can be written: anew each time
    assert not compiled.compiled_before(())


def test_what_a_training_calls_is_looked_at_before_it_is_called():
    """A process that has computed no prior has not imported it."""
    code = (
        "import sys; from edge_depth_nerf.kernels import compiled; compiled.compiled_before()\n"
        "print(*[module in sys.modules for module in compiled.TRAINING], bool(compiled._folders))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.split() == ["True"] * (len(compiled.TRAINING) + 1)
