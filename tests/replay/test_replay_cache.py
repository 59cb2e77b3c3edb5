"""Replays done once, and found again by whoever asks for the same."""

import os
import shutil
import threading
import warnings
from pathlib import Path

import pytest

from replay import LogError, OutputError, PredictorError, ReplayError, ReplaySettings, replay_cache, replay_log
from replay.log_source import LogSource
from replay.replay_cache import Asked, ReplayCache, first_file, read_settings


@pytest.fixture
def log(short_drive, tmp_path) -> Path:
    """A copy of the short drive that a test may change."""
    return shutil.copy(short_drive, tmp_path / "short.mcap")


@pytest.fixture
def asked(log, model):
    """Makes the question for a replay of the short drive's first second."""

    def ask(settings: dict | None = None, **options) -> Asked:
        whole = ReplaySettings.model_validate({"duration_s": 1.0, **(settings or {})})
        return Asked((LogSource(str(log), "short"),), whole, **{"model": model, **options})

    return ask


# --- once only -----------------------------------------------------------------------------------------------------


def test_a_replay_is_done_once_by_all_who_share_the_folder(asked, tmp_path):
    cache, other = ReplayCache(tmp_path / "replays"), ReplayCache(tmp_path / "replays")
    first = cache.get(asked(), "short")
    assert cache.get(asked(), "short") is first
    again = other.get(asked(), "another name")
    assert again.output == first.output
    assert again.name == "another name"
    assert (cache.done, cache.found, other.done, other.found) == (1, 1, 0, 1)
    assert cache.wall_s > 0 == other.wall_s


def test_whoever_comes_while_it_is_being_done_waits_for_it(asked, tmp_path, monkeypatch):
    caches = [ReplayCache(tmp_path / "replays") for _ in range(2)]
    done, begun = [], threading.Event()
    usual = replay_cache.run_job

    def slow(*arguments, **options):
        begun.set()
        other.join(0.2)  # it must not come to an end
        done.append(other.is_alive())
        return usual(*arguments, **options)

    def wait_and_get():
        begun.wait(10)
        caches[1].get(asked(), "short")

    monkeypatch.setattr(replay_cache, "run_job", slow)
    other = threading.Thread(target=wait_and_get)
    other.start()
    caches[0].get(asked(), "short")
    other.join(10)
    assert done == [True]
    assert (caches[0].done, caches[1].done, caches[1].found) == (1, 0, 1)


