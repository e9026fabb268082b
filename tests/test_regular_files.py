"""Only regular files are read: what stands in the way is said, and nothing is waited for."""

import os
import socket
from pathlib import Path

import pytest
import trimesh

from super_sdf.errors import FileError
from super_sdf.files.formats import check_regular_file
from super_sdf.truth.solid import read_mesh


@pytest.fixture(autouse=True)
def _in_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def make_every_kind() -> None:
    """Make what is no regular file, a name each."""
    Path("folder.npy").mkdir()
    os.mkfifo("pipe.npy")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket.npy")
    Path("zero.npy").symlink_to("/dev/zero")
    Path("loop.npy").symlink_to("loop.npy")
    Path("dangling.npy").symlink_to("nothing.npy")
    Path("file").touch()


WHAT_IS_WRONG = {
    "folder.npy": "is a folder: give a file",
    "pipe.npy": "is a named pipe: give a file",
    "socket.npy": "is a socket: give a file",
    "zero.npy": "is a device: give a file",
    "loop.npy": "cannot be read: Too many levels of symbolic links",
    "dangling.npy": "does not exist",
    "missing.npy": "does not exist",
    "file/in.npy": "does not exist: the path before its last / is not a folder",
    "n" * 300: "cannot be read: File name too long",
    "a\0.npy": "is not a valid file name",
    "a\ud800.npy": "is not a valid file name",
}


@pytest.mark.parametrize("name", WHAT_IS_WRONG, ids=ascii)
def test_what_is_no_regular_file_is_named(name):
    make_every_kind()
    with pytest.raises(FileError) as caught:
        check_regular_file(name)
    shown = name if name.isprintable() else repr(name)
    assert str(caught.value) == f"{shown} {WHAT_IS_WRONG[name]}"


def test_files_and_links_to_them_pass_unless_they_may_not_be_read(monkeypatch):
    Path("file").write_bytes(b"x")
    Path("link").symlink_to("file")
    assert check_regular_file("link") == Path("link")
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may read everything
    with pytest.raises(FileError, match=r"^file cannot be read: permission denied$"):
        check_regular_file("file")


@pytest.mark.parametrize("name", ["pipe.npy", "zero.npy", "loop.npy"])
def test_every_command_reads_regular_files_alone(command, name):
    make_every_kind()
    Path("a.ply").symlink_to(name)
    code, _, err = command(*["sample", "a.ply", "out.npz", "-n", "8"])
    assert (code, err) == (1, f"Error: a.ply {WHAT_IS_WRONG[name]}\n")
    assert command("upsample", name, "out.ply")[2] == f"Error: {name} {WHAT_IS_WRONG[name]}\n"


def test_a_mesh_that_names_a_pipe_is_read_without_it():
    os.mkfifo("pipe.mtl")
    trimesh.creation.box().export("cube.obj")
    mesh = Path("cube.obj").read_text()
    Path("cube.obj").write_text(f"mtllib pipe.mtl\nusemtl red\n{mesh}")
    assert len(read_mesh("cube.obj").faces) == 12
