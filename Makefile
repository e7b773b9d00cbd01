# Two commands on a bare machine with Python >= 3.11 and make:
#   make compare    the main job: a table and figures in results/
#   make test       the tests
# Both set up .venv first, under the pins of constraints.txt, and only when something changed.

PYTHON ?= python3
# Passed on to the command: make compare ARGS="--episodes 1000", make test ARGS="-k scenario"
ARGS ?=
# Processes that share the episodes of `compare` and `frontier`; the numbers do not depend on it.
# (nproc heeds OMP_NUM_THREADS, which is about threads.)
WORKERS ?= $(shell env -u OMP_NUM_THREADS nproc 2>/dev/null || sysctl -n hw.ncpu 2>/dev/null || echo 1)
# Processes that share the tests.
TESTERS ?= 2
# Options of pip for torch alone, say --index-url with the address of a CPU-only build.
TORCH_ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
# Errors alone: the warnings are about setuptools' opinion of its own features.
PIP := $(BIN)/python -m pip -qq install
PACKAGES := package envs planner baselines evaluation
# torch comes first and exactly: whatever asked for it otherwise would take the newest build,
# with gigabytes of CUDA packages.
TORCH := torch==2.13.0

# The editable install is a tree of links to the package's files under build/, so it is renewed
# when a file came or went, as well as when requirements or pins changed. A name in build/ and a
# prerequisite in .venv/: deleting either folder is enough to start afresh.
STATE := $(shell { cat pyproject.toml constraints.txt; \
	find $(PACKAGES) -name __pycache__ -prune -o -type f -print | LC_ALL=C sort; } 2>/dev/null \
	| cksum | cut -d' ' -f1)
PLACE := $(shell pwd | cksum | cut -d' ' -f1)
CREATED := $(VENV)/created-$(PLACE)
INSTALLED := build/installed-$(STATE)
BENCH_INSTALLED := build/installed-bench-$(STATE)
DOCS_INSTALLED := build/installed-docs-$(STATE)

.PHONY: help install compare suites frontier reproduce report kills matrix test test-long fuzz train bench bench-worlds bench-docs docs docs-serve docs-check lint types lock peers clean
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*## ' Makefile | sort | sed -E 's/:.*## /:/' \
		| while IFS=: read -r name text; do printf '  make %-12s %s\n' "$$name" "$$text"; done
	@echo '  options: ARGS="..." for the command, PYTHON=python3.12 for a new $(VENV)'

install: $(INSTALLED)  ## set up .venv (every other target does it when needed)

compare: $(INSTALLED)  ## the main job: SCP, feedback and PPO over the same noise; results/compare
	$(BIN)/slipcar compare --workers $(WORKERS) $(ARGS)

suites: $(INSTALLED)  ## held-out worlds, from dry to slippery, nodes and substeps; results/random, slip, horizon
	$(BIN)/slipcar compare --suite random --workers $(WORKERS) $(ARGS)
	$(BIN)/slipcar compare --suite slip --workers $(WORKERS) $(ARGS)
	$(BIN)/slipcar compare --suite horizon --workers $(WORKERS) $(ARGS)

reproduce: $(INSTALLED)  ## the paper's claims, one by one; results/reproduce
	$(BIN)/slipcar reproduce --workers $(WORKERS) $(ARGS)

report: $(INSTALLED)  ## one page of everything in results/: results/report.html
	$(BIN)/slipcar report results $(ARGS)

kills: $(INSTALLED)  ## kill a comparison 20 times at random moments: is anything lost?
	$(BIN)/python benchmarks/kills.py $(ARGS)

# Environments of its own, with PyPI, apart from .venv. torch for Python 3.11 alone: elsewhere pip
# would take a build of gigabytes.
matrix:  ## oldest and newest versions of every dependency, Python 3.11 to 3.14 where they are
	SDL_VIDEODRIVER=dummy $(PYTHON) benchmarks/matrix.py --torch $(TORCH) $(ARGS)

test: $(INSTALLED)  ## all tests but the long ones
	$(BIN)/python -m pytest -n $(TESTERS) $(ARGS)

test-long: $(INSTALLED)  ## the tests that take minutes
	$(BIN)/python -m pytest -m long --timeout 0 $(ARGS)