def test_what_was_interrupted_is_done_anew_and_leaves_nothing(asked, tmp_path, monkeypatch):
    cache = ReplayCache(tmp_path / "replays")
    with monkeypatch.context() as patched:
        patched.setattr(replay_cache, "write_truth", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            cache.get(asked(), "short")
    assert [path.suffix for path in (tmp_path / "replays").iterdir()] == [".lock"]
    assert cache.get(asked(), "short").summary["complete"] is True


def test_a_folder_that_cannot_be_written_is_named(asked, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"no replay can be kept in .*file: "):
        ReplayCache(tmp_path / "file").get(asked(), "short")
    cache = ReplayCache(tmp_path / "replays")
    (tmp_path / "replays").mkdir()
    (tmp_path / "replays" / asked().key).touch()  # in the way of the finished replay
    with pytest.raises(OutputError, match=r"no replay can be kept in .*replays: "):
        cache.get(asked(), "short")


def test_only_the_latest_stay_in_memory(asked, tmp_path, monkeypatch):
    monkeypatch.setattr(replay_cache, "KEPT", 1)
    cache = ReplayCache(tmp_path / "replays")
    first = cache.get(asked(), "a")
    assert cache.get(asked(), "b").output == first.output
    again = cache.get(asked(), "a")
    assert again is not first
    assert again.output == first.output
    assert cache.done == 1


def test_what_decides_the_outcome_decides_what_is_the_same(asked, log, model, tmp_path):
    usual = asked()
    assert usual.key == asked().key
    others = [asked({"duration_s": 0.9}), asked(model=None), asked(model="vehicle_10hz"), asked(salvage=True)]
    assert len({usual.key, *(other.key for other in others)}) == 5
    before = usual.key
    os.utime(log, ns=(0, 0))
    assert usual.key != before
    weights = Path(shutil.copy(model, tmp_path / "mine.safetensors"))
    before = asked(model=weights).key
    os.utime(weights, ns=(0, 0))
    assert asked(model=weights).key != before


def test_warnings_are_not_errors_in_a_replay(asked, tmp_path, monkeypatch):
    """As on the command line: what a test run does with warnings changes no result."""
    usual = replay_cache.run_job

    def warning(*arguments, **options):
        warnings.warn("numbers are running out", RuntimeWarning, stacklevel=1)
        return usual(*arguments, **options)

    monkeypatch.setattr(replay_cache, "run_job", warning)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("error")
        ReplayCache(tmp_path / "replays").get(asked(), "short")
    assert [str(each.message) for each in seen] == ["numbers are running out"]


# --- replay_log ----------------------------------------------------------------------------------------------------


def test_replay_log_needs_nothing_but_a_recording(log, model, tmp_path):
    settings = {"duration_s": 1.0}
    replayed = replay_log(log, model=model, settings=settings)
    assert replay_log(str(log), model=model, settings=settings) is replayed
    assert replayed.name == "short"
    assert not replayed.output.is_relative_to(tmp_path)
    kept = replay_log(log, model=model, settings=settings, name="kept", folder=tmp_path / "replays")
    assert kept.name == "short-kept"
    assert kept.output.is_relative_to(tmp_path / "replays")
    assert kept.output.read_bytes() == replayed.output.read_bytes()


def test_several_files_are_one_recording(log, model, edit_log, tmp_path):
    """The first names it, whatever the order of the alphabet."""
    parts = [
        edit_log(
            log, lambda messages, k=k: [each for each in messages if each[0].startswith("/gmsl") == k], f"{k}.mcap"
        )
        for k in (True, False)
    ]
    options = {"model": model, "settings": {"duration_s": 1.0}, "folder": tmp_path / "replays"}
    whole, split = replay_log(log, **options), replay_log(parts, **options)
    assert split.name == "True"
    assert split.logs == tuple(map(str, parts))
    assert [frame.stamp_ns for frame in split.tracks] == [frame.stamp_ns for frame in whole.tracks]
    assert split.summary["tracks"] == whole.summary["tracks"]


def test_a_url_is_fetched_once(log, model, tmp_path):
    options = {"model": model, "settings": {"duration_s": 1.0}, "folder": tmp_path / "replays"}
    import fsspec

    with fsspec.open("memory://drives/short.mcap", "wb") as stream:
        stream.write(log.read_bytes())
    replayed = replay_log("memory://drives/*.mcap", **options)
    assert (replayed.name, replayed.logs) == ("short", ("memory:///drives/short.mcap",))
    assert replayed.output.read_bytes() == replay_log(log, **options).output.read_bytes()
    assert len(replay_log("memory://drives/*.mcap", **options).truth) == len(replayed.tracks)


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"logs": "none.mcap"}, LogError, "none.mcap is not there"),
        ({"model": "none"}, PredictorError, "no checkpoint none; shipped models are"),
        ({"settings": {"start": 3}}, ReplayError, "settings: start: there is nothing of this name; did you mean"),
        ({"settings": {"start_s": -1}}, ReplayError, "settings: start_s: Input should be greater than or equal to 0"),
        ({"settings": "none.toml"}, ReplayError, "none.toml cannot be read: No such file"),
        ({"settings": {"start_s": 99}}, LogError, "nothing to replay from 99 s"),
    ],
)
def test_what_cannot_be_replayed_is_said_in_a_line(log, tmp_path, options, error, said):
    with pytest.raises(error) as raised:
        replay_log(**{"logs": log, "folder": tmp_path / "replays", **options})
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


# --- settings ------------------------------------------------------------------------------------------------------


def test_settings_come_whole_as_a_dict_or_as_a_profile(tmp_path):
    start = ReplaySettings(start_s=2.0)
    (tmp_path / "late.toml").write_text("start_s = 2.0\n")
    (tmp_path / "late.json").write_text(start.model_dump_json())
    for given in (start, {"start_s": 2}, "late.toml", Path("late.json"), tmp_path / "late.toml"):
        assert read_settings(given, tmp_path / "none", tmp_path) == start
    assert read_settings(None) == ReplaySettings()


@pytest.mark.parametrize(("name", "text"), [("a.toml", "start_s ="), ("a.json", "{"), ("a.json", "[1]")])
def test_a_profile_that_is_none_is_named(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(ReplayError, match=name):
        read_settings(name, tmp_path)


def test_the_first_folder_that_has_a_file_gives_it(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    (tmp_path / "b" / "it").touch()
    folders = (tmp_path / "a", tmp_path / "b")
    assert first_file("it", folders) == tmp_path / "b" / "it"
    (tmp_path / "a" / "it").touch()
    assert first_file("it", folders) == tmp_path / "a" / "it"
    assert first_file("other", folders) is None
