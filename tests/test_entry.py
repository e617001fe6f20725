"""How commands end early, as the terminal sees it, and what a file gets of their bars."""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from edge_depth_nerf import __version__, cli, entry
from edge_depth_nerf.base import console as console_module
from edge_depth_nerf.base import files
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.plugin import plain_errors

STOPPED = "\nStopped. Run the same command again to resume.\n"
TIMEOUT_S = 120


@pytest.fixture(autouse=True)
def no_debugging(monkeypatch):
    monkeypatch.setenv(entry.DEBUG_VARIABLE, "")


def end_of(monkeypatch, capsys, *arguments: str, error: BaseException | None = None) -> tuple[int, str]:
    """Exit status and what stands on stderr; `error` is raised in place of the command."""
    if error is not None:

        def fail(_):
            raise error

        monkeypatch.setattr(cli, "run", fail)
    monkeypatch.setattr(sys, "argv", ["edge-depth-nerf", *arguments])
    with pytest.raises(SystemExit) as ended:
        entry.main()
    assert isinstance(ended.value.code, int)
    return ended.value.code, capsys.readouterr().err


def test_version_and_help(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["edge-depth-nerf", "--version"])
    entry.main()
    assert capsys.readouterr().out == f"edge-depth-nerf {__version__}\n"
    monkeypatch.setattr(sys, "argv", ["edge-depth-nerf", "--help"])
    with pytest.raises(SystemExit):
        entry.main()
    assert "--debug" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["synthesise", "--output", "x"], "synthesise: no such command. Is synthesize meant? There are synthesize, "),
        (["xyz"], "xyz: no such command. There are synthesize, unpack, process, "),
        (
            ["process", "kitti-360"],
            "kitti-360: no such converter of `process`. Is kitti360 meant? There are kitti360, ",
        ),
    ],
)
def test_a_name_with_a_slip(monkeypatch, capsys, words, said):
    status, stderr = end_of(monkeypatch, capsys, *words)
    assert status == 2 and stderr.startswith(f"edge-depth-nerf: {said}")


def test_a_wrong_option_is_answered_by_its_own_command(capsys):
    with pytest.raises(InputError, match=r"--frames: camera-path has no such option\. --seconds sets"):
        cli.parse(["camera-path", "--load-config", "config.yml", "--frames", "30"])
    with pytest.raises(SystemExit):
        cli.parse(["camera-path", "--fram", "30"])
    said = capsys.readouterr().err
    assert "--fram" in said and "edge-depth-nerf camera-path --help" in said and "synthesize" not in said
    with pytest.raises(SystemExit):
        cli.parse(["process", "rig", "--root", "r", "--output", "o", "--holdout-evry", "3"])
    said = capsys.readouterr().err
    assert "--holdout-every" in said and "kitti360" not in said


def test_a_bug_is_one_paragraph_that_asks_to_be_reported_and_names_the_line(monkeypatch, capsys, tmp_path):
    status, said = end_of(monkeypatch, capsys, "doctor", error=KeyError("not\nthere"))
    assert status == 1
    assert said.count("\n") == 1 and said.startswith(f"edge-depth-nerf: a bug in version {__version__}: KeyError: ")
    assert "--debug" in said and "report" in said and "edge-depth-nerf doctor" in said
    assert "Traceback" not in said
    with pytest.raises(TypeError) as error:
        files.write_json(tmp_path / "x.json", object())
    status, said = end_of(monkeypatch, capsys, "doctor", error=error.value)
    assert status == 1 and "in files.py, line " in said and "TypeError" in said


@pytest.mark.parametrize(
    "error", [InputError("a.png: is broken. Make it again."), FileNotFoundError("b: no such file")]
)
def test_what_the_user_can_mend_is_said_alone(monkeypatch, capsys, error):
    assert end_of(monkeypatch, capsys, "doctor", error=error) == (2, f"edge-depth-nerf: {error}\n")


def test_debug_gives_the_traceback_wherever_it_stands(monkeypatch, capsys, tmp_path):
    arguments = ["inspect", str(tmp_path / "nowhere")]
    status, plain = end_of(monkeypatch, capsys, *arguments)
    assert status == 2 and "Traceback" not in plain and "transforms.json: no such file" in plain
    for place in (0, 1, 2):
        monkeypatch.setenv(entry.DEBUG_VARIABLE, "")
        status, said = end_of(monkeypatch, capsys, *arguments[:place], "--debug", *arguments[place:])
        assert status == 2 and said.startswith("Traceback") and said.endswith(plain) and "in read_scene" in said
        assert os.environ[entry.DEBUG_VARIABLE] == "1"  # for what the command starts


