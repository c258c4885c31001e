# Needs Python >= 3.11 and nothing else: 'make race', 'make test'.
#
#   make race ARGS="--track random:7"     arguments of 'bayesrace race'; 'make race ARGS=--help' lists them
#   make test ARGS="-k takeover"          arguments of pytest
#   make race PYTHON=/opt/python/bin/python3.12

VENV := .venv
BIN := $(VENV)/bin
ARGS ?=

# The first interpreter that is new enough; some systems call their old one python3.
PYTHON ?= $(shell for python in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& echo $$python && break; done)

# Packages are compiled to bytecode by the process that first imports them, not while installing,
# which would compile ten times as many. That needs bytecode to be written.
unexport PYTHONDONTWRITEBYTECODE

# Versions as tested. The build backend comes from the same list, so pip must not fetch its own.
PIP_INSTALL := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check \
	-c constraints.txt
PROJECT := --no-build-isolation --editable

START := $(shell date +%s)
TOOK = echo "make $@: $$(($$(date +%s) - $(START))) s"

.PHONY: help race paper test check tools rest lint docs coverage bench hashes release clean

help:
	@echo "make race    set up, and drive the whole comparison; leaves runs/DATE-TIME"
	@echo "make paper   every figure and number of the paper on one page: runs/paper/paper.html"
	@echo "make test    set up for testing, and run most tests, in a few minutes"
	@echo "make check   everything: lint, docs, all tests; names the tools that it needs"
	@echo "make lint    ruff, clang-format, mypy, import contracts"
	@echo "make docs    the documentation as a site: build/site/index.html"
	@echo "make coverage  lines and branches of Python and C that tests which compute execute"
	@echo "make bench   time the compiled step beside CasADi + IPOPT"
	@echo "make hashes  write constraints.hashed.txt, after a change of constraints.txt"
	@echo "make release wheel, source, list of packages (SBOM) and checksums: build/release"
	@echo "make clean   remove the virtual environment and all caches in this folder"

race: $(VENV)/.ready
	$(BIN)/bayesrace race $(ARGS)

paper: $(VENV)/.ready
	$(BIN)/bayesrace paper $(ARGS)

bench: $(VENV)/.ready
	$(BIN)/bayesrace bench $(ARGS)

# First the tests that compute, one a processor; then those with processes in real time, which mostly
# wait. What fails beside others, whose work may have made it late, is run again, alone, and that
# counts. -m selects the tier and comes last. 5 means that ARGS selects no test of a part.
TIER = not check
# Pairs of processes in real time that run at once.
PAIRS = 3
PYTEST = $(BIN)/python -m pytest --dist worksteal
define RUN_TESTS
	@$(PYTEST) --numprocesses auto --maxprocesses 8 $(ARGS) -m "($(TIER)) and not wall_clock"; \
	computing=$$?; \
	$(PYTEST) --numprocesses $(PAIRS) $(ARGS) -m "($(TIER)) and wall_clock"; meeting=$$?; \
	if [ $$computing -eq 1 ] || [ $$meeting -eq 1 ]; then \
		echo "What failed, again, alone:"; \
		$(PYTEST) --last-failed --maxfail 1 $(ARGS) -m "$(TIER)"; again=$$?; \
		[ $$again -ne 5 ] || again=1; \
		[ $$computing -ne 1 ] || computing=$$again; [ $$meeting -ne 1 ] || meeting=$$again; \
	fi; $(TOOK); \
	for code in $$computing $$meeting; do [ $$code -eq 0 ] || [ $$code -eq 5 ] || exit $$code; done; \
	[ $$computing -ne 5 ] || [ $$meeting -ne 5 ] || { echo "ARGS selects no test" >&2; exit 5; }
endef

test: $(VENV)/.ready-test
	$(RUN_TESTS)

# What 'make test' runs, then the rest of the tests, which finds again what the former has driven.
check: export TEST_SESSION = $(CURDIR)/build/session
check: tools $(VENV)/.ready-dev
	@rm -rf build/session
	@$(MAKE) --no-print-directory lint
	@$(MAKE) --no-print-directory docs
	$(BIN)/python -m benchmarks.numbers check
	@$(MAKE) --no-print-directory test
	@$(MAKE) --no-print-directory rest
	@$(TOOK)

