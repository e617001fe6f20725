"""A coverage-guided fuzzer (atheris) on one of our own parsers: `python tests/fuzz_parsers.py "kitti poses" 100000`.

Atheris is libFuzzer for Python: it keeps the inputs that reach a branch not seen before, and goes on from these. An
error that is not ours, a second without an answer, or more than a gigabyte beside what the imports take, ends it with
status 1 and the input in a file. Without a name it runs all of them, each in a process of its own.
"""

import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import atheris  # pyrefly: ignore[missing-import]

SEEN = ["edge_depth_nerf.process", "edge_depth_nerf.base.bounds", "edge_depth_nerf.base.files"]
with atheris.instrument_imports(include=SEEN):  # pyrefly: ignore
    from bad_input import OURS

from edge_depth_nerf.base.errors import InputError  # noqa: E402 (what is instrumented comes first)

RUNS = 100_000
MOST_MEGABYTES = 2048
"""Of the whole process; torch and what else is imported take half of it at most."""
MOST_SECONDS = 1.0
MOST_CHARACTERS = 4096


def fuzz(name: str, runs: int) -> None:
    reader = OURS[name]
    # in memory, where the machine has such a disk
    shared = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(dir=shared if shared.is_dir() else None))
    path = reader.make(folder)
    corpus = folder / "corpus"
    corpus.mkdir()
    (corpus / "valid").write_bytes(path.read_bytes())
    warnings.simplefilter("ignore")

    def one(content: bytes) -> None:
        path.write_bytes(content)
        started = time.process_time()
        try:
            reader.read(path)
        except (InputError, FileNotFoundError):
            pass
        # libFuzzer's own limit counts what other programs take, too
        if time.process_time() - started > MOST_SECONDS:
            raise TimeoutError(f"{time.process_time() - started:.1f} s")

    limits = [f"-runs={runs}", "-timeout=30", f"-rss_limit_mb={MOST_MEGABYTES}", f"-max_len={MOST_CHARACTERS}"]
    atheris.Setup([sys.argv[0], *limits, "-print_final_stats=1", "-verbosity=0", str(corpus)], one)
    atheris.Fuzz()


def main() -> None:
    if len(sys.argv) > 1:
        fuzz(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else RUNS)
        return
    failed = [name for name in OURS if subprocess.run([sys.executable, __file__, name], check=False).returncode]
    sys.exit(f"found something in: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
