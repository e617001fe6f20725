"""Stop `make setup` before it begins if a disk has too little space: enough_space.py VENV PACKAGES_GB TEMPORARY_GB.

PACKAGES_GB is what all packages take in VENV, and TEMPORARY_GB what pip needs for temporary files until it has moved
them. Most of it is torch for CUDA, which pip installs only on Linux with an x86-64 processor.
"""

import platform
import shutil
import sys
import tempfile
from pathlib import Path

if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
    sys.exit()
venv, temporary = Path(sys.argv[1]).absolute(), Path(tempfile.gettempdir())
disk = next(folder for folder in [venv, *venv.parents] if folder.is_dir())
here = sum(path.lstat().st_size for path in venv.rglob("*")) / 1e9
packages, more = max(0, float(sys.argv[2]) - here), float(sys.argv[3])
needed = [(disk, packages), (temporary, more)]
if disk.stat().st_dev == temporary.stat().st_dev:
    needed = [(disk, packages + more)]
for folder, least in needed:
    free = shutil.disk_usage(folder).free / 1e9
    if free < least:
        sys.exit(
            f"Too little space: installing needs {least:.1f} GB on the disk of {folder}, and {free:.1f} GB are free. "
            "Remove something there, or choose another disk with VENV=FOLDER (for the packages) or the environment "
            "variable TMPDIR (for temporary files)."
        )
