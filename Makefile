# `make demo` and `make test` set up their own environment; nothing but python3 and make is needed.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: help demo test lint types setup bench quality clean

help:  ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 10

$(BIN)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[io,rl,dev]'
	touch $@

setup: $(BIN)/.ready  ## make the environment .venv

demo: setup  ## simulate a walk, map it, write demo.png
	$(BIN)/python -m torchelev demo --out demo.png

test: setup  ## run all tests, on all cores
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile

lint: setup  ## check style, and that imports go downwards
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/lint-imports

types: setup  ## check types
	$(BIN)/mypy

bench: setup  ## measure speed and scale, under ten minutes
	$(BIN)/python -m benchmarks.speed.run
	$(BIN)/python -m docs.readme_tables

quality: setup  ## measure accuracy and features, five minutes
	$(BIN)/python -m benchmarks.quality.accuracy
	$(BIN)/python -m benchmarks.quality.features
	$(BIN)/python -m docs.readme_tables

clean:  ## remove what the targets made
	rm -rf $(VENV) demo.png
