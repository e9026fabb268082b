"""How a process of the command line ends: by signals, without streams, with little of anything."""

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


# What stands in for a long step: it says that it is there, and waits for the signal.
STAGE = """
import sys, time
from super_sdf import convert
from super_sdf.cli.main import main
def wait(*_, **__):
    print("waiting", flush=True)
    time.sleep(600)
convert.mesh_grid = wait
main()
"""


def ended(script, number, *more):
    """Run a script until its first line, send it a signal; return its exit code and streams."""
    words = [sys.executable, "-c", script, *QUICK, *more]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, preexec_fn=hear_signals, **pipes) as process:
        assert process.stdout.readline()
        process.send_signal(number)
        out, err = process.communicate(timeout=PATIENCE)
    return process.returncode, out, err.strip()


SIGNALS = {"interrupted": signal.SIGINT, "ended by SIGHUP": signal.SIGHUP, "ended by SIGTERM": 15}


@pytest.mark.parametrize("line", SIGNALS)
def test_a_signal_leaves_a_line_its_exit_code_and_no_file(line):
    number = SIGNALS[line]
    code, out, err = ended(STAGE, number, "--json")
    assert (code, err.splitlines()[-1]) == (128 + number, f"Error: {line}")
    assert json.loads(out) == {"error": line} and os.listdir() == ["in.npy"]


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
def test_a_disk_that_fills_leaves_nothing(suffix, command):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        code, _, err = command(*QUICK[:2], f"out.{suffix}", *QUICK[3:])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (code, err) == (1, f"Error: out.{suffix} cannot be written: File too large\n")
    assert os.listdir() == ["in.npy"]
