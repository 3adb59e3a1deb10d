# make demo, make test and make test-all do all set-up themselves: python3 (3.11 or later), pip and make are enough.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
EXECUTED := docs/_build/notebooks

.PHONY: demo test test-all suite pages readme commands notebooks lint types docs clean

demo: $(STAMP)
	$(BIN)/skindb demo --out demo $(DEMO_OPTIONS)

test: $(STAMP)
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile -m "not slow"

# every test and what pages state (the schema, words, the README's commands, with `make demo`), then the commands
# of the other pages, the notebooks and the site
test-all: $(STAMP)
	$(MAKE) --jobs 3 --output-sync=target readme pages suite
	$(MAKE) --jobs 2 --output-sync=target commands notebooks

# one process more than processors, as tests wait for servers, devices and killed processes
suite: $(STAMP)
	$(BIN)/python -m pytest --numprocesses $$(($$(nproc) + 1)) --dist loadfile --no-loadscope-reorder --durations 40

pages: $(STAMP)
	$(BIN)/python docs/make_variables.py --check
	$(BIN)/python .ci/check_docs.py

readme: $(STAMP)
	$(BIN)/python .ci/check_readme.py

# the commands of the pages and the notebooks, each on a copy of the database of `make demo`
commands: $(STAMP)
	$(BIN)/python .ci/check_commands.py

notebooks: $(STAMP)
	$(BIN)/python .ci/run_notebooks.py
	touch $(EXECUTED)
	$(MAKE) docs

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports

types: $(STAMP)
	$(BIN)/mypy

# the notebooks are executed if they have changed and `make demo` has written their database
docs: $(STAMP) $(if $(wildcard demo/db),$(EXECUTED))
	$(BIN)/python docs/make_variables.py
	rm -rf docs/api/generated
	$(BIN)/python -m sphinx --builder html --jobs auto --fail-on-warning --keep-going --quiet docs docs/_build/html

$(EXECUTED): $(wildcard notebooks/*.ipynb) | $(STAMP)
	$(BIN)/python .ci/run_notebooks.py
	touch $@

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v >= (3, 11) else f"skindb needs Python 3.11 or later; {sys.executable} is {v[0]}.{v[1]}; call: make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	-$(BIN)/python -W ignore -m compileall -qq --workers 0 $(VENV)/lib  # pip would use one processor
	$(BIN)/python -c 'from skindb.fit import compile_kernels; compile_kernels()'
	touch $@

clean:
	rm -rf $(VENV) demo docs/_build docs/api/generated docs/notebooks docs/reference/commands.md