def command(run: str, before: str = "") -> str:
    call = 'cli.run = run\nsys.argv = ["edge-depth-nerf", "doctor"]\nentry.main()\n'
    return f"import sys, time\n{before}\nfrom edge_depth_nerf import cli, entry\n{run}\n{call}"


def interrupted(code: str, until_s: float, *more_s: float, folder: Path | None = None) -> subprocess.CompletedProcess:
    """Run Python code that prints `go`, and send it Ctrl-C some seconds after that, once or more often."""
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder
    )
    with process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "go\n"
            for wait_s in (until_s, *more_s):
                time.sleep(wait_s)
                process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=TIMEOUT_S)
        finally:
            process.kill()
    return subprocess.CompletedProcess(code, process.returncode, out, err)


SYNTHESIS = """
import sys
from edge_depth_nerf.entry import main
WORDS = ["edge-depth-nerf", "synthesize", "--scene", "parking", "--output", "drive", "--size", "64", "--frames"]
"""


def test_ctrl_c_while_it_starts(tmp_path):
    """While libraries are imported."""
    code = """
class Words(list):
    def __getitem__(self, key):
        print("go", flush=True)  # main has begun: Ctrl-C is its business from here on
        return super().__getitem__(key)
sys.argv = Words([*WORDS, "400"])
main()
"""
    done = interrupted(SYNTHESIS + code, 1.5, folder=tmp_path)
    assert (done.returncode, done.stderr) == (130, STOPPED)


@pytest.mark.parametrize(
    ("ending", "import_s", "more_s"),
    [
        ("raise ImportError('Please report an issue.') from None", 0.6, ()),
        ("pass", 0.6, ()),
        ("raise ImportError('Please report an issue.') from None", 60.0, (0.3,)),
        ("pass", 60.0, (0.2, 0.2)),
    ],
)
def test_ctrl_c_waits_for_the_end_of_an_import(tmp_path, ending, import_s, more_s):
    """Modules turn it into errors of their own, or swallow it. Whoever presses it twice does not wait."""
    lines = ["try:", f"    print('go', flush=True), time.sleep({import_s})", "except BaseException:", f"    {ending}"]
    (tmp_path / "slow.py").write_text("\n".join(["import time", *lines, "print('imported', flush=True)"]))
    code = command("def run(_):\n    import slow\n    time.sleep(60)")
    started = time.monotonic()
    done = interrupted(code, 0.2, *more_s, folder=tmp_path)
    assert (done.returncode, done.stderr) == (130, STOPPED)
    assert done.stdout == ("" if more_s else "imported\n")
    assert time.monotonic() - started < 30


def test_ctrl_c_is_not_lost_in_a_package_that_catches_everything(tmp_path):
    """trimesh does while it works, too."""
    (tmp_path / "trimesh.py").write_text("""
import time
def work():
    try:
        print("go", flush=True)
        time.sleep(0.6)
    except BaseException:
        pass
    print("worked", flush=True)
""")
    code = command("def run(_):\n    trimesh.work()\n    time.sleep(60)", "sys.path.insert(0, '')\nimport trimesh")
    done = interrupted(code, 0.2, folder=tmp_path)
    assert (done.returncode, done.stderr, done.stdout) == (130, STOPPED, "worked\n")


@pytest.mark.slow
def test_ctrl_c_at_work_leaves_whole_files(tmp_path):
    code = """
import edge_depth_nerf.synthetic.drive as drive
in_turn = drive.in_turn
def told(*arguments):
    for number, job in enumerate(in_turn(*arguments)):
        if number == 4:
            print("go", flush=True)
        yield job
drive.in_turn = told
sys.argv = [*WORDS, "12"]
main()
"""
    done = interrupted(SYNTHESIS + code, 0.2, folder=tmp_path)
    assert (done.returncode, done.stderr) == (130, STOPPED)
    pictures = list((tmp_path / "drive").rglob("*.png"))
    assert len(pictures) > 4 and all(files.read_image(path).size for path in pictures if "data_rgb" in str(path))
    assert not [path for path in (tmp_path / "drive").rglob("*") if path.name.startswith(".")]


@pytest.mark.slow
def test_ctrl_c_again_and_again_while_threads_finish():
    code = """
import torch  # takes its time, in which the first Ctrl-C would meet no threads
from rich.console import Console
from edge_depth_nerf.base.console import run_jobs
def job():
    print("begun", flush=True)
    time.sleep(0.9)
def run(_):
    print("go", flush=True)
    run_jobs([job] * 200, "working", Console(quiet=True))
"""
    done = interrupted(command(code), 0.2, 0.2, 0.2)
    assert (done.returncode, done.stderr) == (130, STOPPED)
    assert 0 < done.stdout.count("begun") < 100


