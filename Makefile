# Two commands matter: `make demo` and `make test`. Each builds its own .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: help demo test check format clean

help:
	@echo "make demo    reconstruct a moving face end to end: service, queue, worker, glTF"
	@echo "make test    run every test"
	@echo "make check   lint (ruff) and types (mypy --strict)"
	@echo "make format  let ruff rewrite the files"
	@echo "make clean   remove .venv and build output"

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Pliant needs Python 3.11 or newer; say make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test,check]'
	touch $@

demo: $(STAMP)
	$(BIN)/pliant demo $(DEMO)

test: $(STAMP)
	$(BIN)/python -m pytest $(TESTS)

# mypy reads the folders under their import names, so it gets a tree of links that has them.
build/typed/pliant:
	mkdir -p $@
	for folder in solver worker service client; do ln -sfn ../../../$$folder $@/$$folder; done

check: $(STAMP) build/typed/pliant
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p pliant

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist *.egg-info
