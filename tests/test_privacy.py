"""A run leaves no file in the user's home, opens no socket and prints no line of onnxruntime."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ball

import super_sdf

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