tools:
	@.ci/tools

rest: TIER = check
rest: $(VENV)/.ready-dev
	$(RUN_TESTS)

# Of the tests that compute: measuring makes Python two to three times slower, too slow for real time.
coverage: $(VENV)/.ready-dev
	rm -rf build/coverage
	$(BIN)/coverage run -m pytest --dist worksteal --numprocesses auto --maxprocesses 8 \
		-m "not check and not wall_clock"
	find build/coverage -name 'data.*' -empty -delete # of processes that tests have killed
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report --skip-covered
	$(BIN)/python -m tests.native_coverage

lint: $(VENV)/.ready-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run -Werror $$(git ls-files '*.c' '*.h')
	$(BIN)/mypy
	$(BIN)/lint-imports

# The theme would advertise its successor.
docs: export NO_MKDOCS_2_WARNING = 1
docs: $(VENV)/.ready-dev
	$(BIN)/mkdocs build --strict --quiet

# Of the files of all platforms, no host is named.
hashes: $(VENV)/.ready-dev
	$(BIN)/uv pip compile --quiet --no-config --no-deps --generate-hashes --no-annotate --universal \
		--python-version 3.11 --custom-compile-command 'make $@' --output-file constraints.hashed.txt constraints.txt

# The list is of what users install with all extras, here in an environment of its own, checked by hashes.
RELEASE := build/release
LISTED := build/release-env
release: $(VENV)/.ready-dev
	rm -rf $(RELEASE) $(LISTED)
	$(BIN)/python -m hatchling build -d $(RELEASE)
	$(BIN)/uv venv --quiet --no-config $(LISTED)
	$(BIN)/uv pip install --quiet --no-config --python $(LISTED) -c constraints.hashed.txt \
		"bayesrace[campaign,fmu,slipx,zig] @ $$(ls $(RELEASE)/*.whl)"
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible \
		--output-file $(RELEASE)/bayesrace.cdx.json $(LISTED)
	cp constraints.hashed.txt $(RELEASE)
	cd $(RELEASE) && sha256sum * > SHA256SUMS

clean:
	rm -rf $(VENV) build .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.created:
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "BayesRace needs Python 3.11 or newer; '$(or $(PYTHON),python3)' is not" \
			"($$("$(or $(PYTHON),python3)" --version 2>&1))." \
			"Name one with 'make PYTHON=/path/to/python3.12 ...'." >&2; exit 1; }
	@test -d bayesrace/controller || { \
		echo "bayesrace/controller is a file, not a link to a folder: clone again on a system with symbolic" \
			"links, with 'git clone -c core.symlinks=true'; do not unpack with Python's zipfile." >&2; exit 1; }
	@echo "virtual environment: $(VENV)"
	rm -rf $(VENV)
	"$(PYTHON)" -m venv $(VENV)
	@touch $@

# A machine without a C compiler gets one from PyPI; codegen finds it by itself.
ZIG := $(shell for compiler in "$${CC-}" cc gcc clang; do \
	[ -n "$$compiler" ] && command -v $$compiler >/dev/null && exit; done; echo ,zig)
INSTALL = $(PIP_INSTALL) hatchling editables && $(PIP_INSTALL) $(PROJECT)
SHAPED_BY := $(VENV)/.created pyproject.toml constraints.txt

NO_COMPILER = $(if $(ZIG:,%=%),@echo "no C compiler here: installing ziglang")

$(VENV)/.ready: $(SHAPED_BY)
	$(NO_COMPILER)
	$(INSTALL) ".[race$(ZIG)]"
	@touch $@

$(VENV)/.ready-test: $(SHAPED_BY)
	$(NO_COMPILER)
	$(INSTALL) ".[test$(ZIG)]"
	@touch $@ $(VENV)/.ready

# ziglang also where there is a compiler: the FMUs for other platforms are built with it.
$(VENV)/.ready-dev: $(SHAPED_BY)
	$(INSTALL) ".[dev]"
	@touch $@ $(VENV)/.ready-test $(VENV)/.ready
