"""The page of a check: complete, whatever came of the cases, and safe, whatever they are called."""

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

import pytest

from replay.check_page import case_folder, write_page
from replay.check_result import CaseResult, ErrorSlice, Judged, Moment, MomentKind, Reference, Status, WorstOf
from replay.diff_result import Difference, FieldDifferences, Kind, LogDiff, TopicDiff
from replay.errors import OutputError

HOSTILE = """<script>alert(1)</script>"'><img src=x onerror=alert(2)>../../..\\ {{ 7 * 7 }}"""
VOID = {"meta", "link", "img", "br", "input", "rect", "polyline", "hr"}


class Page(HTMLParser):
    """A page as a browser reads it: tags that do not nest are an error."""

    def __init__(self, path: Path):
        super().__init__()
        self.path, self.links, self.tags, self.text, self.attributes = path, [], [], [], []
        self._open: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self._open == [], f"{path.name} leaves {self._open} open"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes.append((tag, dict(attrs)))
        self.links += [value for name, value in attrs if name in ("href", "src")]
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open, f"</{tag}> closes nothing"
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    @property
    def words(self) -> str:
        return " ".join(" ".join(self.text).split())

    def cards(self) -> list[dict[str, str]]:
        return [attributes for _, attributes in self.attributes if attributes.get("class") == "card"]


def pages(index: Path) -> dict[str, Page]:
    """Reads all pages, and checks that whatever they link to is there."""
    found = {path.relative_to(index.parent).as_posix(): Page(path) for path in sorted(index.parent.rglob("*.html"))}
    for page in found.values():
        for link in page.links:
            parts = urlsplit(link)
            if link.startswith("#"):
                assert [attributes.get("id") for _, attributes in page.attributes].count(parts.fragment) == 1
                continue
            assert not parts.scheme
            assert not parts.netloc
            target = (page.path.parent / unquote(parts.path)).resolve()
            assert target.is_file(), f"{page.path.name} links to {link}"
            assert target.is_relative_to(index.parent.resolve())
    return found


def moment(kind=MomentKind.ERROR, size=1.5, **changes) -> Moment:
    values = {
        "kind": kind, "at_s": 12.4, "stamp_ns": 1_700_000_012_400_000_000, "size": size, "text": f"{kind} of {size}",
        "track_id": 7, "person_id": 3, "ahead_m": 5.0, "left_m": 0.5, "range_m": 5.02, "speed_mps": 1.3,
        "turning": False, "near_vehicle": False, "horizon_errors_m": ((0.4, 0.5), (0.8, 2.5)),
    }  # fmt: skip
    return Moment(**(values | changes))


SUMMARY = {
    "frames": 300, "tracks": 12, "refused": 0, "ade_m": 0.4, "fde_m": 0.8, "nll": 1.0,
    "model": {"name": "small", "sha256": "0123456789abcdef"},
    "ground_truth": {"hota": 0.91, "id_switches": 2, "missed": 30, "ade_m": 0.45},
}  # fmt: skip
BEFORE = SUMMARY | {"ade_m": 0.5, "ground_truth": {"hota": 0.95, "id_switches": 2, "missed": 20, "ade_m": 0.4}}
FIRST = Difference(
    Kind.VALUE,
    "/pcgan/tracks",
    12.4,
    1_700_000_012_400_000_000,
    "track 7, x",
    "tracks.x",
    "4.812",
    "4.870",
    0.058,
    1e-4,
)
DIFF = LogDiff(
    (
        TopicDiff(
            "/pcgan/tracks",
            (300, 299),
            identical=False,
            same=False,
            first=FIRST,
            fields=(FieldDifferences("tracks.x", 1000, 250, 0.5, 0.01, 0.4), FieldDifferences("tracks.label", 9, 1)),
            items=3,
            when=(0, 2, 5),
        ),
        TopicDiff("/pcgan/vehicle_pose", (300, 300), identical=True, same=True),
    ),
    {"7": "8"},
)


