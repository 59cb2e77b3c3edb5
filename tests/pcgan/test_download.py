"""Downloads against a server on this machine: resumed, checked, refused, and not needed a second time."""

import gzip
import hashlib
import http.server
import threading
from pathlib import Path

import pytest

from pcgan import clips, download
from pcgan.download import (
    AbsentFile,
    Content,
    DataFile,
    DataSet,
    DownloadError,
    find,
    get,
    locate,
    six_frame_annotation,
)
from replay.cli_data import app

COMMIT = "c0ffee0"
PEDESTRIANS = b"id,frame,label,x_est,y_est,vx_est,vy_est\n" + b"".join(
    f"0,{k},ped,{k / 7},1.0,0.5,0.0\n".encode() for k in range(9000)
)  # several chunks
VEHICLES = b"id,frame,label,x_est,y_est,psi_est,vel_est\n0,0,veh,1.0,1.0,0.1,3.0\n"


class Server(http.server.ThreadingHTTPServer):
    """Serves `files` by path; keeps the (path, Range) of each request."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.requests: list[tuple[str, str | None]] = []
        self.ranges = True  # whether it knows Range
        self.lengths = True  # whether it says how long an answer is
        self.statuses: list[int] = []  # the next answers are these errors
        self.cut_after: list[int] = []  # the next answers end after so many bytes
        self.first_byte_lies = 0  # 206, but from another byte on

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_address[1]}"

    @property
    def asked(self):
        return [wanted for _, wanted in self.requests]


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        server = self.server
        wanted = self.headers["Range"]
        server.requests.append((self.path, wanted))
        if server.statuses:
            self.send_error(server.statuses.pop(0))
            return
        if self.path not in server.files:
            self.send_error(404)
            return
        content, first = server.files[self.path], 0
        if wanted and server.ranges:
            first = int(wanted.removeprefix("bytes=").removesuffix("-"))
            if first >= len(content):
                self.send_error(416)
                return
            first += server.first_byte_lies
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{len(content) - 1}/{len(content)}")
        else:
            self.send_response(200)
        body = content[first:]
        if server.lengths:
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[: server.cut_after.pop(0)] if server.cut_after else body)

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with Server() as running:
        monkeypatch.setenv("PCGAN_DATA_URL", running.url)
        thread = threading.Thread(target=running.serve_forever, args=(0.01,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


@pytest.fixture
def alone(tmp_path, monkeypatch):
    """A machine without any data; returns its cache folder."""
    monkeypatch.delenv("PCGAN_DATA", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(clips, "__file__", str(tmp_path / "project" / "pcgan" / "clips.py"))
    (tmp_path / "cwd").mkdir()
    monkeypatch.chdir(tmp_path / "cwd")
    return tmp_path / "cache" / "pcgan" / "data"


@pytest.fixture
def dataset(server):
    """A data set of two files in the layout of DUT, which the server has."""
    return make_dataset(
        server, {"walk_01_traj_ped_filtered.csv": PEDESTRIANS, "walk_01_traj_veh_filtered.csv": VEHICLES}
    )


def content_of(data: bytes) -> Content:
    return Content(len(data), hashlib.sha256(data).hexdigest())


def make_dataset(server, files, absent=()):
    entries = []
    for name, data in files.items():
        path = f"data/{name}"
        server.files[f"/owner/name/{COMMIT}/{path}"] = data
        local = f"dut/trajectories_filtered/{name}"
        entries.append(DataFile(local, content_of(data), "owner/name", COMMIT, path, content_of(data)))
    return DataSet("dut", "made", "none", "nobody", tuple(entries), tuple(absent))


def fetch(dataset, folder, **options):
    return get(dataset, folder, backoff_s=0.001, **options)


def names(folder):
    return sorted(path.name for path in Path(folder).rglob("*") if path.is_file())


def first_path(dataset, folder):
    return folder / dataset.files[0].local


def part_of(dataset, folder, data=b""):
    """The part of the first file, with a beginning in it if wanted."""
    target = first_path(dataset, folder)
    part = target.with_name(f"{target.name}.part")
    if data:
        part.parent.mkdir(parents=True)
        part.write_bytes(data)
    return part


# --- whole downloads -------------------------------------------------------------------------------------------------


def test_get_brings_every_file_where_clips_are_read(server, dataset, alone):
    progress = []
    fetched = fetch(dataset, None, progress=lambda done, total: progress.append((done, total)))
    assert fetched.folder == alone == clips.data_folder()
    assert (fetched.downloaded, fetched.downloaded_bytes) == (2, len(PEDESTRIANS) + len(VEHICLES))
    assert first_path(dataset, alone).read_bytes() == PEDESTRIANS
    assert clips.clip_names("dut") == ("dut/walk_01",)
    assert len(clips.load_clip("dut/walk_01").vehicles) == 1
    assert names(alone) == ["walk_01_traj_ped_filtered.csv", "walk_01_traj_veh_filtered.csv"]
    assert [done for done, _ in progress] == sorted(done for done, _ in progress)
    assert progress[-1] == (len(PEDESTRIANS) + len(VEHICLES),) * 2
    assert [path for path, _ in server.requests] == [
        f"/owner/name/{COMMIT}/data/walk_01_traj_ped_filtered.csv",
        f"/owner/name/{COMMIT}/data/walk_01_traj_veh_filtered.csv",
    ]


def test_a_second_get_needs_no_network(server, dataset, tmp_path, monkeypatch):
    fetch(dataset, tmp_path)
    asked = len(server.requests)
    monkeypatch.setenv("PCGAN_DATA_URL", "http://127.0.0.1:9")  # nobody listens
    assert fetch(dataset, tmp_path).downloaded == 0
    assert len(server.requests) == asked


def test_gzipped_files_count_and_damaged_ones_are_downloaded_again(dataset, tmp_path):
    target = first_path(dataset, tmp_path)
    target.parent.mkdir(parents=True)
    gzipped = target.with_name(f"{target.name}.gz")
    gzipped.write_bytes(gzip.compress(PEDESTRIANS))
    assert fetch(dataset, tmp_path).downloaded == 1
    assert not target.exists()
    gzipped.write_bytes(gzip.compress(PEDESTRIANS)[:-40])
    assert fetch(dataset, tmp_path).downloaded == 1
    assert target.read_bytes() == PEDESTRIANS
    target.write_bytes(PEDESTRIANS.replace(b"1.0", b"2.0"))
    assert fetch(dataset, tmp_path).downloaded == 1
    assert target.read_bytes() == PEDESTRIANS


# --- interrupted downloads -------------------------------------------------------------------------------------------


def test_ctrl_c_leaves_parts_only_and_the_next_get_asks_for_the_rest(server, dataset, tmp_path):
    def interrupt(done, _total):
        if done > 100_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch(dataset, tmp_path, progress=interrupt)
    part = part_of(dataset, tmp_path)
    assert names(tmp_path) == [part.name]
    have = part.stat().st_size
    assert 0 < have < len(PEDESTRIANS)
    assert part.read_bytes() == PEDESTRIANS[:have]
    server.requests.clear()
    fetch(dataset, tmp_path)
    assert server.asked == [f"bytes={have}-", None]
    assert first_path(dataset, tmp_path).read_bytes() == PEDESTRIANS
    assert not part.exists()


def test_half_a_download_is_no_clip(dataset, tmp_path):
    part_of(dataset, tmp_path, PEDESTRIANS[:99])
    with pytest.raises(clips.DataNotFound):
        clips.clip_names("dut", tmp_path)


@pytest.mark.parametrize("lengths", [True, False])
def test_a_cut_connection_is_taken_up_again(server, dataset, tmp_path, lengths):
    server.lengths = lengths
    server.cut_after = [70_000, 50_000]
    fetch(dataset, tmp_path)
    assert server.asked[:3] == [None, "bytes=70000-", "bytes=120000-"]
    assert first_path(dataset, tmp_path).read_bytes() == PEDESTRIANS


def test_a_server_without_range_sends_everything_again(server, dataset, tmp_path):
    server.ranges = False
    part_of(dataset, tmp_path, PEDESTRIANS[:70_000])
    fetch(dataset, tmp_path)
    assert server.asked[0] == "bytes=70000-"
    assert first_path(dataset, tmp_path).read_bytes() == PEDESTRIANS


def test_a_server_that_goes_on_elsewhere_is_asked_from_the_start(server, dataset, tmp_path):
    server.first_byte_lies = 1
    part_of(dataset, tmp_path, PEDESTRIANS[:70_000])
    fetch(dataset, tmp_path)
    assert server.asked[:2] == ["bytes=70000-", None]
    assert first_path(dataset, tmp_path).read_bytes() == PEDESTRIANS


@pytest.mark.parametrize(
    ("part", "asked"),
    [
        (b"x" * 70_000, ["bytes=70000-", None]),  # of something else, which the checksum tells
        (b"x" * len(PEDESTRIANS), [None]),
        (b"x" * (len(PEDESTRIANS) + 5), [None]),
        (PEDESTRIANS, []),  # whole, and only not renamed
    ],
)
def test_a_part_is_not_trusted(server, dataset, tmp_path, part, asked):
    part_of(dataset, tmp_path, part)
    fetch(dataset, tmp_path)
    assert server.asked == [*asked, None]  # the last for the other file
    assert first_path(dataset, tmp_path).read_bytes() == PEDESTRIANS


def test_passing_errors_are_tried_again(server, dataset, tmp_path):
    server.statuses = [503, 429, 500]
    fetch(dataset, tmp_path)
    assert len(server.requests) == 5
    assert first_path(dataset, tmp_path).read_bytes() == PEDESTRIANS


# --- what cannot be had ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong", [PEDESTRIANS.replace(b"1.0", b"2.0"), PEDESTRIANS[:-7], PEDESTRIANS + b"x", b"", b"<html>"]
)
def test_a_wrong_checksum_names_file_and_both_sums(server, dataset, tmp_path, wrong):
    server.files[f"/owner/name/{COMMIT}/data/walk_01_traj_ped_filtered.csv"] = wrong
    with pytest.raises(DownloadError) as caught:
        fetch(dataset, tmp_path)
    problem = str(caught.value)
    assert "\n" not in problem
    assert "walk_01_traj_ped_filtered.csv" in problem
    assert f"expected sha256 {hashlib.sha256(PEDESTRIANS).hexdigest()}" in problem
    assert f"found {hashlib.sha256(wrong).hexdigest()} ({len(wrong)} bytes)" in problem
    assert names(tmp_path) == []


def test_an_endless_answer_ends(server, dataset, tmp_path):
    server.files[f"/owner/name/{COMMIT}/data/walk_01_traj_ped_filtered.csv"] = PEDESTRIANS * 40
    with pytest.raises(DownloadError, match="is not the file that is wanted") as caught:
        fetch(dataset, tmp_path)
    assert int(str(caught.value).rpartition("(")[2].split()[0]) < 3 * len(PEDESTRIANS)


def test_a_shorter_file_upstream_ends_too(server, dataset, tmp_path):
    server.files[f"/owner/name/{COMMIT}/data/walk_01_traj_ped_filtered.csv"] = PEDESTRIANS[:60_000]
    part_of(dataset, tmp_path, PEDESTRIANS[:70_000])
    with pytest.raises(DownloadError, match=r"found \w+ \(60000 bytes\)"):
        fetch(dataset, tmp_path)
    assert names(tmp_path) == []


def test_not_found_is_not_tried_again(server, dataset, tmp_path):
    server.files.clear()
    with pytest.raises(DownloadError, match=r"walk_01_traj_ped_filtered\.csv cannot be downloaded: 404 Not Found"):
        fetch(dataset, tmp_path)
    assert len(server.requests) == 1


def test_a_server_that_stays_away_is_given_up_and_what_came_is_kept(server, dataset, tmp_path):
    server.statuses = [503] * 9
    part = part_of(dataset, tmp_path, PEDESTRIANS[:70_000])
    with pytest.raises(DownloadError, match=r"503 .*\(4 attempts\); what has come is kept"):
        fetch(dataset, tmp_path)
    assert len(server.requests) == download.ATTEMPTS
    assert part.read_bytes() == PEDESTRIANS[:70_000]
    with pytest.raises(DownloadError, match="refused"):
        fetch(dataset, tmp_path, base_url="http://127.0.0.1:9")


@pytest.mark.parametrize("url", ["file:///tmp", "ftp://mirror", "mirror"])
def test_mirrors_speak_http(dataset, tmp_path, monkeypatch, url):
    monkeypatch.setenv("PCGAN_DATA_URL", url)
    with pytest.raises(DownloadError, match="PCGAN_DATA_URL must begin with http"):
        fetch(dataset, tmp_path)


# --- the manifest ----------------------------------------------------------------------------------------------------


def test_the_manifest_describes_the_data_sets():
    assert list(download.datasets()) == ["eth_ucy", "dut", "citr"]
    counts = {name: (len(d.files), d.clips) for name, d in download.datasets().items()}
    assert counts == {"eth_ucy": (9, 9), "dut": (54, 27), "citr": (64, 38)}
    for dataset in download.datasets().values():
        assert dataset.licence
        assert dataset.cite
        locals_ = [file.local for file in dataset.files] + [absent.local for absent in dataset.absent]
        assert len(set(locals_)) == len(locals_)
        assert all(local.startswith(f"{dataset.name}/") and ".." not in local for local in locals_)
        for file in dataset.files:
            assert len(file.commit) == 40
            assert {len(file.content.sha256), len(file.published.sha256)} == {64}
            assert (file.content != file.published) == (file.local == "eth_ucy/biwi_eth_6frame.txt")
    missing = {Path(absent.local).name[:13]: absent for absent in find("dut").absent}
    assert missing["roundabout_05"].reason.startswith("rebuilt: not downloadable")
    assert "27 clips" in missing["roundabout_03"].reason
    with pytest.raises(ValueError, match="no data set 'nuscenes'; there are eth_ucy, dut, citr"):
        find("nuscenes")


def test_addresses_are_raw_files_at_pinned_commits():
    first = find("citr").files[0]
    assert first.url(download.BASE_URL) == (
        "https://raw.githubusercontent.com/dongfang-steven-yang/vci-dataset-citr/"
        "b6a980628f48e7c80c748c3e333979ca3a6b0301/data/trajectories_filtered/p2p_bi/"
        "bidirection_no_vehicle_3v7_01_traj_ped_filtered.csv"
    )


def unzipped(path):
    return path.read_bytes() if path.is_file() else gzip.decompress(path.with_name(f"{path.name}.gz").read_bytes())


def published(file, data_dir):
    if file.content != file.published:
        return unzipped(data_dir / "eth_ucy" / "eth_univ_obsmat.txt")
    return unzipped(data_dir / file.local)


@pytest.mark.parametrize("name", ["eth_ucy", "dut", "citr"])
def test_the_public_data_sets_arrive_as_they_are_here(server, tmp_path, monkeypatch, public_data, name):
    dataset = find(name)
    try:
        server.files.update((file.url(""), published(file, public_data)) for file in dataset.files)
    except FileNotFoundError as error:
        pytest.skip(f"{error.filename} is not here")
    monkeypatch.setenv("PCGAN_DATA", str(tmp_path))
    fetched = fetch(dataset, tmp_path)
    assert fetched.downloaded == len(dataset.files)
    assert set(names(tmp_path)) == {Path(file.local).name for file in dataset.files}
    assert locate(dataset).files == len(dataset.files)
    for file in dataset.files:
        assert (tmp_path / file.local).read_bytes() == unzipped(public_data / file.local)
    lacking = {"dut/roundabout_05"} if name == "dut" else set()
    assert set(clips.clip_names(name, tmp_path)) == set(clips.clip_names(name, public_data)) - lacking
    assert fetched.clips == dataset.clips - len(lacking)


def test_six_frame_annotation_sorts_and_rounds():
    obsmat = b"  1.2e+01 2 3.00004999e+00 0 -1.00005001 0 0 0\r\n 6.0e+00 2.0 9.0 0 8.0 0 0 0\r\n12 1 1 0 1 0 0 0\r\n"
    assert (
        six_frame_annotation(obsmat) == b"6\t2.0\t9.0000\t8.0000\n12\t1.0\t1.0000\t1.0000\n12\t2.0\t3.0000\t-1.0001\n"
    )


def test_a_file_that_does_not_give_the_derived_one_is_refused(server, tmp_path):
    row = b"6 2 9 0 8 0 0 0\r\n"
    server.files[f"/owner/name/{COMMIT}/obsmat.txt"] = row
    wanted = content_of(b"something else")
    file = DataFile("eth_ucy/six.txt", wanted, "owner/name", COMMIT, "obsmat.txt", content_of(row))
    with pytest.raises(DownloadError, match=rf"six\.txt, made from .*obsmat\.txt, .*expected sha256 {wanted.sha256}"):
        fetch(DataSet("eth_ucy", "made", "none", "nobody", (file,), ()), tmp_path)
    assert names(tmp_path) == []


def test_a_rebuilt_file_is_copied_from_another_data_folder(server, tmp_path, alone, monkeypatch):
    rebuilt = AbsentFile("dut/trajectories_filtered/b_traj_ped_filtered.csv", "rebuilt", content_of(PEDESTRIANS))
    left_out = AbsentFile("dut/trajectories_filtered/c_traj_ped_filtered.csv", "left out", None)
    made = make_dataset(server, {"a_traj_ped_filtered.csv": VEHICLES}, (rebuilt, left_out))
    fetched = fetch(made, alone)
    assert (fetched.clips, fetched.copied, fetched.absent) == (1, (), (rebuilt, left_out))
    other = tmp_path / "other"
    (other / "dut" / "trajectories_filtered").mkdir(parents=True)
    gzipped = other / f"{rebuilt.local}.gz"
    gzipped.write_bytes(gzip.compress(PEDESTRIANS[:-1]))  # not the one that the benchmarks use
    monkeypatch.setenv("PCGAN_DATA", str(other))
    assert fetch(made, alone).copied == ()
    gzipped.write_bytes(gzip.compress(PEDESTRIANS))
    fetched = fetch(made, alone)
    assert (fetched.clips, fetched.copied, fetched.absent) == (2, (rebuilt.local,), (left_out,))
    assert gzip.decompress((alone / f"{rebuilt.local}.gz").read_bytes()) == PEDESTRIANS


# --- where data sets are looked for ----------------------------------------------------------------------------------


def test_the_cache_is_looked_at_last(alone, tmp_path, monkeypatch):
    with pytest.raises(
        clips.DataNotFound, match=r"pcgan/data; download them \(`pcgan data get NAME`\), or set PCGAN_DATA"
    ):
        clips.data_folder()
    (alone / "dut" / "trajectories_filtered").mkdir(parents=True)
    assert clips.data_folder() == alone
    shared = tmp_path / "shared" / "data"
    (shared / "citr").mkdir(parents=True)
    assert clips.data_folders() == (shared, alone)
    assert locate(find("dut")).folder == alone  # the shared folder has none
    with pytest.raises(clips.DataNotFound, match="`pcgan data get eth_ucy` downloads it"):
        clips.clip_names("eth_ucy")
    monkeypatch.setenv("PCGAN_DATA", str(shared))
    assert clips.data_folders() == (shared,)
    assert locate(find("dut")) is None


def test_the_cache_follows_xdg(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert clips.cache_folder() == tmp_path / ".cache" / "pcgan" / "data"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # to be ignored, says its specification
    assert clips.cache_folder() == tmp_path / ".cache" / "pcgan" / "data"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "x"))
    assert clips.cache_folder() == tmp_path / "x" / "pcgan" / "data"


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def pcgan_data(capsys, monkeypatch):
    """Runs `pcgan data`; returns exit code, stdout and stderr."""
    monkeypatch.setenv("COLUMNS", "160")

    def run(*arguments):
        with pytest.raises(SystemExit) as ending:
            app([str(argument) for argument in arguments])
        return (ending.value.code or 0, *capsys.readouterr())

    return run


@pytest.fixture
def made(dataset, monkeypatch):
    """The made data set in place of the manifest."""
    absent = AbsentFile(
        "dut/trajectories_filtered/b_traj_ped_filtered.csv", "rebuilt: not downloadable", Content(1, "0")
    )
    made = DataSet("dut", "made", "none stated", "Nobody 2020", dataset.files, (absent,))
    monkeypatch.setattr(download, "datasets", lambda: {"dut": made})
    return made


def test_get_and_list(pcgan_data, made, alone):
    code, out, err = pcgan_data("list")
    assert (code, err) == (0, "")
    assert "dut: 2 files, 0.4 MB, 2 clips; not here; pcgan data get dut" in out
    for line in ("licence none stated", "cite    Nobody 2020", "rebuilt: not downloadable", "owner/name at c0ffee0"):
        assert line in out
    code, out, err = pcgan_data("get", "dut")
    assert (code, err) == (0, "")
    assert f"dut: 2 files downloaded, 0.4 MB; 1 of 2 clips in {alone / 'dut'}" in out
    assert "missing: dut/trajectories_filtered/b_traj_ped_filtered.csv: rebuilt: not downloadable" in out
    assert pcgan_data("get", "dut")[1].startswith("dut: nothing to download; 1 of 2 clips in ")
    assert f"clips; in {alone / 'dut'}" in pcgan_data("list")[1]
    first_path(made, alone).unlink()
    assert f"clips; 1 of 2 files in {alone / 'dut'}" in pcgan_data("list")[1]


@pytest.mark.usefixtures("made")
def test_get_into_another_folder_says_how_to_use_it(pcgan_data, alone, tmp_path, monkeypatch):
    mine = tmp_path / "mine"
    code, out, err = pcgan_data("get", "dut", "--into", mine)
    assert code == 0
    assert str(mine / "dut") in out
    assert err == f"note: no command reads it there; set PCGAN_DATA to {mine} to use this copy\n"
    pcgan_data("get", "dut")
    assert f"note: dut is read from {alone}; set" in pcgan_data("get", "dut", "--into", mine)[2]
    monkeypatch.setenv("PCGAN_DATA", str(mine))
    assert pcgan_data("get", "dut", "--into", mine)[2] == ""


@pytest.mark.usefixtures("made")
def test_errors_are_one_line_and_exit_code_2(pcgan_data, server, tmp_path):
    assert pcgan_data("get", "kitti") == (2, "", "pcgan: no data set 'kitti'; there are dut\n")
    server.files.clear()
    code, out, err = pcgan_data("get", "dut", "--into", tmp_path)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"pcgan: {server.url}/owner/name/")
    assert err.endswith("404 Not Found\n")
    (tmp_path / "file").write_text("")
    code, out, err = pcgan_data("get", "dut", "--into", tmp_path / "file")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "cannot be written" in err
    assert pcgan_data("get")[0] == 2


@pytest.mark.usefixtures("made")
def test_ctrl_c_is_exit_code_130(pcgan_data, tmp_path, monkeypatch):
    def interrupted(response):
        yield response.read(1000)
        raise KeyboardInterrupt

    monkeypatch.setattr(download, "_chunks", interrupted)
    code, out, err = pcgan_data("get", "dut", "--into", tmp_path)
    assert (code, out) == (130, "")
    assert "Traceback" not in err
    assert names(tmp_path) == ["walk_01_traj_ped_filtered.csv.part"]


@pytest.mark.parametrize("arguments", [(), ("list",), ("get",)])
def test_help_has_examples(pcgan_data, arguments):
    code, out, _ = pcgan_data(*arguments, "--help")
    assert code == 0
    assert "Example" in out
    assert f"pcgan data {' '.join(arguments)}".strip() in out.split("Example")[1]