@pytest.fixture
def hook(monkeypatch):
    """The hook for nerfstudio's commands, and what it passes on."""
    passed = []

    def before(*exception):
        passed.append(exception)

    monkeypatch.setattr(sys, "excepthook", before)
    plain_errors.say_errors_plainly()
    first = sys.excepthook
    assert first is not before
    plain_errors.say_errors_plainly()
    assert sys.excepthook is first
    return passed


def raised(call, *arguments) -> tuple:
    try:
        call(*arguments)
    except BaseException:
        return sys.exc_info()
    pytest.fail("nothing was raised")


def fail(error: BaseException) -> None:
    raise error


def test_nerfstudio_says_our_errors_plainly(hook, capsys, monkeypatch, tmp_path):
    sys.excepthook(*raised(fail, InputError("scene: has no frames. Make it again.")))
    assert capsys.readouterr().err == "\nedge-depth-nerf: scene: has no frames. Make it again.\n"
    # a missing file in our own words
    from edge_depth_nerf.scene.reader import read_scene

    sys.excepthook(*raised(read_scene, tmp_path))
    assert capsys.readouterr().err.startswith(f"\nedge-depth-nerf: {tmp_path}/transforms.json: no such file.")
    sys.excepthook(*raised(fail, KeyboardInterrupt()))
    assert capsys.readouterr().err == "\nStopped.\n"
    assert hook == []
    monkeypatch.setenv(entry.DEBUG_VARIABLE, "1")
    sys.excepthook(*raised(read_scene, tmp_path))
    assert len(hook) == 1 and capsys.readouterr().err == ""


def test_errors_of_others_stay_theirs(hook, capsys, tmp_path):
    theirs = (fail, ValueError("theirs")), (fail, FileNotFoundError("theirs")), (open, tmp_path / "none")
    for call, argument in theirs:
        sys.excepthook(*raised(call, argument))
    # the system's words, wherever they were met
    sys.excepthook(*raised(files.read_json, tmp_path / "none.json"))
    assert [kind for kind, *_ in hook][:3] == [ValueError, FileNotFoundError, FileNotFoundError]
    assert "theirs" not in capsys.readouterr().err


def test_whoever_reads_the_output_may_go(tmp_path):
    call = [sys.executable, "-m", "edge_depth_nerf", "compare", "--help"]
    with subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == entry.PIPE_STATUS


@pytest.mark.slow
def test_ns_train_on_what_is_no_scene(capfd, monkeypatch, tmp_path, unchecked_types):
    from nerfstudio.scripts.train import entrypoint

    words = ["edge-depth-nerf-lite", "--data", tmp_path / "nowhere", "--vis", "tensorboard"]
    monkeypatch.setattr(sys, "argv", ["ns-train", *map(str, [*words, "--output-dir", tmp_path / "runs"])])
    monkeypatch.setattr(sys, "excepthook", lambda *_: pytest.fail("ns-train has not put in the hook"))
    error = raised(entrypoint)
    sys.excepthook(*error)
    out, err = capfd.readouterr()
    assert err.splitlines()[-1].startswith(f"edge-depth-nerf: {tmp_path}/nowhere/transforms.json: no such file.")
    # the settings that were changed, not all two hundred
    assert "edge-depth-nerf-lite: 2000 steps on cpu, scene" in out and "--vis tensorboard" in out
    assert "FusedAdamConfig" not in out and len(out.splitlines()) < 10
    assert not (tmp_path / "runs").exists(), "no run was begun"


@pytest.mark.parametrize("terminal", [False, True])
def test_a_file_gets_a_line_now_and_then_where_a_terminal_has_bars(monkeypatch, terminal):
    monkeypatch.setattr(console_module, "TOLD_EVERY_S", 0.01)
    written = io.StringIO()
    console = Console(file=written, force_terminal=terminal)
    with console_module.told(console, "Process"), console_module.progress_bars(Console(quiet=True)) as bars:
        bars.update(bars.add_task("Sweeping …", total=4.0), completed=1.0)
        time.sleep(0.2)
    lines = written.getvalue().splitlines()
    assert "Process: 0 s, Sweeping 25 %" in lines or (terminal and not lines)
    time.sleep(0.05)
    assert written.getvalue().splitlines() == lines and not console_module._Bars.shown
