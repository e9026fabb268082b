"""What a batch finds: files, folders, patterns and lists, whatever is in them."""

import errno
import glob
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from batches import files
from conftest import ball

from super_sdf.batch.inputs import find_jobs
from super_sdf.options import Options
from super_sdf.files.formats import GRID_SUFFIXES
from super_sdf.files.meshes import MESH_SUFFIXES
from super_sdf.options import BATCH_LISTS

pytestmark = pytest.mark.usefixtures("grid_folder")


def test_patterns_keep_the_folders_below_their_fixed_part_and_links_in_a_circle_end(run_batch):
    for name in "abc":
        Path("in", name).symlink_to(Path("in").absolute())
        Path("in/deep", name).symlink_to("..")
    for words in ("in/**/*.np?", "in"):
        assert run_batch(words, "--cap", "--dry-run")[2].startswith("4 to do")
    assert run_batch("in/a/*.npy", "--dry-run")[2].startswith("2 to do")  # named: followed
    run_batch("in/de*/er/*.npy")
    assert files().keys() == {"deep/er/c.d.ply", "report.jsonl"}
    Path("in/x[1].npy").write_bytes(Path("in/a.npy").read_bytes())
    assert run_batch("in/x[1].npy", out="other")[0] == 0  # before a pattern goes such a file


def test_a_list_names_files_from_where_it_lies(run_batch):
    Path("in/list.txt").write_text("# two of them\n\n deep/b.npz\n../in/a.npy\nnone.npy\n")
    code, _, err = run_batch("in/list.txt")
    assert code == 1 and files().keys() == {"deep/b.ply", "a.ply", "report.jsonl"}
    assert f"Failed: {Path('in/none.npy')} does not exist\n" in err
    last = run_batch("in/list.txt")[2].splitlines()[-1]
    assert last.startswith("nothing to do: 2 done before, 1 fail")
    np.save("in/none.npy", ball(12, 3.0).values)
    assert run_batch("in/list.txt")[0] == 0


def test_byte_order_marks_and_line_ends_of_windows_change_nothing(run_batch):
    Path("in/list.txt").write_bytes(b"\xef\xbb\xbfa.npy\r\ndeep/b.npz\r\n")
    Path("list.jsonl").write_bytes(b'\xef\xbb\xbf{"in": "in/a.npy", "out": "c.ply"}\r\n\r\n')
    assert run_batch("in/list.txt", "list.jsonl")[0] == 0
    assert files().keys() == {"a.ply", "deep/b.ply", "c.ply", "report.jsonl"}


