# Everything a newcomer needs: make demo, make test. Each sets up .venv first when it is missing or out of date.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
# Two set-ups in one .venv: what the demo needs, and on top of it what tests, lint, docs and benchmarks need.
DEMO_STAMP := $(VENV)/.installed-demo
STAMP := $(VENV)/.installed
SOURCES := pyproject.toml hatch_build.py $(wildcard kbmaps/csrc/*)
PIP := $(BIN)/python -m pip install --disable-pip-version-check --quiet --only-binary pybullet --require-hashes
export OPENBLAS_NUM_THREADS ?= 1
# Without bytecode on the disk each process would compile all that it imports.
export PYTHONDONTWRITEBYTECODE :=

BENCH_BUDGET_S ?= 120
PEERS_BUDGET_S ?= 240
GOALS_BUDGET_S ?= 3600
SMOKE := tests/interfaces tests/effects tests/examples tests/kbmaps/test_rigid_learner.py tests/kbmaps/test_kernels.py \
	tests/drivers/test_dynamixel_bus.py tests/vision/test_colour_model.py tests/sim_backend/test_sim_postures.py \
	tests/diagnosis/test_vergence.py tests/daemon/test_sampler.py tests/daemon/test_learner.py tests/system/test_poisoned_pairs.py

.PHONY: help setup demo test smoke check docs soak bench peers goals lock wheel clean

help:           ## Show this list
	@grep -E '^[a-z]+: .*##|^[a-z]+:  *##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

setup: $(STAMP) ## Set up .venv with everything; the command is then .venv/bin/bodyschema

$(DEMO_STAMP): $(SOURCES) requirements-demo.lock
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info[:2] == (3, 11) else "bodyschema is developed with Python 3.11 (its simulator, pybullet, has wheels for no newer one). Install python3.11, or name it: make PYTHON=/path/to/python3.11 ...")'
	@echo "Setting up $(VENV) (about 230 MB are downloaded the first time; half a minute)"
	@test -x $(BIN)/python || { $(PYTHON) -m venv $(VENV) && $(BIN)/python -m pip uninstall --quiet --yes setuptools; }
	@$(PIP) --no-compile -r requirements-demo.lock
	@$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation -e .
	@$(BIN)/python -c 'import kbmaps; print("kernels of kbmaps:", kbmaps.kernels_in_use())'
	@touch $@

$(STAMP): $(DEMO_STAMP) requirements.lock
	@echo "Adding the tools for tests, lint and docs (about 200 MB are downloaded the first time; one minute)"
	@$(PIP) --no-compile -r requirements.lock
	@# To tests every warning is an error, those of compiling other people's modules, too.
	@$(BIN)/python -W ignore -m compileall -q -j 0 $(VENV)/lib >/dev/null || true
	@touch $@

demo: $(DEMO_STAMP) ## Watch the whole thing learn in simulation, about a minute
	@$(BIN)/bodyschema demo

test: setup     ## Run the tests
	@$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

smoke: setup    ## A few tests of everything, in less than a minute
	@$(BIN)/python -m pytest -n auto --dist loadfile $(SMOKE)

check: setup    ## Lint: ruff, pyright, import-linter
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright
	@$(BIN)/lint-imports

docs: setup     ## The docs as a site, into site/; look at it with: python -m http.server -d site
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

soak: setup     ## The long tests: many seeds, many kills, properties with other examples
	@$(BIN)/python -m pytest -m "soak or hypothesis" --hypothesis-profile soak --timeout 3600 -o faulthandler_timeout=3600

bench: setup    ## Side-by-side figures, as ratios within one run; each for BENCH_BUDGET_S at most, an hour in all
	@for file in $$(grep -l __main__ benchmarks/[a-z]*.py); do \
		echo; echo "== $$file"; \
		timeout $(BENCH_BUDGET_S) $(BIN)/python -u $$file; code=$$?; \
		if [ $$code -eq 124 ]; then echo "-- stopped after $(BENCH_BUDGET_S) s; all of it: $(BIN)/python $$file"; \
		elif [ $$code -ne 0 ]; then exit $$code; fi; \
	done
	@$(MAKE) --no-print-directory peers

peers: setup    ## Our learners beside others on one page, peers.html; goes on where the last run stopped
	@$(BIN)/python -m benchmarks.peers --budget-s $(PEERS_BUDGET_S)

goals: setup    ## What was to be reached beside what is; goes on where the last run stopped
	@$(BIN)/python -m benchmarks.goals --budget-s $(GOALS_BUDGET_S)

# All but rerun and pinocchio, which are large and serve one test each.
EXTRAS := cameras sim plots export bags view fleet bench docs editable dev
LOCK := --quiet --python-version 3.11 --generate-hashes --no-emit-index-url --no-annotate --no-header
lock:           ## Renew both lock files from pyproject.toml
	@$(BIN)/python -m pip install --disable-pip-version-check --quiet uv
	@$(BIN)/uv pip compile $(LOCK) --upgrade $(addprefix --extra ,$(EXTRAS)) pyproject.toml -o requirements.lock
	@$(BIN)/uv pip compile $(LOCK) --extra sim --extra editable --constraint requirements.lock pyproject.toml -o requirements-demo.lock

wheel: setup    ## Build the wheel into dist/
	@$(BIN)/python -m build --no-isolation --wheel

clean:          ## Remove .venv and what was built
	rm -rf $(VENV) dist build kbmaps/_kernels.abi3.so
