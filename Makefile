# Two commands do everything from a fresh clone: `make train` and `make test`. `make` or `make help` lists all.

PYTHON ?= python3
VENV ?= .venv
SUITE ?= smoke
# EARLIER is its former name
REUSE_RESULTS ?= $(EARLIER)
WORKERS ?= auto
ARGS ?=

BIN := $(VENV)/bin
CODE := sb3_gac benchmarks tests examples docs
REUSED := $(if $(REUSE_RESULTS),--reuse-results $(REUSE_RESULTS))

# What is given on the command line; all else has the program's own default
TRAIN := $(foreach name,TASK NOISE STEPS SEED RUNS,$(if $($(name)),--$(shell echo $(name) | tr A-Z a-z) $($(name))))

.DEFAULT_GOAL := help
.PHONY: help train test mutants benchmark figure table docs package format lint type clean

help:  ## list what can be made, and the variables that it takes
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## (.*)/  make \1\t\2/' | expand -t 20
	@echo
	@echo 'Variables, as in "make train TASK=Ant NOISE=0.3 STEPS=200000 SEED=1":'
	@echo '  TASK NOISE STEPS SEED RUNS   of train; those left out have the defaults of "make train ARGS=--help"'
	@echo '  SUITE REUSE_RESULTS          of benchmark: a file in benchmarks/suites/ ($(SUITE)), results that count'
	@echo '  WORKERS                      of test: processes ($(WORKERS))'
	@echo '  N                            of figure and table: its number in the paper'
	@echo '  ARGS                         of train, test, mutants and figure: more options, such as ARGS="--resume runs/..."'
	@echo '  PYTHON VENV                  which Python ($(PYTHON)), and where its packages go ($(VENV))'

$(VENV)/.installed: setup.cfg pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $@

train: $(VENV)/.installed  ## train GAC, evaluate the learner on partial alone, save everything in runs/
	$(BIN)/python -m sb3_gac.train $(TRAIN) $(ARGS)

test: $(VENV)/.installed-dev  ## run the tests, several at a time
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist worksteal $(ARGS)

mutants: $(VENV)/.installed-dev  ## would the tests notice? put in deliberate faults, one at a time
	$(BIN)/python -m tests.mutate $(ARGS)

benchmark: $(VENV)/.installed-dev  ## runs of a suite, resumed if need be, to figure, tables and page in benchmarks/results/
	$(BIN)/python -m benchmarks.launch benchmarks/suites/$(SUITE).yml $(REUSED)
	$(BIN)/python -m benchmarks.aggregate benchmarks/suites/$(SUITE).yml $(REUSED) --out benchmarks/results/$(SUITE)
	$(BIN)/python -m benchmarks.report benchmarks/results/$(SUITE)

figure: $(VENV)/.installed-dev  ## a figure of the paper by number (N=1 to 12), from committed results; ARGS=--run makes those that are missing
	$(BIN)/python -m benchmarks.paper figure $(N) $(ARGS)

table: $(VENV)/.installed-dev  ## a table of the paper by number (N=2 to 8), and ours beside it
	$(BIN)/python -m benchmarks.paper table $(N)

docs: $(VENV)/.installed-docs  ## the documentation as a site, build/site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict --site-dir build/site

package: $(VENV)/.installed-dev  ## a wheel and an sdist in dist/, which pip installs anywhere
	$(BIN)/python -m build --outdir dist .

format: $(VENV)/.installed-dev  ## put the code in its form
	$(BIN)/ruff check --fix $(CODE)
	$(BIN)/black $(CODE)

lint: $(VENV)/.installed-dev  ## is the code in its form?
	$(BIN)/ruff check $(CODE)
	$(BIN)/black --check $(CODE)

type: $(VENV)/.installed-dev  ## check types
	$(BIN)/mypy

clean:  ## remove what was installed and built
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
