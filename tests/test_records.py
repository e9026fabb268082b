"""Append-only files of JSON lines: whole lines or none, whoever is killed while writing."""

import pytest

from super_sdf.machine.records import RecordFile, parse_line


class Full:
    """A path to a file that takes three bytes more, and then no more."""

    def __init__(self, path):
        self.path, self.room = path, 3

    def open(self, mode, buffering):
        self.file = self.path.open(mode, buffering=buffering)
        return self

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.file.close()

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        if not self.room:
            raise OSError(28, "No space left on device")
        self.room = 0
        return self.file.write(bytes(data[:3]))


def test_lines_are_appended_whole_or_not_at_all_and_an_unfinished_one_is_cut_off(tmp_path):
    path = tmp_path / "lines"
    assert list(RecordFile(path).read()) == []
    RecordFile(path).append({"a": 1})
    with pytest.raises(OSError, match="No space left on device"):
        RecordFile(Full(path)).append([2])
    path.write_bytes(path.read_bytes() + b'nonsense\n{"a')
    file = RecordFile(path)
    assert list(file.read()) == [{"a": 1}, None]
    assert file.unfinished == b'{"a' and file.whole_bytes == 18
    assert path.read_bytes() == b'{"a": 1}\nnonsense\n{"a'  # reading changes nothing
    file.append(2)
    file.append("b")
    assert path.read_bytes() == b'{"a": 1}\nnonsense\n2\n"b"\n'


@pytest.mark.parametrize(
    ("line", "want"), [(b"[1]", [1]), (b"[", None), (10**5 * b"[", None), (b"\xff", None)]
)
def test_a_line_that_is_no_json_holds_nothing(line, want):
    assert parse_line(line) == want
