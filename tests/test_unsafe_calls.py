"""No module of the package calls what could run the data that it reads."""

import re
from pathlib import Path

import pytest
from unsafe_calls import unsafe

import edge_depth_nerf

PACKAGE = Path(edge_depth_nerf.__file__).parent
IMPORTS_BY_NAME = {"compiled.py", "converters.py"}
"""Import modules of their own lists."""


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_nothing_in_the_package_runs_what_it_reads(path: Path) -> None:
    """Much of it is held by ruff's rules (S in pyproject.toml) as well; here without exceptions."""
    assert unsafe(path.read_text(encoding="utf-8"), may_import=path.name in IMPORTS_BY_NAME) == []


def test_the_linter_holds_it() -> None:
    rules = (PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8")
    assert re.search(r'^select = \[.*"S"', rules, re.MULTILINE)


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "import dill as d",
        "from pickle import loads",
        "from numpy.lib import format\nformat.read_array(file)",
        "def f():\n import marshal",
        "eval('1')",
        "run = exec\nrun('1')",
        "import builtins\nbuiltins.eval('1')",
        "__import__('json')",
        "import os\nos.system('ls')",
        "from os import popen as start\nstart('ls')",
        "import subprocess\nsubprocess.run('ls', shell=True)",
        "import subprocess\nsubprocess.run('ls', shell=asked)",
        "from subprocess import getoutput",
        "import torch\ntorch.load(path)",
        "import torch as t\nt.load(path, weights_only=True)",
        "from torch import load",
        "from torch import load as read\nread(path)",
        "import torch.jit\ntorch.jit.load(path)",
        "import torch\ntorch.hub.load(name)",
        "import torch\nread = torch.load\nread(path)",
        "import torch\none = torch\nother = one.load\nother(path)",
        "import torch\nmap(torch.load, paths)",
        "import torch\ngetattr(torch, 'load')(path)",
        "import torch\ngetattr(torch, name)(path)",
        "from torch import *",
        "import yaml\nyaml.load(text, Loader=yaml.SafeLoader)",
        "from yaml import load as y\ny(text)",
        "from yaml import unsafe_load",
        "import yaml\nyaml.compose(text, Loader=yaml.UnsafeLoader)",
        "import importlib\nimportlib.import_module('pickle')",
        "from importlib import import_module\nimport_module('pickle')",
        "from importlib import import_module as get\nget('torch.hub').load(name)",
        "import importlib\nimportlib.import_module(name)",
        "import importlib\nlist(map(importlib.import_module, names))",
        "import importlib.util\nimportlib.util.spec_from_file_location('a', path)",
        "import numpy as np\nnp.load(path)",
        "import numpy as np\nnp.load(path, allow_pickle=True)",
        "import numpy as np\nnp.load(path, None, True)",
        "import numpy as np\nnp.load(path, allow_pickle=asked)",
        "import numpy\nnumpy.load(path, allow_pickle=True)",
        "from numpy import load\nload(path)",
        "import numpy as np\n[*map(np.load, paths)]",
        "import numpy.lib.npyio as io\nio.NpzFile(path, allow_pickle=True)",
        "import pandas as pd\npd.read_pickle(path)",
        "from pandas import read_pickle",
        "import pandas\ntable = pandas\ntable.read_pickle(path)",
        "load(name, trust_remote_code=True)",
        "given = {'trust_remote_code': asked}\nload(name, **given)",
        "import torch\nread(path, weights_only=False)",
    ],
)
def test_what_is_unsafe_is_found(source: str) -> None:
    assert unsafe(source)


@pytest.mark.parametrize(
    "source",
    [
        "import numpy as np\nnp.load(path, mmap_mode='r', allow_pickle=False)",
        "from numpy import load\nload(path, allow_pickle=False)",
        "import yaml\nyaml.safe_load(text)",
        "import yaml\nyaml.compose(text, Loader=yaml.SafeLoader)",
        "import torch\ntorch.save(weights, path)",
        "from safetensors.torch import load\nload(content)",
        "import triton.language as tl\ntl.load(positions)",
        "import importlib\nimportlib.import_module('cv2')",
        "import subprocess\nsubprocess.run(['ls'], shell=False)",
        "import re\nre.compile('a')",
        "network.eval()",
        "self.load(device)",
        "load(name, trust_remote_code=False)",
        "getattr(options, name)",
    ],
)
def test_what_is_safe_is_not(source: str) -> None:
    assert unsafe(source) == []


def test_a_module_that_may_import_by_name_may_nothing_else() -> None:
    source = "from importlib import import_module\nimport_module(name)\n"
    assert unsafe(source, may_import=True) == []
    assert unsafe(source + "eval(name)", may_import=True) == ["builtins.eval"]
