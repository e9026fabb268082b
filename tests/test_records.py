"""Append-only files of JSON lines: whole lines or none, whoever is killed while writing."""

import pytest

from super_sdf.machine.records import RecordFile, parse_line


def test_lines_are_appended_whole_or_not_at_all(tmp_path):
    path = tmp_path / "lines"
    assert list(RecordFile(path).read()) == []
    RecordFile(path).append({"a": 1})
    RecordFile(path).append("b")
    with pytest.raises(OSError, match="No space left on device"):
        RecordFile(Full(path)).append([2])
    path.write_bytes(path.read_bytes() + b"nonsense\n")
    assert path.read_bytes() == b'{"a": 1}\n"b"\nnonsense\n'
    assert list(RecordFile(path).read()) == [{"a": 1}, "b", None]


def test_an_unfinished_line_is_cut_off_before_the_next_one(tmp_path):
    path = tmp_path / "lines"
    path.write_bytes(b'1\n{"a')
    file = RecordFile(path)
    assert list(file.read()) == [1] and file.unfinished == b'{"a' and file.whole_bytes == 2
    assert path.read_bytes() == b'1\n{"a'  # reading changes nothing
    file.append(2)
    file.append(3)
    assert path.read_bytes() == b"1\n2\n3\n"


@pytest.mark.parametrize(
    ("line", "want"), [(b"[1]", [1]), (b"[", None), (10**5 * b"[", None), (b"\xff", None)]
)
def test_a_line_that_is_no_json_holds_nothing(line, want):
    assert parse_line(line) == want


class Full:
    """A path to a file that takes three bytes more, and then no more."""

    def __init__(self, path):
        self.path, self.room = path, 3

    def open(self, mode, buffering):
        """Open it, with this for its write."""
        self.file = self.path.open(mode, buffering=buffering)
        return self

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.file.close()

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        """Take what there is room for."""
        if not self.room:
            raise OSError(28, "No space left on device")
        self.room = 0
        return self.file.write(bytes(data[:3]))
