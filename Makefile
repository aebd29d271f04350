# make demo    installs the package in .venv and rolls out the bundled garments (out/demo/)
# make test    installs what the tests need and runs them
# make dist    builds sdist and wheel (dist/), and runs the demo from the wheel in an empty environment
# make lint    ruff, and .ci/check_tree.py: types, directions of imports, folders, files
# make docs    builds the documentation in build/site, strictly, and checks its links
# make bench   times a rollout by stage on this machine
# make gpu     on a machine with a GPU: what it computes beside a CPU, then all benchmarks
#
# PYTHON  interpreter the environment is made with           make demo PYTHON=python3.12
# TORCH   what to give pip install for torch (a GPU build)   make demo TORCH="torch --index-url ..."
# DEVICE  where the demo runs; by default a GPU if there is one

PYTHON ?= python3
TORCH ?= $(shell grep '^torch==' constraints.txt)
DEVICE ?=
WORKERS ?= 2
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --disable-pip-version-check --quiet
# torch is installed first and by itself; left in, its line would contradict another TORCH
CONSTRAINTS := $(VENV)/constraints.txt

.PHONY: demo test dist lint docs bench gpu clean
.DELETE_ON_ERROR:

demo: $(VENV)/.demo
	$(BIN)/warpgarment demo --out out/demo $(if $(DEVICE),--device $(DEVICE))

test: $(VENV)/.test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal tests

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python .ci/check_tree.py

dist: $(VENV)/.test
	$(BIN)/python .ci/check_dist.py dist

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --clean
	$(BIN)/python .ci/check_site.py build/site

bench: $(VENV)/.demo
	$(BIN)/warpgarment bench $(if $(DEVICE),--device $(DEVICE))

gpu: $(VENV)/.test
	$(BIN)/python -m pytest tests/sim/test_on_gpu.py tests/sim/test_frames_on_device.py tests/kernels/test_cuda_compilation.py
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) out build dist

$(VENV)/.torch: constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) $(TORCH)
	grep -v '^torch==' constraints.txt > $(CONSTRAINTS)
	@touch $@

$(VENV)/.demo: $(VENV)/.torch pyproject.toml
	$(PIP) -c $(CONSTRAINTS) -e '.[usd,view]'
	@touch $@

$(VENV)/.docs: $(VENV)/.torch pyproject.toml
	$(PIP) -c $(CONSTRAINTS) -e '.[docs]'
	@touch $@

$(VENV)/.test: $(VENV)/.torch pyproject.toml
	$(PIP) -c $(CONSTRAINTS) -e '.[dev,usd,alembic,view,browser,train,physics,hub]'
	@touch $@
