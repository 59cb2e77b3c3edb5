import os
import zipfile
from pathlib import Path

import fsspec
import pytest

from replay.errors import LogError
from replay.log_source import LogSource, find_logs, identity, local_copy, unique_names


@pytest.fixture
def corpus(tmp_path) -> Path:
    """A folder of drives, some of the same name, an output among them."""
    for name in ("b.mcap", "a.mcap", "a.pcgan.mcap", "notes.txt", "north/a.mcap", "south/x/c.mcap", "south/B.mcap"):
        path = tmp_path / "drives" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return tmp_path / "drives"


@pytest.fixture
def memory():
    """fsspec's file system in memory, with two drives, empty again afterwards."""
    filesystem = fsspec.filesystem("memory")
    filesystem.pipe({"/bucket/day 1/a.mcap": b"first", "/bucket/day 2/a.mcap": b"second"})
    yield filesystem
    filesystem.store.clear()
    filesystem.pseudo_dirs[:] = [""]


@pytest.fixture
def zipped(tmp_path) -> Path:
    path = tmp_path / "drives.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.mcap", b"zipped")
        archive.writestr("deep/a.mcap", b"deeper")
        archive.writestr("a.txt", b"")
    return path


def found(patterns, base=Path()) -> list[tuple[str, str]]:
    return [(source.url, source.name) for source in find_logs(patterns, base)]


# --- here ----------------------------------------------------------------------------------------------------------


def test_paths_globs_and_folders(corpus):
    def names(*patterns: str) -> list[str]:
        return [str(Path(url).relative_to(corpus)) for url, _ in found(patterns, corpus)]

    assert names("b.mcap") == ["b.mcap"]
    assert names("*.mcap") == ["a.mcap", "b.mcap"]  # not our own output
    assert names("*.pcgan.mcap") == ["a.pcgan.mcap"]  # unless it is what was asked for
    assert names("a.pcgan.mcap") == ["a.pcgan.mcap"]
    assert names(".") == ["a.mcap", "b.mcap"]
    assert names("**/*.mcap") == ["a.mcap", "b.mcap", "north/a.mcap", "south/B.mcap", "south/x/c.mcap"]
    assert names("north", "south/*/?.mcap") == ["north/a.mcap", "south/x/c.mcap"]
    assert names(str(corpus / "n*th" / "*")) == ["north/a.mcap"]


def test_a_name_that_looks_like_a_glob_is_a_name(corpus):
    (corpus / "drive[1].mcap").touch()
    (corpus / "x*").mkdir()
    (corpus / "x*" / "d.mcap").touch()
    assert [name for _, name in found(["drive[1].mcap"], corpus)] == ["drive[1]".replace("[", "_").replace("]", "_")]
    assert [name for _, name in found(["*.mcap"], corpus / "x*")] == ["d"]


def test_each_log_comes_once_however_it_is_named(corpus):
    (corpus / "zz.mcap").symlink_to(corpus / "b.mcap")
    patterns = ["b.mcap", "*.mcap", str(corpus / "b.mcap"), "north/../b.mcap", f"file://{corpus}/b.mcap"]
    assert [name for _, name in found(patterns, corpus)] == ["a", "b"]


def test_a_file_url_is_a_path(corpus):
    assert found([f"file://{corpus}/*.mcap"]) == [(str(corpus / "a.mcap"), "a"), (str(corpus / "b.mcap"), "b")]
    with local_copy(find_logs([f"local://{corpus}/a.mcap"])[0]) as path:
        assert path == corpus / "a.mcap"


@pytest.mark.parametrize(
    ("pattern", "said"),
    [
        ("none.mcap", "none.mcap is not there"),
        ("none*.mcap", r"none\*.mcap finds no file"),
        ("empty", "empty is a folder without \\*.mcap"),
        ("outputs", r"outputs is a folder without \*.mcap but 1 outputs of pcgan replay"),
        ("memory://none/a.mcap", "memory://none/a.mcap is not there"),
        ("memory://none/*.mcap", r"memory://none/\*.mcap finds no file"),
        ("memory://none/", "memory://none/ is a folder without"),
        ("memory://**a/b", r"memory://\*\*a/b cannot be read: .*"),
        ("s4://bucket/a.mcap", "s4://bucket/a.mcap cannot be read: Protocol not known: s4"),
        ("zip://a.mcap::none.zip", "zip://a.mcap::none.zip is not there"),
        ("zip://a.mcap::no.zip", "zip://a.mcap::no.zip cannot be read: .*zip.*"),
    ],
)
def test_a_pattern_that_finds_nothing_is_an_error_of_one_line(tmp_path, monkeypatch, pattern, said):
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("outputs").mkdir()
    Path("outputs/a.pcgan.mcap").touch()
    Path("no.zip").write_bytes(b"no zip at all")
    with pytest.raises(LogError, match=said) as error:
        find_logs([pattern])
    assert "\n" not in str(error.value)


def test_a_missing_package_is_named(monkeypatch):
    def missing(_):
        raise ImportError("Install s3fs to access S3") from ModuleNotFoundError("No module named 's3fs'", name="s3fs")

    monkeypatch.setattr(fsspec.core, "url_to_fs", missing)
    with pytest.raises(LogError, match=r"^s3:// needs the package s3fs: pip install s3fs$"):
        find_logs(["s3://bucket/*.mcap"])