def case(name="crossing", status=Status.CHANGED, folder=None, **changes) -> CaseResult:
    """A case with everything; with a folder its pictures and its recording are there."""
    variant = changes.pop("variant", "")
    moments = (moment(size=2.0, turning=True), moment(size=1.0, near_vehicle=True), moment(MomentKind.MISSED, 3.0))
    recording = None
    if folder is not None:
        own = case_folder(folder, name, variant)
        (own / "pictures").mkdir(parents=True)
        recording = own / "replay.rrd"
        recording.write_bytes(b"")
        pictures = [own / "pictures" / f"{i}.png" for i in range(len(moments))]
        for picture in pictures:
            picture.write_bytes(b"")
        moments = tuple(replace(m, picture=p) for m, p in zip(moments, pictures, strict=True))
    values = {
        "summary": SUMMARY, "reference_summary": BEFORE, "problem": str(FIRST), "diff": DIFF, "moments": moments,
        "judged": (Judged("hota >= 0.95", 0.91, met=False), Judged("no refused messages", 0, met=True)),
        "reference": Reference(Path("r"), "0.0.9", "small", "0123456789", "first", (), ("tracking.gate 3 -> 4", "b")),
        "slices": (ErrorSlice("range", "0 to 10 m", 30, 0.5, 2.0), ErrorSlice("horizon", "0.8 s", 40, 0.7, 2.5)),
        "recording": recording, "log_s": 30.0, "wall_s": 3.0, "logs": (f"{name}.mcap",),
    }  # fmt: skip
    return CaseResult(case=name, variant=variant, status=status, **(values | changes))


def test_everything_about_a_case_is_on_its_pages(tmp_path):
    index = write_page([case(folder=tmp_path)], tmp_path, title="nightly", date="2026-01-02")
    assert index == tmp_path / "index.html"
    found = pages(index)
    assert set(found) == {"index.html", "cases/crossing/index.html", "rerun/index.html"}
    front, own = found["index.html"].words, found["cases/crossing/index.html"].words
    for words in (front, own):
        assert "/pcgan/tracks at 12.400 s, track 7, x: 4.812 vs 4.870 (atol 0.0001)" in words
        assert "small (01234567)" in words
        assert "2026-01-02" in words
        assert "tracking.gate 3 -> 4" in words
        assert "0.910" in words
        assert "0 to 10 m" in words
    assert "0 of 1 passed: 1 changed" in front
    assert "not met: hota >= 0.95" in front
    assert "Written with pcgan 0.0.9, model small (01234567): first" in own
    assert "tracks.x 1000 250" in own
    assert "300 messages in the reference, 299 now; 3 tracks, predictions or paths in one log alone" in own
    assert "the same bytes" in own


def test_figures_say_which_way_is_better(tmp_path):
    front = Page(write_page([case()], tmp_path))
    hota, missed = front.words.index("0.910 ▼ −0.040"), front.words.index("30 ▼ +10")
    assert hota < missed
    own = Page(case_folder(tmp_path, "crossing", "") / "index.html").words
    assert "HOTA 0.950 0.910 ▼ −0.040" in own
    assert "ADE, tracks 0.500 m 0.400 m ▲ −0.100" in own
    assert "id switches 2 2" in own


def test_moments_are_ranked_over_all_cases(tmp_path):
    others = (moment(size=1.7), moment(MomentKind.MISSED, 9.0), moment(MomentKind.SWITCH, 2.0))
    results = [case("a", folder=tmp_path), replace(case("b", folder=tmp_path), moments=others)]
    front = pages(write_page(results, tmp_path))["index.html"]
    assert [(card["data-kind"], card["data-case"]) for card in front.cards()] == [
        ("prediction error", "a"), ("prediction error", "b"), ("prediction error", "a"),
        ("missed person", "b"), ("missed person", "a"), ("id switch", "b"),
    ]  # fmt: skip
    assert "data-turning" in front.cards()[0]
    assert "data-near" in front.cards()[2]
    assert "data-turning" not in front.cards()[1]
    assert front.cards()[0]["data-range"] == "0 to 10 m"


NEAR, FAR, AHEAD = ("near the vehicle", "within 5 m"), ("range", "over 30 m"), ("horizon", "0.8 s")


def worst_of(*slices):
    return tuple(WorstOf(*part, size) for part, size in slices)


def test_the_worst_of_a_slice_is_on_the_first_page_and_its_row_leads_there(tmp_path):
    """30 errors are larger than any near the vehicle; of four cases' worst there three are shown."""
    many = tuple(moment(size=10.0 + i, range_m=15.0) for i in range(30))
    results = [replace(case("many"), moments=many, slices=())]
    for name, size in (("a", 0.4), ("b", 0.7), ("c", 0.5), ("d", 0.6)):
        near = moment(size=size, near_vehicle=True, worst_of=worst_of((NEAR, size), (AHEAD, 5 * size)))
        rows = (ErrorSlice(*NEAR, 9, 0.1, size), ErrorSlice(*AHEAD, 9, 0.1, 5 * size), ErrorSlice(*FAR, 9, 0.1, 9.0))
        results.append(replace(case(name), moments=(near,), slices=rows))
    found = pages(write_page(results, tmp_path))
    cards = found["index.html"].cards()
    assert [card["data-case"] for card in cards] == ["many"] * 24 + ["b", "d", "c"]
    assert [link for link in found["index.html"].links if link.startswith("#")] == [f"#{cards[24]['id']}"] * 2
    assert found["index.html"].words.count("the worst of: within 5 m of the vehicle, 0.8 s ahead (3.50 m)") == 1
    assert json.loads(cards[24]["data-errors"]) == pytest.approx({"0.4 s": 0.5, "0.8 s": 3.5})
    assert found["cases/a/index.html"].words.count("the worst of: within 5 m of the vehicle, 0.8 s ahead (2.00 m)") == 1
    assert "0.8 s ahead" in found["index.html"].words
    assert len({card["id"] for card in cards}) == len(cards)


