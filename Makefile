# Two commands do all the set-up: `make demo` and `make test`. No root, no network but the package index.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
export NUMBA_CACHE_DIR ?= $(CURDIR)/.cache/numba
unexport PYTHONDONTWRITEBYTECODE  # some hundred programs are started: none compiles all modules anew
JITTED := $(wildcard tests/unit/test_control_*.py tests/contract/test_codec*.py tests/unit/test_drivers*.py) \
    $(wildcard tests/unit/test_guard*.py tests/unit/test_supervisor*.py) tests/unit/test_protocol.py tests/unit/test_cogging.py tests/property \
    tests/closed_loop/test_current_drive.py
NODE_PACKAGES := @mcap/core@2.2.2 fzstd@0.1.1 @foxglove/ws-protocol@0.8.0 ws@8.23.0 \
    @foxglove/studio-base@1.48.0 react@17.0.2 react-dom@17.0.2
# Three calls: what starts no process or needs no clock, the processes in real time, what has the machine for
# itself. With LONG=1 they are all tests, and the longest of the first is the bench machine's.
MARKS := (not process or beside) and not alone
LESS := $(if $(LONG),, and not long)
SPREAD := --maxprocesses=4 --dist=loadfile --no-loadscope-reorder
PARALLEL := --numprocesses=auto $(SPREAD)
# Some of the first call wait for a tick's time: a third worker has two cores' rest. Not beside the bench machine.
FIRST := $(if $(LONG),$(PARALLEL),--numprocesses=3 $(SPREAD))
COVER := --cov=hil.control --cov=hil.tick.supervisor --cov=hil.tick.guard --cov=hil.tick.kernel --cov=drivers.codec --cov=drivers.e2e

.PHONY: docs golden reference gallery demo test lint quick unit interpreted vm clean help crash faults soak fuzz guided mutants node

help: ## show what there is
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(STAMP) ## close the loop against the emulated drive, step the load, replay the log
	$(BIN)/hil demo

test: $(STAMP) lint unit $(if $(LONG),interpreted) ## what must be green before a push; LONG=1: all that must be green

lint: $(STAMP) ## ruff and mypy
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

quick: $(STAMP) lint ## before each commit: lint, types, the fast tests
	$(BIN)/python -m pytest -q $(PARALLEL) -m "$(MARKS) and not process and not slow" tests/unit tests/property tests/closed_loop

unit: $(STAMP) ## the tests, compiled (LONG=1: all)
	$(BIN)/python -m pytest $(FIRST) -m "$(MARKS)$(LESS)"
	$(BIN)/python -m pytest $(PARALLEL) -m "process and not beside and not alone$(LESS)"
	$(BIN)/python -m pytest -m "alone$(LESS)"

# The same kernels with the compiler off: line and branch coverage can see into them.
interpreted: $(STAMP) ## the kernels' tests with the compiler off, with coverage
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -q $(PARALLEL) -m "not process and not vm and not compiled" $(JITTED) \
	    $(COVER) --cov-branch --cov-report=term-missing:skip-covered --cov-fail-under=90

vm: $(STAMP) ## the tests on a real SocketCAN bus (natively or in the bench machine)
	HIL_REQUIRE_VM=1 $(BIN)/python -m pytest -m vm tests/vm

# Others' programs that read what we write; nothing of theirs is run while they install.
node: ## JavaScript packages for the tests that need node, into .cache/node (200 MB)
	@mkdir -p .cache/node
	npm install --prefix .cache/node --save-exact --ignore-scripts --legacy-peer-deps --no-audit --no-fund \
	    --loglevel=error $(NODE_PACKAGES)

gallery: $(STAMP) ## make the pictures of docs/gallery.md anew (needs Chromium)
	$(BIN)/python docs/gallery/make.py

reference: $(STAMP) ## make docs/reference-config.md, the files' schemas and the viewers' layouts anew
	$(BIN)/python -m hil.manual.page docs
	$(BIN)/python -m hil.manual.layouts configs/layouts

docs: $(STAMP) ## the documentation as a site in .cache/site, links checked
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo ".cache/site/index.html"

golden: $(STAMP) ## run the golden scenarios: what changed against the kept logs (KEEP=name, SIGN="reason", ONLY=scenario)
	$(BIN)/python -m tests.golden.rewrite $(if $(KEEP),--keep '$(KEEP)') $(if $(SIGN),--sign '$(SIGN)') $(ONLY)

faults: $(STAMP) ## the fault matrix, every row as expected
	$(BIN)/hil faults configs/faults.toml
	$(BIN)/hil faults configs/faults/moteus.toml
	$(BIN)/hil faults configs/faults/odrive.toml
	$(BIN)/hil faults configs/faults/cia402.toml
	$(BIN)/hil faults configs/faults/dyno.toml
	$(BIN)/hil faults configs/faults/dyno-fac.toml

crash: $(STAMP) ## kill every process of a run, again and again (KILLS=200 SEED=1)
	$(BIN)/python -m tests.crash.kills --kills $(or $(KILLS),200) --seed $(or $(SEED),1)

soak: $(STAMP) ## a long run at 1 kHz: memory, descriptors, threads flat, no drops, replay (SECONDS=600)
	$(BIN)/python -m tests.soak.run --seconds $(or $(SECONDS),600)

fuzz: $(STAMP) ## mutated files, frames, commands and ticks; prints the inputs tried (SECONDS_EACH=10 SEED=1)
	$(BIN)/python -m tests.fuzz.inputs --seconds $(or $(SECONDS_EACH),10) --seed $(or $(SEED),1)

guided: $(STAMP) ## the same with coverage as the guide: needs pip install -e '.[fuzz]' (SECONDS_EACH=60 SEED=1)
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m tests.fuzz.guided --seconds $(or $(SECONDS_EACH),60) --seed $(or $(SEED),1)

mutants: $(STAMP) ## change guard, supervisor, guardian, one place at a time: do tests notice? (SAMPLE=0: all, SEED=1)
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m tests.mutation.mutants --sample $(or $(SAMPLE),0) --seed $(or $(SEED),1)

clean: ## remove the virtual environment and caches
	rm -rf $(VENV) .cache .mypy_cache .ruff_cache .pytest_cache .hypothesis
