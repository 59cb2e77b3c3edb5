PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT := out
# Another package index, e.g. one with CPU-only torch wheels: make demo PIP_ARGS="--extra-index-url URL"
PIP_ARGS ?=
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt $(PIP_ARGS)

.PHONY: demo test test-slow lint picture schemas clean

# The main job on a drive of its own making: simulate, replay, sum up, draw.
demo: $(VENV)/demo
	@mkdir -p $(OUT)
	$(BIN)/pcgan simulate $(OUT)/demo.mcap --pedestrians 30 --duration 20 --seed 7
	$(BIN)/pcgan replay $(OUT)/demo.mcap -o $(OUT)/demo.pcgan.mcap --rrd $(OUT)/demo.rrd \
		--picture $(OUT)/demo.png --json $(OUT)/demo.json
	@echo "look at $(OUT)/demo.png, or: $(BIN)/rerun $(OUT)/demo.rrd"

test: $(VENV)/dev lint
	$(BIN)/python -m pytest -m "not slow" -n 2 --dist worksteal

test-slow: $(VENV)/dev
	$(BIN)/python -m pytest -m slow -n 2

lint: $(VENV)/dev
	$(BIN)/ruff format --check --quiet
	$(BIN)/ruff check --quiet
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

# The pictures of the README, made anew; needs a graphics driver (docs/views.md).
picture: $(VENV)/demo
	@mkdir -p $(OUT) docs/images
	$(BIN)/pcgan simulate $(OUT)/picture.mcap --pedestrians 30 --duration 20 --seed 7
	$(BIN)/pcgan replay $(OUT)/picture.mcap -o $(OUT)/picture.pcgan.mcap --rrd $(OUT)/picture.rrd \
		--picture docs/images/top_down.png
	$(BIN)/python -m replay.rerun_screenshot $(OUT)/picture.rrd docs/images/rerun.png --at 12

schemas: $(VENV)/dev
	$(BIN)/python -m grpc_tools.protoc --proto_path=schemas --python_out=schemas --pyi_out=schemas pcgan_v1.proto

# A stamp file per set of dependencies: the environment is renewed only when they change.
$(VENV)/python: 
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; try make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/demo: pyproject.toml constraints.txt | $(VENV)/python
	$(PIP) --editable ".[view]"
	touch $@

$(VENV)/dev: pyproject.toml constraints.txt | $(VENV)/python
	$(PIP) --editable ".[view,dev]"
	touch $@ $(VENV)/demo

clean:
	rm -rf $(OUT) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
