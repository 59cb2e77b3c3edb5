"""Private folders: removed with their process, however it ended, and never under one that still needs them."""

import os
import signal
import subprocess
import sys
import tempfile
import time

import pytest

from replay.private_folder import PREFIX, YOUNG_S, PrivateFolder, remove_if_abandoned

_KILLED = (
    "import os, sys, time; from replay.private_folder import PrivateFolder; "
    "folder = PrivateFolder(); print(folder.path, flush=True); sys.stdin.read()"
)


@pytest.fixture(autouse=True)
def temporary(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


@pytest.fixture
def left_behind(temporary):
    """A folder whose process was killed."""
    process = subprocess.Popen([sys.executable, "-c", _KILLED], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=30)
    (folder,) = temporary.glob(f"{PREFIX}*")
    (folder / "bus").write_bytes(b"")
    return folder


def aged(folder):
    then = time.time() - YOUNG_S - 1
    os.utime(folder, (then, then))
    return folder


def test_only_its_user_can_enter(temporary):
    folder = PrivateFolder()
    assert folder.path.parent == temporary
    assert folder.path.stat().st_mode & 0o777 == 0o700
    (folder.path / "bus").write_bytes(b"")
    for _ in range(2):
        folder.remove()
        assert list(temporary.iterdir()) == []


def test_whoever_was_spawned_removes_what_is_left_to_him(left_behind):
    assert remove_if_abandoned(left_behind)
    assert not left_behind.exists()
    assert not remove_if_abandoned(left_behind, patience_s=0)


def test_a_folder_in_use_is_left_alone_until_it_is_given_up():
    folder = PrivateFolder()
    aged(folder.path)
    assert not remove_if_abandoned(folder.path, patience_s=0.05)
    PrivateFolder().remove()
    assert folder.path.is_dir()
    folder.give_up()
    assert remove_if_abandoned(folder.path, patience_s=0)


def test_the_next_start_removes_what_was_left_behind(left_behind, temporary):
    """Both were killed, the replay and its predictor."""
    young = PrivateFolder()
    assert left_behind.is_dir()  # it might be one that is being made
    aged(left_behind)
    later = PrivateFolder()
    assert set(temporary.iterdir()) == {young.path, later.path}
    young.remove()
    later.remove()


def test_what_is_not_ours_is_left_alone(temporary):
    other, link = temporary / "pcgan-windows-1", temporary / f"{PREFIX}link"
    other.mkdir()
    aged(other)
    link.symlink_to(other)
    os.utime(link, (0, 0), follow_symlinks=False)
    PrivateFolder().remove()
    assert other.is_dir()
