PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Another package index, e.g. one with CPU-only torch wheels: make demo PIP_ARGS="--extra-index-url URL"
PIP_ARGS ?=

.PHONY: demo test lint schemas picture clean

# One stamp file per set of dependencies: the environment is rebuilt only when they change.
$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt $(PIP_ARGS) --editable ".[view,dev]"
	touch $@

schemas: $(VENV)/installed
	$(BIN)/python -m grpc_tools.protoc --proto_path=schemas --python_out=schemas --pyi_out=schemas pcgan_v1.proto
	sed -i 's/^import pcgan_v1_pb2/from schemas import pcgan_v1_pb2/' schemas/pcgan_v1_pb2.py