def test_a_card_is_found_under_the_slices_that_it_stands_for(tmp_path):
    """The person's error near the vehicle was within the horizon of a larger one, which stands for both."""
    stands = moment(size=2.0, range_m=31.0, worst_of=worst_of((NEAR, 1.0), (("range", "20 to 30 m"), 1.5)))
    (card,) = Page(write_page([replace(case(), moments=(stands,))], tmp_path)).cards()
    assert "data-near" in card
    assert "data-turning" not in card
    assert card["data-range"] == "20 to 30 m|over 30 m"


def test_a_link_to_rerun_says_which_recording_and_when(tmp_path):
    found = pages(write_page([case("a b", folder=tmp_path)], tmp_path))
    for name, up in (("index.html", ""), (f"cases/{case_folder(tmp_path, 'a b', '').name}/index.html", "../../")):
        links = [urlsplit(link) for link in found[name].links if "rerun/" in link]
        assert len(links) == 3
        assert links[0].path == f"{up}rerun/index.html"
        query = parse_qs(links[0].query)
        assert query["stamp_ns"] == ["1700000012400000000"]
        assert (tmp_path / query["recording"][0]).is_file()


def test_what_lies_outside_of_the_folder_is_not_linked(tmp_path):
    elsewhere = tmp_path / "elsewhere.png"
    elsewhere.write_bytes(b"")
    result = replace(case(), moments=(moment(picture=elsewhere),), recording=elsewhere)
    found = pages(write_page([result], tmp_path / "page"))
    assert "img" not in found["index.html"].tags
    assert not any("rerun/" in link for link in found["index.html"].links)


@pytest.mark.parametrize("status", list(Status))
def test_every_status_has_its_page(tmp_path, status):
    front = Page(write_page([case(status=status)], tmp_path)).words
    assert f"{1 if status.passed else 0} of 1 passed: 1 {status}" in front


@pytest.mark.parametrize("bare", [
    CaseResult("a", "", ("a.mcap",), Status.ERROR, "a.mcap is empty"),
    CaseResult("a", "", (), Status.UNREFERENCED),
    CaseResult("a", "", ("a.mcap",), Status.NEW, summary={"ade_m": None, "model": {}, "ground_truth": {}}),
    CaseResult("a", "", ("a.mcap",), Status.IDENTICAL, summary={"frames": 0}, diff=LogDiff(())),
], ids=lambda result: str(result.status))  # fmt: skip
def test_cases_with_nothing_to_show_are_fine(tmp_path, bare):
    found = pages(write_page([bare], tmp_path))
    assert bare.problem in found["index.html"].words
    assert "card" not in {attributes.get("class") for _, attributes in found["index.html"].attributes}


def test_a_suite_without_cases_is_fine(tmp_path):
    assert "The suite has no cases" in pages(write_page([], tmp_path))["index.html"].words


def test_without_pictures_it_says_how_to_get_them(tmp_path):
    front = pages(write_page([case()], tmp_path))["index.html"]
    assert "matplotlib is not installed" in front.words
    assert "matplotlib" not in pages(write_page([case(folder=tmp_path)], tmp_path))["index.html"].words


def test_variants_stand_side_by_side(tmp_path):
    better = SUMMARY | {"ground_truth": {**SUMMARY["ground_truth"], "hota": 0.93}}
    results = [case("a"), case("a", Status.MET, variant="eager", summary=better, reference_summary={})]
    found = pages(write_page(results, tmp_path))
    assert len(found) == 4
    words = found["index.html"].words
    assert "figure suite eager HOTA 0.910 0.930 ▲ +0.020" in words
    assert len(found["index.html"].cards()) == 3  # those of the suite's own way


