"""The generated code is what the .proto file gives: nobody edited one without the other."""

import subprocess
import sys
from pathlib import Path

import pytest

import schemas

FOLDER = Path(schemas.__file__).parent


@pytest.fixture(scope="module")
def generated(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("generated")
    subprocess.run(
        [sys.executable, "-m", "grpc_tools.protoc", f"--proto_path={FOLDER}", f"--python_out={folder}",
         f"--pyi_out={folder}", "pcgan_v1.proto"],
        check=True,
        timeout=60,
    )  # fmt: skip
    return folder


@pytest.mark.parametrize("name", ["pcgan_v1_pb2.py", "pcgan_v1_pb2.pyi"])
def test_generated_code_is_fresh(generated, name):
    assert (FOLDER / name).read_text() == (generated / name).read_text(), f"{name} is stale; run make schemas"
