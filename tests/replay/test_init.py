"""The package's own namespace: loaded when asked for, the same in whatever order things are imported."""

import subprocess
import sys

import pytest

import replay

HEAVY = ("numpy", "scipy", "torch", "mcap", "zenoh", "pydantic", "google.protobuf", "fsspec")

ORDERS = """
import sys
for imports in (
    "from replay import record",
    "import replay.record; from replay import record",
    "from replay.record import Summary; from replay import record",
    "import replay; import replay.record; record = replay.record",
    "from replay import Replay, record, cli",
    "from replay import *",
    "import importlib; importlib.import_module('replay.record'); from replay import record",
):
    for name in ("replay", "replay.record"):  # the others take long to be made anew, and their names are no one's else
        sys.modules.pop(name, None)
    names = {}
    exec(f"{imports}; import replay", names)
    if type(names["record"]).__name__ != "function" or names["replay"].record is not names["record"]:
        print(imports)
"""


def run(program: str) -> str:
    """Runs a program in a fresh interpreter, where warnings are errors."""
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_the_package_loads_nothing_of_weight():
    print_loaded = f"print([name for name in {HEAVY} if name in sys.modules])"
    assert run(f"import sys, replay, replay.errors; {print_loaded}") == "[]\n"


@pytest.mark.parametrize("name", replay.__all__)
def test_every_exported_name_is_there_and_keeps_its_place(name):
    value = getattr(replay, name)
    assert value.__name__ == name
    assert value.__module__.startswith("replay.")
    assert name in dir(replay)


def test_record_is_the_function_in_every_order_of_imports():
    assert run(ORDERS) == ""


def test_a_name_that_does_not_exist_is_reported_as_in_any_module():
    with pytest.raises(AttributeError, match="module 'replay' has no attribute 'rekord'"):
        _ = replay.rekord
    with pytest.raises(ImportError, match="cannot import name 'rekord' from 'replay'"):
        from replay import rekord  # noqa: F401


def test_a_test_may_put_something_in_the_place_of_a_name(monkeypatch):
    original = replay.record
    monkeypatch.setattr(replay, "record", len)
    assert replay.record is len
    monkeypatch.undo()
    assert replay.record is original
