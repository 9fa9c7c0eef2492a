# Each target builds its own .venv from nothing but python3 and pip.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOURCES := $(shell find datasets twin fusion -name '*.py' -o -name '*.yaml' -o -name '*.[ch]' -o -name '*.j2' -o -name '*.css') pyproject.toml README.md

.PHONY: demo test lint docs dist help clean

help:
	@echo "make demo   drive a simulated robot over three grounds, localise it twice, write demo-out/report.html"
	@echo "make test   the whole test suite (set TERRAFUSION_DATA to a folder of field logs to include those)"
	@echo "make docs   the documentation as a site, site/index.html"
	@echo "make dist   wheel and source distribution (the site in it), dist/"
	@echo "make lint   ruff, mypy and the import layers"

demo: $(VENV)/installed
	$(BIN)/terrafusion demo --out demo-out

test: $(VENV)/installed-dev
	$(BIN)/python -m pytest -n auto --dist loadfile

docs: $(VENV)/installed-dev
	$(BIN)/python -m mkdocs build --strict --quiet

dist: docs
	$(BIN)/python -m build --outdir dist

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# Not editable on purpose: what is tested is what a wheel holds.
$(VENV)/installed: $(BIN)/python $(SOURCES)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check .
	@touch $@

$(VENV)/installed-dev: $(BIN)/python $(SOURCES)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check '.[dev]'
	@touch $@ $(VENV)/installed

clean:
	rm -rf $(VENV) build dist site demo-out *.egg-info
