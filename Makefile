# Two commands do everything from a fresh clone: `make train` and `make test`. `make benchmark` reproduces a comparison.

PYTHON ?= python3
VENV ?= .venv
TASK ?= HalfCheetah
NOISE ?= 0.1
STEPS ?= 50000
SEED ?= 0
RUNS ?= runs
SUITE ?= smoke
# EARLIER is its former name
REUSE_RESULTS ?= $(EARLIER)
WORKERS ?= auto
ARGS ?=

BIN := $(VENV)/bin
CODE := sb3_gac benchmarks tests
REUSED := $(if $(REUSE_RESULTS),--reuse-results $(REUSE_RESULTS))

.PHONY: train test mutants benchmark figure table format lint type clean

$(VENV)/.installed: setup.cfg pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

train: $(VENV)/.installed  ## train GAC, evaluate the learner on partial alone, save everything under runs/
	$(BIN)/python -m sb3_gac.train --task $(TASK) --noise $(NOISE) --steps $(STEPS) --seed $(SEED) --runs $(RUNS) $(ARGS)

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

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix $(CODE)
	$(BIN)/black $(CODE)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check $(CODE)
	$(BIN)/black --check $(CODE)

type: $(VENV)/.installed-dev
	$(BIN)/mypy

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
