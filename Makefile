# nightfix: one command for each job. `make demo` and `make test` need nothing but Debian 12, a Rust toolchain,
# Python 3.11 and a C compiler: the rest is fetched into .venv/ and target/.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
MAKEFLAGS += --no-builtin-rules

CARGO ?= cargo
# Python to make .venv with; empty: the first of python3.11, python3 that is 3.11 or newer.
PYTHON ?=
# Another package index for PyTorch, for example that of its CPU-only wheels (the default pulls about 6 GB).
TORCH_INDEX ?=
# World, flight and priors of the demo.
DEMO_SEED ?= 1

VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check
BUNDLE := models/bundles/lite-1536
FLIGHT := tests/flights/procedural

# The contract fixes where the binary is, whatever the user's own cargo settings say.
export CARGO_TARGET_DIR := $(CURDIR)/target

.PHONY: help venv py build release demo test test-rust test-py parity replay lint format bench clean

help: ## This list.
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

# ---- Python: one virtual environment ----

venv: $(VENV)/.base ## .venv with the Python packages of demo and tests (no PyTorch).

py: $(VENV)/.torch ## .venv with PyTorch and models/ (package sthn), editable.

$(PY):
	python="$$(scripts/host.sh python $(PYTHON))"; "$$python" -m venv $(VENV)

$(VENV)/.base: requirements.txt | $(PY)
	$(PIP) install --quiet --progress-bar off -r requirements.txt
	touch $@

$(VENV)/.torch: requirements-torch.txt models/pyproject.toml $(VENV)/.base
	$(if $(TORCH_INDEX),$(PIP) install --quiet --no-deps --index-url $(TORCH_INDEX) "$$(awk '/^torch==/ {print $$1}' requirements-torch.txt)")
	$(PIP) install --quiet --progress-bar off -r requirements-torch.txt
	$(PIP) install --quiet --progress-bar off -e models
	touch $@

# ---- Rust ----

build: venv ## Debug build, ONNX Runtime beside it.
	scripts/host.sh rust
	$(CARGO) build --locked
	scripts/place-onnxruntime.sh $(PY) target/debug target/debug/deps

release: venv ## target/release/nightfix, ONNX Runtime beside it.
	scripts/host.sh rust
	$(CARGO) build --locked --release
	scripts/place-onnxruntime.sh $(PY) target/release

# ---- The two commands ----

demo: venv release ## Procedural night flight, played to the running daemon over Zenoh; results in target/demo/.
	DEMO_SEED=$(DEMO_SEED) $(PY) demo/demo.py

test: test-rust test-py parity replay lint ## Everything that must pass.
	@echo "make test: all passed"

# ---- Its parts ----

test-rust: build ## Rust tests: unit, property, the built binary, real Zenoh sessions. No PyTorch.
	$(CARGO) test --locked

test-py: py build ## Python tests.
	$(PY) -m pytest -q demo/tests
	$(PY) -m pytest -q models/tests

parity: py build ## The published network's recorded numbers, reproduced; the Rust pipeline against the Python one.
	$(PY) -m sthn.parity models/tests/data
	$(CARGO) test --locked --test parity --test parity_light -- --ignored

replay: build ## The committed flight through the built binary, with thresholds.
	target/debug/nightfix replay $(FLIGHT) --bundle $(BUNDLE) --out target/replay \
		--min-coverage 0.7 --max-median-m 10 --max-over-50m 0.02

lint: venv ## rustfmt, clippy and ruff; every warning is an error.
	scripts/host.sh lint
	$(CARGO) fmt --check
	$(CARGO) clippy --locked --lib --bins -- -D warnings
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .

format: venv ## Format Rust and Python in place.
	$(CARGO) fmt
	$(VENV)/bin/ruff check --fix --quiet .
	$(VENV)/bin/ruff format .

bench: py release ## Speed of each step beside OpenCV, ONNX Runtime beside PyTorch, as ratios.
	$(PY) models/bench/compare.py

clean: ## Remove what was built (target/); .venv stays.
	rm -rf target
