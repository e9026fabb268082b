"""How a process of the command line ends: by signals, without streams, with little of anything."""

import json
import os
import re
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

from super_sdf import SuperSdfError
from super_sdf.cli.interrupts import Interrupted, exit_code, raising_interrupts

COMMAND = [sys.executable, "-m", "super_sdf"]
QUICK = ["upsample", "in.npy", "out.ply", "--quality", "fast", "--factor", "2"]
QUICK += ["--spacing", "1", "--origin", "0"]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", ball().values)


def run(*arguments, shell="", **options):
    """Run the command line, with redirections of the shell; return exit code, stdout, stderr."""
    words = ["sh", "-c", f'"$@" {shell}', "sh", *COMMAND, *arguments]
    done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE, **options)
    return done.returncode, done.stdout, done.stderr


# What stands in for a long step: it says where it is, and waits for the signal.
STAGE = """
import sys, time
from super_sdf import pipeline
from super_sdf.cli import entry
def wait(*_):
    print(sorted(__import__("os").listdir()), flush=True)
    time.sleep(600)
pipeline.refine = wait
entry.main()
"""
# The same in the midst of an import.
IMPORT = """
import sys, time
class Finder:
    def find_spec(self, name, *_):
        if name == "numpy":
            print("importing", flush=True)
            try:
                time.sleep(600)
            except BaseException as error:
                raise ImportError("something else") from error
sys.meta_path.insert(0, Finder())
from super_sdf.cli.entry import main
main()
"""
# The same within the work, in a library that swallows whatever is raised while it is imported.
LIBRARY = """
import os, sys, time
from importlib.machinery import ModuleSpec
from super_sdf import pipeline
from super_sdf.cli import entry
class Library:
    def find_spec(self, name, *_):
        return ModuleSpec(name, self) if name == "library" else None
    def create_module(self, spec):
        pass
    def exec_module(self, module):
        print("importing", flush=True)
        try:
            while not os.path.exists("go"):
                time.sleep(0.01)
        except BaseException:
            pass
        print("imported", flush=True)
sys.meta_path.insert(0, Library())
right = pipeline.refine
def refine(*arguments, **options):
    import library
    return right(*arguments, **options)
pipeline.refine = refine
entry.main()
"""


@pytest.mark.parametrize(
    "script, number, begun, line",
    [
        (STAGE, signal.SIGINT, ".part", "interrupted; nothing was written"),
        (STAGE, signal.SIGHUP, ".part", "ended by SIGHUP; nothing was written"),
        (IMPORT, signal.SIGTERM, "importing", "ended by SIGTERM"),
        (LIBRARY, signal.SIGTERM, "importing", "ended by SIGTERM; nothing was written"),
    ],
)
def test_a_signal_leaves_a_line_its_exit_code_and_no_file(script, number, begun, line):
    """In an import it waits for the end of that."""
    words = [sys.executable, "-c", script, *QUICK]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, preexec_fn=hear_signals, **pipes) as process:
        assert begun in process.stdout.readline()
        process.send_signal(number)
        Path("go").touch()
        out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (128 + number, f"Error: {line}\n")
    assert out == ("imported\n" if script == LIBRARY else "")
    assert sorted(os.listdir()) == ["go", "in.npy"]


@pytest.mark.parametrize(
    ("script", "line"),
    [(STAGE, "ended by SIGTERM; nothing was written"), (IMPORT, "ended by SIGTERM")],
)
def test_with_json_what_ended_it_is_json_on_stdout(script, line):
    words = [sys.executable, "-c", script, *QUICK, "--json"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, preexec_fn=hear_signals, **pipes) as process:
        process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (143, f"Error: {line}\n")
    assert json.loads(out) == {"error": line}


def test_with_json_an_error_is_json_on_stdout(command):
    for words, code in (
        (["upsample", "none.npy", "out.ply"], 1),
        (["upsample", "in.npy", "out.txt"], 2),
        (["check", "none.ply", "in.npy"], 1),
        (["batch", "none", "--out", "out"], 2),
        (["upsample", "--factor", "x"], 2),
    ):
        found, out, err = command(*words, "--json")
        assert found == code and err == f"Error: {json.loads(out)['error']}\n"


TABLE = (Path(__file__).parent.parent / "docs" / "reference" / "cli.md").read_text()
CODES = {
    0: [QUICK, ["--help"], ["batch", "in.npy", "--out", "a", *QUICK[3:]]],
    1: [
        ["upsample", "none.npy", "out.ply"],
        ["batch", "in.npy", "flat.npy", "--out", "b", *QUICK[3:]],
        ["check", "cube.ply", "in.npy", "--max-mean", "1e-9", *QUICK[7:]],
    ],
    2: [["none"], ["upsample", "in.npy"], ["upsample", "in.npy", "out.ply", "--factor", "3"]],
}
SIGNALS = {129: signal.SIGHUP, 130: signal.SIGINT, 137: signal.SIGKILL, 143: signal.SIGTERM}


