"""Files that appear whole or not at all, and what is left of those that did not."""

import os
import stat
from pathlib import Path

import pytest
from conftest import refusal

from super_sdf.errors import WriteError
from super_sdf.files.output import check_free, replacing

pytestmark = pytest.mark.usefixtures("folder")


def make(path, *, force=False, meanwhile=lambda: None):
    """Write a file as all are written; something happens meanwhile."""
    with replacing(Path(path), force=force) as part:
        part.write_text("mine")
        meanwhile()


def why(path, *, force=False):
    """Return why a file cannot be made there, before the work."""
    return refusal(WriteError, check_free, Path(path), force=force)


def test_a_file_that_appears_meanwhile_is_kept_unless_forced():
    make("one.ply")
    want = "^out.ply exists: remove it or use force=True$"
    with pytest.raises(WriteError, match=want):
        make("out.ply", meanwhile=lambda: Path("out.ply").write_text("theirs"))
    assert Path("out.ply").read_text() == "theirs"
    make("out.ply", force=True, meanwhile=lambda: Path("out.ply").write_text("theirs"))
    assert Path("out.ply").read_text() == "mine"
    with pytest.raises(WriteError, match=r"^new.ply exists: remove"):
        make("new.ply", meanwhile=lambda: os.symlink("gone.ply", "new.ply"))  # is not followed
    assert sorted(os.listdir()) == ["new.ply", "one.ply", "out.ply"]


@pytest.mark.parametrize("there", ["old", None])
def test_by_force_a_link_stays_one_and_what_it_leads_to_is_written(there):
    os.mkdir("disk")
    if there:
        Path("disk/there.ply").write_text(there)
    os.symlink("disk/there.ply", "out.ply")
    assert why("out.ply") == "out.ply exists: remove it or use force=True"
    make("out.ply", force=True)
    assert os.readlink("out.ply") == "disk/there.ply"
    assert Path("disk/there.ply").read_text() == "mine" and os.listdir("disk") == ["there.ply"]


@pytest.mark.parametrize("name", ["out.ply", "x" * 251 + ".ply", "ä" * 125 + ".ply"])
def test_a_file_that_is_replaced_keeps_its_mode_and_a_protected_one_stays(name):
    make(name)
    os.chmod(name, 0o664)
    make(name, force=True)
    assert os.listdir() == [name] and stat.S_IMODE(os.stat(name).st_mode) == 0o664
    Path(name).write_text("old")
    with pytest.raises(WriteError, match="is write-protected: allow writing to it, or give ano"):
        make(name, force=True, meanwhile=lambda: os.chmod(name, 0o444))
    assert "is write-protected" in why(name, force=True)  # also for root
    assert Path(name).read_text() == "old" and os.listdir() == [name]
