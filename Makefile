# make demo and make test do all set-up themselves: python3 (3.11), pip and make are enough.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

KERNELS := $(VENV)/.kernels

.PHONY: demo test lint types docs clean

demo: $(STAMP) $(KERNELS)
	$(BIN)/skindb demo --out demo

test: $(STAMP) $(KERNELS)
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports

types: $(STAMP)
	$(BIN)/mypy

docs: $(STAMP)
	$(BIN)/python docs/make_variables.py

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v < (3, 13) else f"skindb needs Python 3.11 or 3.12; {sys.executable} is {v[0]}.{v[1]}; call: make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

# compiled kernels are kept beside their source, and do not see that a kernel they call was changed in another file
$(KERNELS): $(STAMP) $(wildcard skindb/_*.py skindb/*/_*.py)
	find skindb -name '*.nb[ic]' -delete
	touch $@

clean:
	rm -rf $(VENV) demo
