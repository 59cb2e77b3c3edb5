"""Parts: one writer at a time, nothing of anybody else's written over, whole files or none."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from replay import part_file
from replay.errors import OutputError
from replay.part_file import open_part, part_of, same_file, write_whole


def test_a_part_has_one_writer_at_a_time(tmp_path):
    out = tmp_path / "out.mcap"
    with open_part(out) as first:
        first.write(b"first")
        text = (
            r"out\.mcap\.part is being written by another process; wait until it has ended, or choose another output$"
        )
        with pytest.raises(OutputError, match=text):
            open_part(out)
        first.flush()
        assert part_of(out).read_bytes() == b"first"
    with open_part(out) as second:
        second.write(b"2")
    assert part_of(out).read_bytes() == b"2"


def test_who_comes_between_opening_and_renaming_gets_a_part_of_his_own(tmp_path, monkeypatch):
    """The first writer gives the file its name after the second has opened it, and before he could lock it."""
    out, lock = tmp_path / "out.mcap", part_file._lock
    first = open_part(out)
    first.write(b"whole")

    def finished_meanwhile(number, part):
        if not first.closed:
            first.flush()
            part.replace(out)
            first.close()
        lock(number, part)

    monkeypatch.setattr(part_file, "_lock", finished_meanwhile)
    with open_part(out) as second:
        second.write(b"the second one's")
    assert (out.read_bytes(), part_of(out).read_bytes()) == (b"whole", b"the second one's")


def test_a_part_that_was_left_behind_makes_way_and_its_other_name_keeps_its_content(tmp_path):
    (tmp_path / "out.mcap.part").write_bytes(b"left behind")
    os.link(tmp_path / "out.mcap.part", tmp_path / "saved.mcap")
    with open_part(tmp_path / "out.mcap") as stream:
        stream.write(b"new")
    assert (tmp_path / "saved.mcap").read_bytes() == b"left behind"
    assert (tmp_path / "out.mcap.part").read_bytes() == b"new"


def test_a_writer_that_is_killed_holds_nothing(tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from replay.part_file import open_part; "
        "stream = open_part(Path(sys.argv[1])); os.kill(os.getpid(), 9)"
    )
    killed = subprocess.run([sys.executable, "-c", code, tmp_path / "out.mcap"], check=False, timeout=60)
    assert killed.returncode == -signal.SIGKILL
    open_part(tmp_path / "out.mcap").close()


def test_where_files_cannot_be_locked_they_are_written_all_the_same(tmp_path, monkeypatch):
    def none(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(part_file.fcntl, "flock", none)
    open_part(tmp_path / "out.mcap").close()
    assert part_of(tmp_path / "out.mcap").is_file()


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no devices here")
def test_a_device_is_never_replaced():
    with pytest.raises(FileExistsError, match="Not a regular file"):
        open_part(Path("/dev/null"))
    write_whole(Path("/dev/null"), b"x")
    assert not Path("/dev/null").is_file()
    assert not Path("/dev/null.part").exists()


def test_a_small_file_is_whole_or_the_older_one_stays(tmp_path, monkeypatch):
    path = tmp_path / "summary.json"
    write_whole(path, b"older")

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match=r"summary\.json cannot be written: No space left on device$"):
        write_whole(path, b"newer")
    assert {each.name: each.read_bytes() for each in tmp_path.iterdir()} == {"summary.json": b"older"}


def test_a_link_to_a_small_file_stays_a_link(tmp_path):
    (tmp_path / "real.json").write_bytes(b"older")
    (tmp_path / "link.json").symlink_to("real.json")
    write_whole(tmp_path / "link.json", b"newer")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "real.json").read_bytes() == b"newer"


def test_one_file_by_any_name(tmp_path):
    (tmp_path / "sub").mkdir()
    one = tmp_path / "one"
    one.write_bytes(b"")
    (tmp_path / "symbolic").symlink_to("one")
    os.link(one, tmp_path / "hard")
    for name in ("one", "sub/../one", "symbolic", "hard"):
        assert same_file(one, tmp_path / name)
    assert not same_file(one, tmp_path / "two")
    assert same_file(tmp_path / "two", tmp_path / "sub" / ".." / "two")
