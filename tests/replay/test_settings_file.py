"""Profiles in three languages, and mistakes in them told in one line."""

import pytest

from replay.session import ReplaySettings
from replay.settings_file import SettingsError, read_plain, read_profile


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("car.toml", "start_s = 2\n[roles.cameras.front]\ndetections = '/yolo'"),
        ("car.yaml", "start_s: 2\nroles: {cameras: {front: {detections: /yolo}}}"),
        ("car.YML", "start_s: 2\nroles:\n  cameras:\n    front:\n      detections: /yolo\n"),
        ("car.json", '{"start_s": 2, "roles": {"cameras": {"front": {"detections": "/yolo"}}}}'),
    ],
)
def test_all_languages_say_the_same(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    settings = read_profile(tmp_path / name)
    assert settings.start_s == 2
    assert settings.roles.cameras["front"].detections == "/yolo"
    assert settings.tracking == ReplaySettings().tracking


def test_no_profile_is_the_defaults():
    assert read_profile(None) == ReplaySettings()


def test_what_an_output_carries_is_a_profile(tmp_path):
    settings = ReplaySettings(duration_s=3, sync={"time_offset_ms": {"/a": -80}})
    (tmp_path / "settings.json").write_text(settings.model_dump_json())
    assert read_profile(tmp_path / "settings.json") == settings


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.toml", "start_s =", "a.toml is not TOML: "),
        ("a.json", "{", "a.json is not JSON: "),
        ("a.yaml", "a: [", "a.yaml is not YAML: line 1"),
        ("a.yaml", "- 1", "a.yaml must hold names and values at its top, and holds a list"),
        ("a.yaml", "", "a.yaml must hold names and values at its top, and holds nothing"),
        ("a.txt", "", "a.txt must end in .yaml"),
        ("a.json", "[" * 100_000, "a.json cannot be read: its brackets are nested too deeply"),
        ("a.yaml", "{a: " * 1000, "a.yaml cannot be read: its brackets are nested too deeply"),
        ("a.toml", "a = " + "[" * 10_000, "a.toml cannot be read: its brackets are nested too deeply"),
        ("a.yaml", "start_s: soon", "a.yaml: start_s: Input should be a valid number"),
        (
            "a.yaml",
            "tracking: {trackr: {}}",
            "a.yaml: tracking.trackr: there is nothing of this name; did you mean tracker",
        ),
        ("a.yaml", "a: !!python/object:os.system {}", "a.yaml is not YAML: "),
    ],
)
def test_a_mistake_is_one_line_with_its_place(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(SettingsError) as refusal:
        read_profile(tmp_path / name)
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SettingsError, match=r"gone\.yaml cannot be read: No such file"):
        read_plain(tmp_path / "gone.yaml")