def test_slices_of_all_cases_are_one_table_in_order(tmp_path):
    near = ErrorSlice("range", "0 to 10 m", 30, 0.5, 2.0)
    far = ErrorSlice("range", "over 30 m", 10, 1.0, 1.5)
    more = ErrorSlice("range", "0 to 10 m", 10, 0.9, 3.0)
    words = pages(write_page([case("a", slices=(far, near)), case("b", slices=(more,))], tmp_path))["index.html"].words
    assert "by range mean worst paths 0 to 10 m 0.60 3.00 40 over 30 m 1.00 1.50 10" in words


def test_hostile_names_are_text_and_nothing_else(tmp_path):
    """Whatever comes from a log, a suite or a reference stands there as it is, and adds no tag, link or folder."""
    evil = case(
        HOSTILE,
        folder=tmp_path,
        variant=HOSTILE,
        problem=HOSTILE,
        logs=(HOSTILE,),
        judged=(Judged(HOSTILE, None, met=False),),
        reference=Reference(Path(HOSTILE), HOSTILE, HOSTILE, HOSTILE, HOSTILE, (), (HOSTILE,)),
        summary=SUMMARY | {"model": {"name": HOSTILE, "sha256": HOSTILE}},
        slices=(ErrorSlice(HOSTILE, HOSTILE, 1, 1.0, 1.0),),
        diff=LogDiff(
            (
                TopicDiff(
                    HOSTILE, (1, 1), identical=False, same=False,
                    first=replace(FIRST, topic=HOSTILE, where=HOSTILE, a=HOSTILE),
                    fields=(FieldDifferences(HOSTILE, 1, 1),),
                ),
            )
        ),
    )  # fmt: skip
    evil = replace(evil, moments=tuple(replace(m, text=HOSTILE) for m in evil.moments))
    tame = case(folder=tmp_path / "tame", variant="b")
    index = write_page([evil], tmp_path / "", title=HOSTILE, date=HOSTILE)
    found = {name: page for name, page in pages(index).items() if not name.startswith("tame")}
    write_page([replace(tame, problem="p")], tmp_path / "tame")
    for name, page in found.items():
        words = " ".join(HOSTILE.split())
        assert words in page.words
        assert page.tags.count("script") == 1  # ours
        assert "49" not in page.words.replace(words, "").split()
        for tag, attributes in page.attributes:
            assert not any(attribute.startswith("on") for attribute in attributes), (name, tag)
    (folder,) = (tmp_path / "cases").iterdir()
    assert folder.name == case_folder(tmp_path, HOSTILE, HOSTILE).name
    assert set(folder.name) <= set("abcdefghijklmnopqrstuvwxyz0123456789._-")


NAMES = ["a", "A", "a/b", "a_b", "../a", ".", "..", "", " ", "a--b", "ü", "x" * 300, "con", "a\0b", "\ud800"]


def test_a_case_can_be_chosen_whatever_it_is_called(tmp_path):
    """Without a value of its own an option's is its text with white space run together."""
    names = ["two  spaces", " edges ", HOSTILE]
    front = Page(write_page([case(name) for name in names], tmp_path))
    values = {attributes["value"] for tag, attributes in front.attributes if tag == "option" and "value" in attributes}
    assert {card["data-case"] for card in front.cards()} == set(names) <= values


def test_every_case_has_a_folder_of_its_own(tmp_path):
    pairs = [(case, variant) for case in NAMES for variant in ["", *NAMES]]
    folders = {pair: case_folder(tmp_path, *pair) for pair in dict.fromkeys(pairs)}
    assert len({folder.name.lower() for folder in folders.values()}) == len(folders)
    for folder in folders.values():
        assert folder.parent == tmp_path / "cases"
        assert folder.name not in (".", "..")
        assert len(folder.name) < 80


def test_plain_names_stay_readable(tmp_path):
    assert case_folder(tmp_path, "crossing_2", "").name == "crossing_2"
    assert case_folder(tmp_path, "crossing_2", "eager").name == "crossing_2--eager"


def test_the_same_results_give_the_same_bytes(tmp_path):
    results = [case("a", folder=tmp_path), case("b", folder=tmp_path)]

    def written():
        index = write_page(results, tmp_path)
        return {path: path.read_bytes() for path in index.parent.rglob("*.html")}

    first = written()
    assert written() == first
    assert not list(tmp_path.rglob("*.part"))


def test_pages_need_nothing_from_elsewhere(tmp_path):
    for path in write_page([case(folder=tmp_path)], tmp_path).parent.rglob("*.html"):
        text = path.read_text()
        assert "http:" not in text
        assert "https:" not in text
        assert "@import" not in text


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file/index.html cannot be written"):
        write_page([case()], tmp_path / "file")
