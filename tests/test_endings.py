"""How a process of the command line ends: by signals, without streams; and what it leaves."""

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import ball
from processes import PATIENCE, hear_signals

import super_sdf

COMMAND = [sys.executable, "-m", "super_sdf"]
QUICK = ["upsample", "in.npy", "out.ply", "--quality", "fast", "--factor", "2"]
QUICK += ["--spacing", "1", "--origin", "0"]


@pytest.fixture(autouse=True)
def here(folder):
    np.save("in.npy", ball().values)


def run(*arguments, shell="", **options):
    """Run the command line, with redirections of the shell; return exit code, stdout, stderr."""
    words = ["sh", "-c", f'"$@" {shell}', "sh", *COMMAND, *arguments]
    done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE, **options)
    return done.returncode, done.stdout, done.stderr


# What stands in for a long step: it says that it is there, and waits for the signal. It may be
# within a callback, such as that of the import lock, where Python drops what is raised.
STAGE = """
import sys, time
from super_sdf import convert
from super_sdf.cli.main import main
def wait(*_, **__):
    print("waiting", flush=True)
    time.sleep(600)
class Callback:
    __del__ = wait
def wait_in_callback(*_, **__):
    Callback()
    time.sleep(600)
convert.mesh_grid = {}
main()
"""


@pytest.mark.parametrize("step", ["wait", "wait_in_callback"])
@pytest.mark.parametrize("name", ["SIGINT", "SIGHUP", "SIGTERM"])
def test_a_signal_leaves_a_line_its_exit_code_and_no_file(name, step):
    line = "interrupted" if name == "SIGINT" else f"ended by {name}"
    number = signal.Signals[name]
    words = [sys.executable, "-c", STAGE.format(step), *QUICK, "--json"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, preexec_fn=hear_signals, **pipes) as process:
        assert process.stdout.readline()
        process.send_signal(number)
        out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err.strip()) == (128 + number, f"Error: {line}")
    assert json.loads(out) == {"error": line} and os.listdir() == ["in.npy"]


