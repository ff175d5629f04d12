# Two commands on a bare machine with Python 3.11 or newer: `make demo` and `make test`.
# PYTHON=… chooses the interpreter, EXTRAS=dev,demo,view,onnx,experiments,cuda13 what is installed, OUT=… the demo's folder.
# The demo installs only what it runs with (DEMO_EXTRAS=demo,cuda13 …), and leaves byte code to the first import; the tests add the rest.

VENV := .venv
EXTRAS ?= dev,demo,view,onnx,experiments
DEMO_EXTRAS ?= demo
OUT ?= demo_out
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
DEMO_STAMP := $(VENV)/installed-demo
export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/.jax_cache

.PHONY: demo test slow bench check format docs install lock clean

demo: $(if $(wildcard $(STAMP)),$(STAMP),$(DEMO_STAMP))
	$(BIN)/ltgs demo --out $(OUT)

test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

slow: $(STAMP)
	$(BIN)/python -m pytest -m slow $(ARGS)

bench: $(STAMP)
	$(BIN)/python -m experiments.bench --quick

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

install: $(STAMP)

$(STAMP): pyproject.toml requirements.lock .ci/make-venv
	.ci/make-venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[$(EXTRAS)]'
	touch $@

$(DEMO_STAMP): pyproject.toml requirements.lock .ci/make-venv
	.ci/make-venv $(VENV)
	$(BIN)/python -m pip install --no-compile --quiet --disable-pip-version-check -c requirements.lock -e '.[$(DEMO_EXTRAS)]'
	touch $@

lock: $(STAMP)
	.ci/write-lock $(BIN)/python $(EXTRAS)

clean:
	rm -rf $(VENV) .jax_cache .pytest_cache .ruff_cache site $(OUT)