def test_a_list_of_objects_has_options_of_its_own(run_batch, command):
    np.save("in/a.npy", -2 * ball(12, 3.0).values)
    line = {"in": "in/a.npy", "out": "x/y.stl", "spacing": 2, "origin": [1, 2, 3], "factor": 4}
    other = {"in": "in/deep/er/c.d.npy", "cap": True, "inside": "negative"}
    lines = [{**line, "inside": "positive", "offset": 1}, other]
    Path("list.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert run_batch("list.jsonl") == (0, "", "2 done, 0 failed; 2 meshes closed, 0 open\n")
    options = ("--spacing", 2, "--origin", "1,2,3", "--inside", "positive", "--offset", 1)
    command("upsample", "in/a.npy", "single.stl", *options, "--quality", "fast")
    assert Path("single.stl").read_bytes() == Path("out/x/y.stl").read_bytes()


WHOLE_LISTS = {
    "": "list.jsonl names no file: give a path a line",
    "{": "list.jsonl, line 1 is no JSON: Expecting property name enclosed in double quotes: "
    "line 1 column 2 (char 1)",
    "[1]": 'list.jsonl, line 1 is [1]: give an object, {"in": "a.npy"}',
    "[" * 100_000: 'list.jsonl, line 1 is nested too deeply: give an object, {"in": "a.npy"}',
    '"' + "x" * 10**7 + '"': f'list.jsonl, line 1 is "{"x" * 119}...{"x" * 119}": give an object, '
    '{"in": "a.npy"}',
    '{"out": "a.ply"}': "list.jsonl, line 1: 'in' is None: give the path of a grid",
    '{"in": "."}': "list.jsonl, line 1: 'in' is '.': give the path of a grid",
    '{"in": "a\\u0000.npy"}': "list.jsonl, line 1: 'in' is 'a\\x00.npy': no file can have this "
    "name",
    '{"in": "a\\ud800.npy"}': "list.jsonl, line 1: 'in' is 'a\\ud800.npy': no file can have this "
    "name",
    '{"in": "a.npy", "out": "report.jsonl/x.ply"}': "a.npy would become report.jsonl/x.ply, but "
    "the first of these names is the batch's own: rename it",
    '\n{"in": "a.npy", "factor": 3}': "list.jsonl, line 2: 'factor' is 3: give an even number from "
    "2 to 16 (an odd one has no node on the samples)",
    '{"in": "a.npy", "factor": 1' + "0" * 5000 + "}": "list.jsonl, line 1 is no JSON: Exceeds the "
    "limit (4300 digits) for integer string conversion: value has 5001 digits; use "
    "sys.set_int_max_str_digits() to increase the limit",
}
OPTIONS = {
    '"Factor": 2': "'Factor' is unknown: give in, out, " + ", ".join(BATCH_LISTS),
    '"simplify": 1, "triangles": 9': "simplify 1.0 and triangles 9: give only one of them",
    '"cap": 1': "'cap' is 1: give True or False, in JSON true or false",
    '"out": "a.xyz"': "'out' is 'a.xyz': give a file, one of " + ", ".join(MESH_SUFFIXES),
    '"out": "a/../../b.ply"': "'out' is 'a/../../b.ply': give a path within the output folder",
    '"offset": 1' + "0" * 400: f"'offset' is 1{'0' * 56}...: give a finite number, in world units",
    '"offset": NaN': "NaN is no number: give a finite one",
    '"in": "b.npy"': "'in' is there twice: give it once",
}
LISTS = WHOLE_LISTS | {
    f'{{"in": "a.npy", {text}}}': f"list.jsonl, line 1: {message}"
    for text, message in OPTIONS.items()
}


@pytest.mark.parametrize("text", LISTS, ids=range(len(LISTS)))
def test_a_list_without_meaning_is_refused_before_the_work(run_batch, text):
    Path("list.jsonl").write_text(text)
    assert run_batch("list.jsonl") == (2, "", f"Error: {LISTS[text]}\n")
    assert not Path("out").exists()


ARGUMENTS = {
    "none.npy": "none.npy does not exist: give grids, folders, patterns or a manifest",
    "in/*.raw": f"in/*.raw holds no grid ({', '.join(GRID_SUFFIXES)})",
    "empty": f"empty holds no grid ({', '.join(GRID_SUFFIXES)})",
    "odd.raw": f"odd.raw is neither a grid ({', '.join(GRID_SUFFIXES)}) nor a manifest "
    "(.txt, .jsonl)",
}


@pytest.mark.parametrize("argument", ARGUMENTS)
def test_arguments_that_name_no_grid_are_refused(run_batch, argument):
    Path("empty").mkdir()
    Path("odd.raw").write_text("")
    assert run_batch("in", argument) == (2, "", f"Error: {ARGUMENTS[argument]}\n")


def test_a_name_too_long_fails_by_its_name(run_batch):
    long = 300 * "n"
    Path("list.jsonl").write_text(f'{{"in": "{long}.npy"}}\n{{"in": "in/a.npy"}}')
    code, _, err = run_batch("list.jsonl")
    assert code == 1 and files().keys() == {"in/a.ply", "report.jsonl"}
    reason = "does not exist: the name is longer than the system allows"
    assert err.startswith(f"Failed: {long}.npy {reason}\n1 done, 1 failed")
    Path("list.jsonl").write_text(f'{{"in": "in/a.npy", "out": "{long}.ply"}}')
    code, _, err = run_batch("list.jsonl")
    reason = f"{Path('out', long)}.ply cannot be written: File name too long"
    assert code == 1 and err.startswith(f"Failed: in/a.npy: {reason}\n")


def test_names_that_no_terminal_shows_take_one_line(run_batch):
    os.link("in/bad.npy", b"in/bad\n\xff.npy")
    _, _, err = run_batch("in")
    assert "Failed: in/bad\\n\\udcff.npy: every value is 1" in err
    assert "in/bad\\n\\udcff.npy" in run_batch("in", "--dry-run")[1]


def test_what_is_no_regular_file_fails_by_its_name(run_batch):
    os.mkfifo("in/pipe.npy")
    Path("in/loop.npz").symlink_to("loop.npz")
    Path("in/zero.npy").symlink_to("/dev/zero")
    for _ in range(2):
        code, _, err = run_batch("in")
        assert code == 1 and "3 done" in err
        assert "Failed: in/pipe.npy is a named pipe: give a file\n" in err
        assert "Failed: in/zero.npy is a device: give a file\n" in err
        assert "Failed: in/loop.npz cannot be read: its links lead in a circle\n" in err
    os.mkfifo("list.txt")
    grids = ", ".join(GRID_SUFFIXES)
    want = f"Error: list.txt is neither a grid ({grids}) nor a manifest (.txt, .jsonl)\n"
    assert run_batch("list.txt") == (2, "", want)


def test_patterns_find_what_the_shell_would(run_batch):
    Path("in/.hidden").mkdir()
    shutil.copy("in/a.npy", "in/.hidden/a.npy")
    patterns = "in/*", "in/**", "in/**/**/*.npz", "in/*/b.*", "in/deep/[a-f]*/*", "in/.h*/*.npy"
    for pattern in patterns:
        want = {Path(p) for p in glob.glob(pattern, recursive=True)}
        want = {path for path in want if path.suffix in (".npy", ".npz")}
        assert {job.source for job in find_jobs([pattern], ".ply", Options()).jobs} == want
    below = find_jobs(["in"], ".ply", Options()).jobs
    assert Path("in/.hidden/a.npy") in {job.source for job in below}


def test_folders_that_cannot_be_read_are_named(run_batch, monkeypatch):
    scan = os.scandir

    def refuse(path):
        if str(path).endswith("deep"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", refuse)
    os.remove("in/bad.npy")
    reason = f"{Path('in/deep')} cannot be read: permission denied"
    want = f"Failed: {reason}\n1 done, 1 failed; 1 meshes closed, 0 open\n"
    assert run_batch("in") == (1, "", want)
    _, out, err = run_batch("in", "--dry-run")
    assert f"unread: {reason}\n" in out and err.endswith(", 1 unread\n")
    assert run_batch("in/deep") == (1, "", f"Error: {reason}\n")
    assert ", 1 folders unread; " in run_batch("in")[2]