def test_a_signal_does_not_interrupt_the_import_of_a_module_for_a_batch():
    """As the import of igl does, this import makes another exception of an interrupt."""
    late = "try: signal.raise_signal(signal.SIGTERM)\nexcept BaseException: raise ImportError"
    Path("late.py").write_text(f"import signal\n{late}")
    words = [sys.executable, "-c", STAGE.format("lambda *_, **__: __import__('late') and wait()")]
    words += ["batch", "in.npy", "--out", "out", "--spacing", "1"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 143 and "Error: ended by SIGTERM: 1 to do;" in done.stderr
    assert os.listdir("out") == [".super-sdf-batch.lock"]


def test_with_json_an_error_is_json_on_stdout(command):
    for words, code in (
        (["upsample", "none.npy", "out.ply"], 1),
        (["check", "none.ply", "in.npy"], 1),
        (["batch", "none", "--out", "out"], 2),
        (["upsample", "--factor", "x"], 2),
    ):
        found, out, err = command(*words, "--json")
        assert found == code and err == f"Error: {json.loads(out)['error']}\n"


def test_streams_that_are_closed_or_full_cost_no_mesh():
    assert run(*QUICK, shell="<&- >&- 2>&-")[0] == 0
    mesh = Path("out.ply").read_bytes()
    assert run(*QUICK, "--force", shell="2>/dev/full") == (0, "", "")
    assert Path("out.ply").read_bytes() == mesh and trimesh.load("out.ply").is_watertight
    want = "Error: [Errno 28] No space left on device\n"
    assert run(*QUICK, "--force", "--json", "--quiet", shell=">/dev/full") == (1, "", want)


@pytest.mark.parametrize("words", ["info", "", "upsample --help"])
def test_a_reader_that_has_seen_enough_is_told_nothing(words):
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [*COMMAND, *words.split()], stdout=writer, stderr=subprocess.PIPE, restore_signals=False
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.parametrize("suffix", ["ply", "3mf"])
def test_a_disk_that_fills_leaves_what_was_there(suffix, command):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    Path(f"out.{suffix}").write_text("before")
    try:
        code, _, err = command(*QUICK[:2], f"out.{suffix}", *QUICK[3:], "--force")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (code, err) == (1, f"Error: out.{suffix} cannot be written: File too large\n")
    assert sorted(os.listdir()) == ["in.npy", f"out.{suffix}"]
    assert Path(f"out.{suffix}").read_text() == "before"


# A run leaves no file in the user's home, opens no socket and prints no line of onnxruntime

# The kernel ends the process at its first socket, whichever thread or library asks for it.
NO_SOCKETS = """
import ctypes, platform, struct
def forbid_sockets():
    number = {"x86_64": 41, "aarch64": 198}[platform.machine()]
    load_number, return_if_other = (0x20, 0, 0, 0), (0x15, 0, 1, number)
    kill, allow = (0x06, 0, 0, 0x80000000), (0x06, 0, 0, 0x7FFF0000)
    steps = b"".join(struct.pack("HBBI", *s) for s in (load_number, return_if_other, kill, allow))
    kept = ctypes.create_string_buffer(steps)
    class Program(ctypes.Structure):
        _fields_ = [("count", ctypes.c_ushort), ("steps", ctypes.c_void_p)]
    library = ctypes.CDLL(None, use_errno=True)
    assert library.prctl(38, 1, 0, 0, 0) == 0  # PR_SET_NO_NEW_PRIVS
    program = Program(4, ctypes.addressof(kept))
    assert library.prctl(22, 2, ctypes.byref(program)) == 0  # PR_SET_SECCOMP, by a filter
forbid_sockets()
"""
UPSAMPLE = """
import os, sys
from super_sdf.cli.main import main
sys.argv = ["super-sdf", "upsample", "in.npy", "out.ply", "--device", "cpu"]
main()
assert "ORT_DISABLE_TELEMETRY" not in os.environ
print(sum(os.readlink(e.path).startswith("socket") for e in os.scandir("/proc/self/fd")
          if os.path.islink(e.path)))
"""


def run_at_home(home, script, **variables):
    """Run a script in a process of its own, whose user has this home and no settings."""
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    sources = str(Path(super_sdf.__file__).parent.parent)
    given = {"HOME": str(home), "PYTHONPATH": sources, "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        [sys.executable, "-c", script],
        env={**kept, **given, **variables},
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize("home", ["fresh", "unwritable"])
def test_a_run_leaves_nothing_at_home_and_calls_nobody(tmp_path, monkeypatch, home):
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", ball(16, 4.0).values)
    Path("fresh").mkdir()
    Path("unwritable").write_text("")  # nothing can be made below a file, not even by root
    run = run_at_home(tmp_path / home, NO_SOCKETS + UPSAMPLE)
    assert (run.returncode, run.stdout) == (0, "0\n"), run.stderr
    notes, (last,) = run.stderr.splitlines()[:-1], run.stderr.splitlines()[-1:]
    assert last.startswith("out.ply: ") and all(note.startswith("Note: ") for note in notes)
    assert list(Path("fresh").iterdir()) == []
    assert sorted(os.listdir()) == ["fresh", "in.npy", "out.ply", "unwritable"]


def test_a_socket_would_have_been_seen(tmp_path):
    run = run_at_home(tmp_path, NO_SOCKETS + "import socket; socket.socket()")
    assert run.returncode == -31  # SIGSYS


def test_an_onnxruntime_that_does_not_load_is_one_line(tmp_path):
    fault = "raise ImportError('no libonnxruntime.so\\nmore')"
    (tmp_path / "onnxruntime.py").write_text(fault)
    np.save(tmp_path / "in.npy", ball(16, 4.0).values)
    script = f"import sys; sys.path.insert(0, {str(tmp_path)!r})" + UPSAMPLE.replace(
        "in.npy", str(tmp_path / "in.npy")
    )
    run = run_at_home(tmp_path, script)
    way_out = "pip install --force-reinstall onnxruntime"
    said = f"Error: onnxruntime cannot be imported (no libonnxruntime.so): {way_out}\n"
    assert (run.returncode, run.stderr) == (1, said)