def test_the_table_has_all_exit_codes():
    """A reader that ended, 141, has a test of its own."""
    rows = re.findall(r"^\| (\d+) \|", TABLE, re.MULTILINE)
    assert list(map(int, rows)) == sorted([*CODES, *SIGNALS, 141])


@pytest.mark.parametrize(
    ("code", "words"), [(code, words) for code, runs in CODES.items() for words in runs]
)
def test_what_ends_with_a_code_of_the_table(code, words, command):
    np.save("flat.npy", np.ones((4, 4, 4)))
    trimesh.creation.box().export("cube.ply")
    assert command(*words)[0] == code


@pytest.mark.parametrize(("code", "number"), SIGNALS.items())
def test_a_signal_ends_with_its_code_of_the_table(code, number):
    words = [sys.executable, "-c", STAGE, *QUICK]
    with subprocess.Popen(words, preexec_fn=hear_signals, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        process.send_signal(number)
    ended = process.returncode
    assert code == (128 - ended if ended < 0 else ended)  # as a shell counts


@pytest.mark.parametrize("made_of_it", [None, SuperSdfError("odd")])
def test_an_interrupt_that_other_code_catches_is_raised_all_the_same(made_of_it):
    with pytest.raises(Interrupted) as caught, raising_interrupts():
        try:
            signal.raise_signal(signal.SIGTERM)
        except BaseException:
            if made_of_it:
                raise made_of_it from None
    assert exit_code(caught.value) == 128 + signal.SIGTERM


def test_an_ignored_hangup_stays_ignored():
    script = STAGE.replace("time.sleep(600)", "raise MemoryError").replace(
        "    print", "    __import__('os').kill(__import__('os').getpid(), 1); print"
    )
    words = [sys.executable, "-c", script, *QUICK]
    before = lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)  # noqa: E731
    done = subprocess.run(words, capture_output=True, text=True, preexec_fn=before)
    assert (done.returncode, done.stderr.count("out of memory")) == (1, 1)


def test_streams_that_are_closed_or_full_cost_no_mesh():
    assert run(*QUICK, shell="<&- >&- 2>&-")[0] == 0
    mesh = Path("out.ply").read_bytes()
    assert run(*QUICK, "--force", shell="2>/dev/full") == (0, "", "")
    assert Path("out.ply").read_bytes() == mesh and trimesh.load("out.ply").is_watertight
    Path("out.ply").unlink()
    want = "Error: stdout cannot be written: No space left on device; out.ply is written\n"
    assert run(*QUICK, "--json", "--quiet", shell=">/dev/full") == (1, "", want)
    assert Path("out.ply").read_bytes() == mesh
    want = "Error: stdout cannot be written: Bad file descriptor\n"
    assert run("--help", shell=">&-") == (1, "", want)


@pytest.mark.parametrize(
    ("words", "code", "line"),
    [
        ("info", 141, ""),
        ("info --json", 141, ""),
        ("", 141, ""),
        ("upsample --help", 1, ""),
        ("upsample none.npy out.ply --json", 1, "Error: none.npy does not exist\n"),
    ],
)
def test_a_reader_that_has_seen_enough_is_no_error(words, code, line):
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "super_sdf", *words.split()],
        stdout=writer,
        stderr=subprocess.PIPE,
        restore_signals=False,
    )
    os.close(writer)
    assert (done.returncode, done.stderr.decode()) == (code, line)


@pytest.mark.parametrize("handles", [7, 20])
def test_few_file_handles_end_in_a_line_or_a_mesh(handles):
    def limit():
        resource.setrlimit(resource.RLIMIT_NOFILE, (handles, handles))

    code, _, err = run(*QUICK, "--quiet", preexec_fn=limit)
    ours = [line for line in err.splitlines() if line.startswith(("Error: ", "Traceback"))]
    if code == 0:
        assert trimesh.load("out.ply").is_watertight and ours == []
    else:
        assert code == 1 and len(ours) == 1 and "Too many open files" in ours[0]
        assert os.listdir() == ["in.npy"]


@pytest.mark.parametrize("suffix", ["ply", "3mf"])
def test_a_disk_that_fills_leaves_nothing(suffix, command, size=1000):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        code, _, err = command(*QUICK[:2], f"out.{suffix}", *QUICK[3:])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (code, err) == (1, f"Error: out.{suffix} cannot be written: File too large\n")
    assert os.listdir() == ["in.npy"]
