# Two commands on a fresh machine: `make demo` trains a scene, `make test` runs the checks.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test torture docs bench wheel clean

demo: $(VENV)/installed
	$(BIN)/clsplat data synthetic demo/scene
	$(BIN)/clsplat run quickstart --scene demo/scene --out demo/run --resume

test: $(VENV)/tested-with
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(MAKE) docs
	$(BIN)/python -m pytest --numprocesses 2

torture: $(VENV)/tested-with
	$(BIN)/python -m tests.torture --write

docs: $(VENV)/tested-with
	$(BIN)/python docs/collect.py
	$(BIN)/zensical build --strict --clean

bench: $(VENV)/installed
	$(BIN)/clsplat bench

wheel: $(VENV)/tested-with
	$(BIN)/python -m build --wheel --outdir dist .

clean:
	rm -rf $(VENV) demo build dist .cache *.egg-info

# The embedded runtime is PoCL; where it does not know the processor or finds no linker, Intel's takes its place, and
# `clsplat devices` says why.
$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	for extras in '[pocl]' ''; do $(BIN)/python -m pip install --quiet --editable ".$$extras" && break; done
	$(BIN)/clsplat devices || { $(BIN)/python -m pip install --quiet '.[intel]' && $(BIN)/clsplat devices; }
	touch $@

$(VENV)/tested-with: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --editable '.[dev,docs]'
	touch $@
