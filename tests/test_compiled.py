"""Whether what Numba compiles lies on disk already."""

import subprocess
import sys

from edge_depth_nerf.kernels import compiled


def test_it_is_known_whether_kernels_lie_compiled_on_disk(tmp_path, monkeypatch):
    folders = [tmp_path / name for name in ("a", "b")]
    for folder in folders:
        folder.mkdir()
    monkeypatch.setattr(compiled, "_folders", set(folders))
    assert not compiled.all_on_disk()
    (folders[0] / "kernel.nbi").touch()
    assert not compiled.all_on_disk()  # those of the other folder are still to be compiled
    (folders[1] / "kernel.nbi").touch()
    assert compiled.all_on_disk()
    monkeypatch.setattr(compiled, "_folders", set())  # no folder can be written: anew each time
    assert not compiled.all_on_disk()


CALL_AGAIN_AND_AGAIN = """
import os, sys
from pathlib import Path
from edge_depth_nerf.kernels.compiled import compiled  # once for all
head = "from edge_depth_nerf.kernels.compiled import compiled\\n\\n\\n@compiled()\\n"
Path("calling.py").write_text(f"from called import step\\n{head}def twice(x):\\n    return step(step(x))\\n")
for number, added in enumerate((1, 10, 10)):
    called, text = Path("called.py"), f"{head}def step(x):\\n    return x + {added}\\n"
    if not called.exists() or called.read_text() != text:
        called.write_text(text)
    child = os.fork()  # a process that has seen none of it
    if not child:
        from calling import twice
        print(twice(number), sum(twice.stats.cache_hits.values()), flush=True)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
"""


def test_a_change_of_a_function_reaches_those_that_call_it(tmp_path):
    """Numba alone would go on with the old one: it looks at a function's own module only."""
    call = [sys.executable, "-c", CALL_AGAIN_AND_AGAIN]
    done = subprocess.run(call, capture_output=True, text=True, check=True, timeout=120, cwd=tmp_path)
    # what did not change is not compiled again
    assert [[int(each) for each in line.split()] for line in done.stdout.splitlines()] == [[2, 0], [21, 0], [22, 1]]


def test_what_a_training_calls_is_looked_at_before_it_is_called(monkeypatch):
    """A process that has computed no prior has not imported it."""
    from edge_depth_nerf.plugin.fused.build import compiled_before

    for name in [name for name in sys.modules if name.startswith("edge_depth_nerf.") and name.endswith("_numba")]:
        package, _, module = name.rpartition(".")
        monkeypatch.delitem(sys.modules, name)
        monkeypatch.delattr(sys.modules[package], module)
    monkeypatch.setattr(compiled, "_folders", set())
    compiled_before()
    assert len(compiled._folders) == 2  # kernels and method