fuzz: $(BENCH_INSTALLED)  ## random problems, worlds, options and files before an independent judge, minutes
	PYTHONPATH=tests $(BIN)/python -m fuzz $(ARGS)

frontier: $(INSTALLED)  ## what safety costs: effort against collision rate; results/frontier
	$(BIN)/slipcar frontier --workers $(WORKERS) $(ARGS)

train: $(INSTALLED)  ## train the PPO baseline; runs/ppo
	$(BIN)/slipcar train $(ARGS)

bench: $(BENCH_INSTALLED)  ## time the planner beside its peers, environments, evaluation; results/bench
	$(BIN)/python benchmarks/run.py $(ARGS)

bench-worlds: $(BENCH_INSTALLED)  ## plan for 1000 random worlds, ours and IPOPT; results/bench
	$(BIN)/python benchmarks/run.py --only worlds $(ARGS)

bench-docs: $(BENCH_INSTALLED)  ## every benchmark once more, into docs/benchmarks*.md
	$(BIN)/python benchmarks/run.py --docs $(ARGS)

docs: $(DOCS_INSTALLED)  ## the documentation site, notebooks executed; site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict $(ARGS)

docs-serve: $(DOCS_INSTALLED)  ## the site at http://127.0.0.1:8000, built anew when a page changes
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve $(ARGS)

docs-check: docs  ## the site in a browser: accessible (axe), nothing fetched, links that lead somewhere
	$(BIN)/python docs/hooks/check.py site $(ARGS)

lint: types  ## ruff (rules and format), mypy and pyright
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: $(INSTALLED)  ## mypy over the installed package; mypy and pyright over a user's script
	$(BIN)/mypy
	$(BIN)/mypy tests/typing/user_script.py
	$(BIN)/basedpyright

# The arrays are small, a second BLAS thread brings nothing; and times then mean one core.
compare suites frontier reproduce kills matrix test test-long fuzz train bench bench-worlds bench-docs docs docs-serve: export OMP_NUM_THREADS ?= 1

$(CREATED):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo 'slipcar needs Python >= 3.11: make PYTHON=/path/to/python3' >&2; exit 1; }
	@echo 'Setting up $(VENV) once, a few minutes: torch (the largest download) ...'
	@$(PYTHON) -m venv --clear $(VENV)
	@$(PIP) 'pip>=25.1'
	@$(PIP) $(TORCH_ARGS) -c constraints.txt $(TORCH)
	@touch $@

$(INSTALLED): $(CREATED)
	@echo 'Installing slipcar with its extras and tools ...'
	@rm -rf build/installed-* build/__editable__.*
	@$(PIP) -c constraints.txt 'setuptools>=77'
	@$(PIP) -c constraints.txt --no-build-isolation --group dev --editable '.[all]'
	@touch $@

$(BENCH_INSTALLED): $(INSTALLED)
	@echo 'Installing what the benchmarks compare with ...'
	@$(PIP) -c constraints.txt 'slipcar[bench]'
	@touch $@

$(DOCS_INSTALLED): $(INSTALLED)
	@echo 'Installing what the documentation site is built with ...'
	@$(PIP) -c constraints.txt 'slipcar[docs]'
	@touch $@

# Their requirements contradict our pins: they run as workers of the benchmark in a venv of their own.
peers:  ## add crocoddyl and OpenSCvx to `make bench` (2 GB)
	$(PYTHON) -m venv build/peers
	build/peers/bin/python -m pip -qq install crocoddyl openscvx

# The newest versions that pyproject.toml admits, tried out in a venv of their own, become the
# pins. The local part of torch's version is dropped, so that any build of it will do.
lock:  ## renew constraints.txt with the newest versions that pyproject.toml admits
	rm -rf build/lock
	$(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip -qq install 'pip>=25.1'
	build/lock/bin/python -m pip -qq install $(TORCH_ARGS) $(TORCH)
	build/lock/bin/python -m pip -qq install --group dev '.[all,bench,docs]'
	build/lock/bin/python -m pip freeze --all --exclude pip --exclude slipcar > build/lock/pins
	{ echo '# Made by `make lock`: do not edit.'; \
		sed -E 's/^(torch==[^+]*)\+.*/\1/' build/lock/pins; } > constraints.txt
	rm -rf build/lock

clean:  ## remove everything that make made, results and runs excepted
	rm -rf $(VENV) build dist site slipcar.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
