"""Faults around files: full disks, places that cannot be written, an output that is an input, two replays into one
output, and recordings that change under a replay. Never half a file under a final name, never an older one lost.
"""

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from replay import LogError, OutputError, PredictorChoice, Replay, ReplaySettings, record
from replay.cli_common import write_json
from replay.log_reader import LogReader, checksum
from replay.log_writer import LogWriter
from replay.record import refuse_overwriting

OLDER = b"an older output"


def run(drive, model, **options):
    return Replay([drive], options.pop("settings", None), PredictorChoice("inline", model), **options)


@pytest.fixture
def mounted(tmp_path):
    """Mounts a small file system of its own; skips where that is not allowed."""
    folders = []

    def mount(options):
        folder = tmp_path / f"mount{len(folders)}"
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        if shutil.which("mount") is None or subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("nothing can be mounted here")
        folders.append(folder)
        return folder

    yield mount
    for folder in folders:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def failing(monkeypatch, owner, name, code=errno.ENOSPC):
    """Makes a function of the system fail."""

    def fail(*_, **__):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(owner, name, fail)


# --- full disks -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_disk_that_is_full_at_the_very_end_leaves_the_older_output(short_drive, model, tmp_path, monkeypatch, step):
    """When what is written reaches the disk, and when it is to get its name."""
    (tmp_path / "out.mcap").write_bytes(OLDER)
    failing(monkeypatch, *{"fsync": (os, "fsync"), "replace": (Path, "replace")}[step])
    text = r"^.*out\.mcap could not be finished: No space left on device$"
    with pytest.raises(OutputError, match=text):
        record(run(short_drive, model, settings=ReplaySettings(duration_s=0.5)), tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").read_bytes() == OLDER
    assert list(LogReader([tmp_path / "out.mcap.part"]).messages())  # all of it is there


@pytest.mark.parametrize("free_kib", [1, 100, 200, 300, 340])
def test_a_disk_that_is_really_full(mounted, short_drive, model, recorded, pcgan, free_kib):
    """Full at the first byte, on the way, and when the file is closed."""
    disk = mounted("size=1m")
    (disk / "ballast").write_bytes(bytes((1 << 20) - 4096 * (2 + free_kib // 4)))
    (disk / "out.mcap").write_bytes(OLDER)
    assert recorded.path.stat().st_size > 350_000
    outcome = pcgan("replay", short_drive, "-o", disk / "out.mcap", "--predictor", "inline", "--model", model)
    assert (outcome.code, outcome.out) == (2, "")
    (line,) = outcome.err.splitlines()
    assert line.startswith(f"pcgan: {disk / 'out.mcap'} c")
    assert line.endswith("No space left on device")
    assert (disk / "out.mcap").read_bytes() == OLDER
    assert {path.name for path in disk.iterdir()} <= {"ballast", "out.mcap", "out.mcap.part"}


@pytest.mark.parametrize("option", ["--json", "--picture"])
def test_a_full_disk_beside_the_output(mounted, short_drive, model, tmp_path, pcgan, option):
    if option == "--picture":
        pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    disk = mounted("size=16k")
    (disk / "beside").write_bytes(OLDER)
    with contextlib.suppress(OSError):
        (disk / "ballast").write_bytes(bytes(1 << 20))
    outcome = pcgan(
        "replay", short_drive, "-o", tmp_path / "out.mcap", "--duration", 1, option, disk / "beside",
        "--predictor", "inline", "--model", model,
    )  # fmt: skip
    assert outcome.code == 2
    (line,) = outcome.err.splitlines()
    assert "beside" in line
    assert "No space left on device" in line
    assert {path.name for path in disk.iterdir()} == {"ballast", "beside"}
    assert (disk / "beside").read_bytes() == OLDER
    assert list(LogReader([tmp_path / "out.mcap"]).messages())


def test_a_rerun_recording_whose_end_does_not_fit_gets_no_name(short_drive, model, tmp_path, monkeypatch):
    """rerun only logs that, from another thread."""
    rr = pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from replay.rerun_view import RerunView, ViewError

    disconnect = rr.RecordingStream.disconnect

    def cut(recording):
        disconnect(recording)
        os.truncate(tmp_path / "out.rrd.part", (tmp_path / "out.rrd.part").stat().st_size - 30)

    monkeypatch.setattr(rr.RecordingStream, "disconnect", cut)
    (tmp_path / "out.rrd").write_bytes(OLDER)
    with pytest.raises(ViewError, match=r"could not be completed: .*out\.rrd\.part lacks its end; is the disk full\?$"):
        record(
            run(short_drive, model, settings=ReplaySettings(duration_s=0.5)),
            view=RerunView.to_file(tmp_path / "out.rrd"),
        )
    assert (tmp_path / "out.rrd").read_bytes() == OLDER


_LIMITED = """
import resource, sys
limit = int(sys.argv.pop(1))
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
from replay.cli import main
main()
"""


@pytest.mark.slow
def test_a_full_disk_is_one_line_for_a_rerun_recording_too(short_drive, model, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    arguments = ("--predictor", "inline", "--model", model, "--duration", "2")

    def replay(rrd, limit):
        command = [sys.executable, "-c", _LIMITED, str(limit), "replay", short_drive, "-o", tmp_path / "o.mcap"]
        command += ["--rrd", rrd, *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    assert replay(tmp_path / "whole.rrd", 1 << 30).returncode == 0
    whole_bytes = (tmp_path / "whole.rrd").stat().st_size
    assert whole_bytes > (tmp_path / "o.mcap").stat().st_size  # so the limit is met by the .rrd alone
    (tmp_path / "out.rrd").write_bytes(OLDER)
    for limit in (whole_bytes * 9 // 10, whole_bytes - 1500):  # on the way, and where it ends; sizes vary a little
        ended = replay(tmp_path / "out.rrd", limit)
        assert (ended.returncode, len(ended.stderr.splitlines())) == (2, 1), ended.stderr
        assert ended.stderr.startswith("pcgan: ")
        assert (tmp_path / "out.rrd").read_bytes() == OLDER


# --- places that cannot be written ------------------------------------------------------------------------------------


@pytest.fixture
def read_only(mounted, tmp_path):
    """A folder in which nothing can be written, and what the system says then."""
    folder = tmp_path / "read-only"
    folder.mkdir(mode=0o555)
    if os.access(folder, os.W_OK):  # root may write in every folder, but not on every mount
        return mounted("ro,size=1m"), "Read-only file system"
    return folder, "Permission denied"


def test_a_folder_that_is_read_only_is_one_line_before_anything_is_read(read_only, short_drive, model, pcgan):
    folder, said = read_only
    outcome = pcgan("replay", short_drive, "-o", folder / "out.mcap", "--predictor", "inline", "--model", model)
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err == f"pcgan: {folder / 'out.mcap'} cannot be written: {said}\n"
    assert list(folder.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no devices here")
def test_a_device_is_no_output(short_drive, model):
    """A file would take its place: root could lose /dev/null."""
    with pytest.raises(OutputError, match=r"^/dev/null cannot be written: Not a regular file$"):
        record(run(short_drive, model), Path("/dev/null"))
    assert not Path("/dev/null").is_file()


# --- an output that is an input ---------------------------------------------------------------------------------------


@pytest.fixture
def many_names(short_drive, tmp_path):
    """A recording and its links, in a folder of their own."""
    (tmp_path / "sub").mkdir()
    shutil.copy(short_drive, tmp_path / "drive.mcap")
    shutil.copy(short_drive, tmp_path / "second.mcap")
    os.link(tmp_path / "drive.mcap", tmp_path / "hard.mcap")
    os.link(tmp_path / "drive.mcap", tmp_path / "out.mcap.part")
    (tmp_path / "symbolic.mcap").symlink_to("hard.mcap")
    (tmp_path / "folder").symlink_to(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "output",
    ["hard", "symbolic", "sub/../drive", "folder/drive", "folder/hard", "second", "out"],
)
def test_no_name_of_an_input_is_an_output(many_names, model, output):
    """Nor is a file whose part is a name of one: out.mcap.part is."""
    before = {path.name: checksum(path) for path in many_names.glob("*.mcap*")}
    replaying = Replay([many_names / "drive.mcap", many_names / "second.mcap"], None, PredictorChoice("inline", model))
    with pytest.raises(OutputError, match="is the recording itself, which is never overwritten; choose another output"):
        record(replaying, many_names / f"{output}.mcap")
    assert {path.name: checksum(path) for path in many_names.glob("*.mcap*")} == before


@pytest.mark.parametrize("others", [("out.mcap",), ("out.mcap.part",), ("sub/../out.mcap",), ("a", "a.part")])
def test_two_outputs_are_never_one_file(tmp_path, others):
    """Nor one of them the part of another, which would be renamed away under its writer."""
    (tmp_path / "sub").mkdir()
    with pytest.raises(
        OutputError, match="would be written twice, the second time over the first; choose another name"
    ):
        refuse_overwriting([], tmp_path / "out.mcap", *(tmp_path / other for other in others))


# --- two replays into one output --------------------------------------------------------------------------------------


def test_of_two_replays_into_one_output_the_second_is_refused(short_drive, model, recorded, tmp_path):
    output, refused = tmp_path / "out.mcap", []

    def start_another(frame):
        if frame.tracks.sequence == 5:
            with pytest.raises(OutputError, match=r"out\.mcap\.part is being written by another process; wait until"):
                record(run(short_drive, model), output)
            refused.append(frame)

    record(run(short_drive, model), output, on_frame=start_another)
    assert len(refused) == 1
    assert output.read_bytes() == recorded.path.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]
    record(run(short_drive, model), output)  # once it has ended, the next may
    assert output.read_bytes() == recorded.path.read_bytes()


@pytest.mark.slow
def test_of_two_commands_with_one_output_the_second_is_refused(start_pcgan, short_drive, model, recorded, tmp_path):
    """The first is held in the middle of its drive, so that it is there however long the second takes to start."""
    output, part = tmp_path / "out.mcap", tmp_path / "out.mcap.part"
    arguments = ("replay", short_drive, "-o", output, "--predictor", "inline", "--model", model)
    first = start_pcgan(*arguments, "--rate", 1)
    deadline = time.monotonic() + 60
    while not part.exists():
        assert first.poll() is None, first.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(0.5)
    first.send_signal(signal.SIGSTOP)
    second = start_pcgan(*arguments)
    refusal = f"{part} is being written by another process; wait until it has ended, or choose another output"
    out, err = second.communicate(timeout=60)
    assert (second.returncode, out, err) == (2, "", f"pcgan: {refusal}\n")
    assert [path.name for path in tmp_path.iterdir()] == [part.name]
    first.send_signal(signal.SIGCONT)
    _, err = first.communicate(timeout=60)
    assert (first.returncode, err) == (0, "")
    assert [path.name for path in tmp_path.iterdir()] == [output.name]
    assert output.read_bytes() == recorded.path.read_bytes()


def test_of_two_rerun_recordings_into_one_file_the_second_is_refused(tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from replay.rerun_view import RerunView

    with RerunView.to_file(tmp_path / "out.rrd"), pytest.raises(OutputError, match="written by another process"):
        RerunView.to_file(tmp_path / "out.rrd")
    RerunView.to_file(tmp_path / "out.rrd").close()


def test_a_summary_that_another_process_writes_is_refused(tmp_path):
    with LogWriter(tmp_path / "out"), pytest.raises(OutputError, match="written by another process"):
        write_json(tmp_path / "out", {})


# --- recordings that change under a replay ----------------------------------------------------------------------------

CHANGES = {
    "cut short": lambda path: os.truncate(path, path.stat().st_size // 3),
    "emptied": lambda path: os.truncate(path, 0),
    "deleted": lambda path: path.unlink(),
    "replaced": lambda path: (path.rename(path.with_name("old")), shutil.copy(path.with_name("old"), path)),
    "written over": lambda path: path.write_bytes(path.read_bytes()[::-1]),
    "grown": lambda path: path.write_bytes(path.read_bytes() + b"more"),
}


@pytest.mark.parametrize("salvage", [False, True])
@pytest.mark.parametrize("change", CHANGES)
def test_a_recording_that_changes_is_one_line_and_the_output_a_part(
    edit_log, short_drive, model, tmp_path, change, salvage
):
    """One that grows while it is salvaged is used up to where it was, and that is told."""
    path = edit_log(short_drive, lambda log: log, "mine.mcap", chunk_size=20_000)
    output = tmp_path / "out.mcap"
    output.write_bytes(OLDER)

    def disturb(frame):
        if frame.tracks.sequence == 5:
            CHANGES[change](path)

    replaying = run(path, model, salvage=salvage)
    if salvage and change == "grown":
        summary = record(replaying, output, on_frame=disturb)
        assert summary.salvage_losses == ["mine.mcap: it grew while it was read; what came later is left out"]
        assert len(list(LogReader([output]).messages())) == 4 * summary.frames
        return
    with pytest.raises(
        LogError, match=r"mine\.mcap (is gone|is damaged|cannot be read|has been replaced or changed) ?"
    ):
        record(replaying, output, on_frame=disturb)
    assert output.read_bytes() == OLDER


_CUT_SHORT = """
import os, sys
from pathlib import Path
from replay.errors import LogError
from replay.log_reader import LogReader

path = Path(sys.argv[1])
messages = LogReader([path], salvage=True).messages()
for _ in range(3):
    next(messages)
os.truncate(path, int(sys.argv[2]))
try:
    print(len(list(messages)))
except LogError as error:
    print(error)
"""


@pytest.mark.parametrize("left", [0, 10, 5000])
def test_a_file_cut_short_while_it_is_salvaged_ends_no_process(edit_log, short_drive, left):
    """In a memory map the next look behind the end is SIGBUS."""
    path = edit_log(short_drive, lambda log: log, "mine.mcap", chunk_size=20_000)
    command = [sys.executable, "-c", _CUT_SHORT, path, str(left)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    changed = f"{path} has been replaced or changed while it was read; nothing that came of it can be relied on"
    assert ended.stdout.startswith((changed, f"{path} cannot be read: it was cut short while it was read"))


def test_what_a_replay_of_a_growing_recording_holds_is_what_was_there(edit_log, short_drive, model, tmp_path):
    """A recording that is still being made: the part of the file that was there gives the same frames alone."""
    path = edit_log(short_drive, lambda log: log, "mine.mcap", chunk_size=20_000)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    record(run(path, model, salvage=True), tmp_path / "alone.mcap")

    def grow(frame):
        if frame.tracks.sequence == 3:
            with path.open("ab") as stream:
                stream.write(data[len(data) // 2 :])

    record(run(path, model, salvage=True), tmp_path / "grown.mcap", on_frame=grow)
    alone, grown = (
        [(m.topic, m.log_time_ns, m.data) for m in LogReader([tmp_path / name]).messages()]
        for name in ("alone.mcap", "grown.mcap")
    )
    assert alone == grown
    assert len(alone) > 20
