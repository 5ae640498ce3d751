# `make sweep` runs the main job, `make reproduce` the paper's evaluation, `make test` the tests; all set up what they need first. More arguments: make sweep ARGS="..."
SHELL := /bin/bash
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready
ARGS ?=
REPRODUCED ?= results/reproduce

.PHONY: sweep reproduce label test test-long docs film benchmark readme publish lint lock setup
.DEFAULT_GOAL := sweep

sweep: $(READY)
	$(BIN)/python -m peps_jax.sweep $(ARGS)

# the paper's evaluation; ARGS="table1 --seeds 3" for less of it
reproduce: $(READY)
	$(BIN)/python -m peps_jax.reproduce $(ARGS)

# one person teaches an agent in the browser
label: $(READY)
	$(BIN)/python -m peps_jax.human_study label $(ARGS)

test: $(READY)
	$(BIN)/python -m pytest -n logical --maxprocesses 4 --dist worksteal --durations 10 $(ARGS)

# those that take a minute or more each
test-long: $(READY)
	$(BIN)/python -m pytest -m long -n logical --maxprocesses 4 --dist worksteal --durations 10 $(ARGS)

# the pages under docs/ and the API's reference as a site in site/; a warning is an error
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --site-dir site $(ARGS)

film: $(READY)
	$(BIN)/python benchmarks/film.py $(ARGS)

# beside other libraries, which it installs under benchmarks/.peers; ARGS="--quick" for a little of everything
benchmark: $(READY)
	$(BIN)/python benchmarks/speed.py $(ARGS)

readme: $(READY)
	$(BIN)/python benchmarks/readme.py

# what README shows of `make reproduce`, from its folder
publish: $(READY)
	cp $(filter-out %/figure1.csv %/figure2.csv,$(wildcard $(addprefix $(REPRODUCED)/,*.md *.csv figure3.json *.png *.gif))) \
		benchmarks/results/
	$(BIN)/python benchmarks/readme.py

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

setup: $(READY)

# redone only when what is installed would change
$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo 'peps_jax needs Python 3.11 or newer: make PYTHON=/path/to/python3.11 (or newer)' >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

# new versions of everything, for every platform; hatchling builds the package
lock: $(READY)
	$(BIN)/pip install --quiet uv
	echo hatchling | $(BIN)/uv pip compile --upgrade --universal --no-header --no-annotate --no-emit-index-url \
		--no-emit-find-links --extra test --extra docs pyproject.toml - --output-file requirements.lock