# --- elsewhere -----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("memory")
def test_urls_with_globs_and_folders():
    both = [("memory:///bucket/day 1/a.mcap", "day 1-a"), ("memory:///bucket/day 2/a.mcap", "day 2-a")]
    assert found(["memory://bucket/*/*.mcap"]) == both
    assert found(["memory://bucket/**"]) == both
    assert found(["memory://bucket/day 1"]) == found(["memory://bucket/day 1/"]) == [(both[0][0], "a")]
    assert found(["memory:///bucket/day 1/a.mcap"]) == [(both[0][0], "a")]
    assert find_logs(["memory://bucket/day 1"])[0].path is None


def test_logs_inside_an_archive(zipped):
    inside, deep = f"zip://a.mcap::{zipped}", f"zip://deep/a.mcap::{zipped}"
    assert found([f"zip://*.mcap::{zipped}"]) == [(inside, "a")]
    assert found([f"zip://**/*.mcap::{zipped}"]) == [(inside, "drives.zip-a"), (deep, "deep-a")]
    assert found([f"zip://deep::{zipped}"]) == [(deep, "a")]
    assert found([f"zip://::{zipped}"]) == [(inside, "a")]
    for url, data in ((inside, b"zipped"), (deep, b"deeper")):
        with local_copy(LogSource(url, "a")) as path:
            assert path.read_bytes() == data


@pytest.mark.usefixtures("memory")
def test_a_cache_before_a_url_stays_there():
    assert [url for url, _ in found(["simplecache::memory://bucket/day 1/*"])] == [
        "simplecache::memory:///bucket/day 1/a.mcap"
    ]


@pytest.mark.usefixtures("memory")
def test_a_copy_has_the_logs_name_and_goes_when_it_was_used(tmp_path):
    source = find_logs(["memory://bucket/day 1"])[0]
    with local_copy(source, tmp_path) as path:
        assert (path.name, path.read_bytes()) == ("a.mcap", b"first")
        assert tmp_path in path.parents
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(KeyError), local_copy(source, tmp_path):
        raise KeyError
    assert list(tmp_path.iterdir()) == []
    with local_copy(source) as path:
        assert path.read_bytes() == b"first"
    assert not path.exists()


def test_a_copy_that_is_not_whole_is_an_error(memory, tmp_path, monkeypatch):
    source = find_logs(["memory://bucket/day 1"])[0]
    info = {"name": "/bucket/day 1/a.mcap", "size": 7, "type": "file"}
    monkeypatch.setattr(memory, "info", lambda *_: info)
    with pytest.raises(LogError, match=r"came with 5 bytes of 7"), local_copy(source, tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_connection_that_breaks_is_an_error_of_one_line(memory, tmp_path, monkeypatch):
    class Strange(Exception):
        pass

    def broken(*_):
        raise Strange("An error\noccurred (NoSuchKey)")

    source = find_logs(["memory://bucket/day 1"])[0]
    monkeypatch.setattr(memory, "open", broken)
    with (
        pytest.raises(LogError, match=r"a.mcap cannot be read: An error occurred \(NoSuchKey\)$"),
        local_copy(source, tmp_path),
    ):
        pass
    with pytest.raises(LogError, match="is not there"), local_copy(LogSource("memory://none", "none")):
        pass


# --- identity and names --------------------------------------------------------------------------------------------


def test_another_identity_wherever_the_log_is_another(corpus, memory, zipped):
    local = find_logs([str(corpus / "a.mcap")])[0]
    before = identity(local)
    assert identity(local) == before
    os.utime(corpus / "a.mcap", ns=(1, 1))
    touched = identity(local)
    (corpus / "a.mcap").write_bytes(b"longer than before")
    os.utime(corpus / "a.mcap", ns=(1, 1))
    assert len({before, touched, identity(local)}) == 3
    url = "memory:///bucket/day 1/a.mcap"
    before = identity(LogSource(url, "a"))
    assert identity(LogSource(url, "a")) == before
    memory.pipe(url, b"other")  # of the same size
    assert identity(LogSource(url, "a")) != before
    inside, deep = (identity(LogSource(f"zip://{name}::{zipped}", "a")) for name in ("a.mcap", "deep/a.mcap"))
    assert inside != deep
    with pytest.raises(LogError, match="is not there"):
        identity(LogSource(str(corpus / "none.mcap"), "none"))


@pytest.mark.parametrize(
    ("urls", "names"),
    [
        (["/d/a.mcap", "/d/b.MCAP", "/d/c.bag.mcap", "/d/d"], ["a", "b", "c.bag", "d"]),
        (["/x/a.mcap", "/y/a.mcap", "/y/b.mcap"], ["x-a", "y-a", "b"]),
        (["/p/x/a.mcap", "/q/x/a.mcap", "/q/y/a.mcap"], ["p-x-a", "q-x-a", "y-a"]),
        (["/x/a.mcap", "/x/A.mcap"], ["x-a-1", "x-A-2"]),  # some disks take them for one
        (["/x/a.mcap", "/y/a.mcap", "/z/x-a.mcap"], ["x-a", "y-a", "z-x-a"]),
        (["s3://b/x/a.mcap", "https://host:80/x/a.mcap?key=1/2"], ["b-x-a", "host_80-x-a"]),
        (["https://host/my%20drive.mcap", "s3://b/tag:1.mcap"], ["my drive", "tag_1"]),
        (["/a-b/c.mcap", "/a/b-c.mcap"], ["c", "b-c"]),
        ([], []),
    ],
)
def test_names_are_short_and_never_the_same(urls, names):
    assert unique_names(urls) == names
    assert len({name.casefold() for name in names}) == len(names)
