# Needs Python >= 3.11 and nothing else: 'make race', 'make test'.
#
#   make race ARGS="--track random:7"     arguments of 'bayesrace race'; 'make race ARGS=--help' lists them
#   make test ARGS="-m 'not slow'"        arguments of pytest
#   make race PYTHON=/opt/python/bin/python3.12

VENV := .venv
BIN := $(VENV)/bin
ARGS ?=

# The first interpreter that is new enough; some systems call their old one python3.
PYTHON ?= $(shell for python in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& echo $$python && break; done)

# Versions as tested. The build backend comes from the same list, so pip must not fetch its own.
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
PROJECT := --no-build-isolation --editable

.PHONY: help race test lint bench clean

help:
	@echo "make race    set up, and drive the whole comparison; leaves runs/DATE-TIME"
	@echo "make test    set up for development, and run all tests"
	@echo "make lint    ruff, mypy, import contracts"
	@echo "make bench   time the compiled step beside CasADi + IPOPT"
	@echo "make clean   remove the virtual environment and all caches in this folder"

race: $(VENV)/.ready
	$(BIN)/bayesrace race $(ARGS)

bench: $(VENV)/.ready
	$(BIN)/bayesrace bench $(ARGS)

# First what may share the processors, then the rest, test by test; plain pytest does all of them in
# one go, for debugging. 5 means that ARGS selects no test of a part.
SIDE_BY_SIDE := --numprocesses auto --maxprocesses 8 --dist loadfile
test: $(VENV)/.ready-dev
	@$(BIN)/python -m pytest --part shared $(SIDE_BY_SIDE) $(ARGS); shared=$$?; \
	$(BIN)/python -m pytest --part alone $(ARGS); alone=$$?; \
	for code in $$shared $$alone; do [ $$code -eq 0 ] || [ $$code -eq 5 ] || exit $$code; done; \
	[ $$shared -ne 5 ] || [ $$alone -ne 5 ] || { echo "ARGS selects no test" >&2; exit 5; }

lint: $(VENV)/.ready-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.created:
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "BayesRace needs Python 3.11 or newer; '$(or $(PYTHON),python3)' is not" \
			"($$("$(or $(PYTHON),python3)" --version 2>&1))." \
			"Name one with 'make PYTHON=/path/to/python3.12 ...'." >&2; exit 1; }
	@echo "virtual environment: $(VENV)"
	rm -rf $(VENV)
	"$(PYTHON)" -m venv $(VENV)
	@touch $@

# A machine without a C compiler gets one from PyPI; codegen finds it by itself.
$(VENV)/.ready: $(VENV)/.created pyproject.toml constraints.txt
	$(PIP_INSTALL) hatchling editables
	@extra='[zig]'; for compiler in "$${CC-}" cc gcc clang; do \
		[ -n "$$compiler" ] && command -v $$compiler >/dev/null && extra= && break; done; \
	[ -z "$$extra" ] || echo "no C compiler here: installing ziglang"; \
	set -x; $(PIP_INSTALL) $(PROJECT) ".$$extra"
	@touch $@

# The tests build with ziglang as well as with the system's compiler.
$(VENV)/.ready-dev: $(VENV)/.ready
	$(PIP_INSTALL) $(PROJECT) '.[dev,zig]'
	@touch $@
