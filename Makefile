# Needs Python >= 3.11 and make; everything else is installed into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := runs/demo
# Tests and the demo run on the CPU: they are small, and results are then the same on every machine.
CPU := JAX_PLATFORMS=cpu

.PHONY: help install demo test test-all lint clean
.DEFAULT_GOAL := help

help:
	@echo "make demo      train, evaluate and reconstruct on procedural rooms (about 15 minutes on two cores)"
	@echo "make test      linter, type checker and tests (under 10 minutes)"
	@echo "make test-all  the slow tests as well: 1B parity, compilation for TPUs, long streams"
	@echo "make lint      linter, formatter check and type checker alone"

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable ".[eval,hub,viewer,dev]"
	@touch $@

demo: install
	rm -rf $(DEMO)
	$(CPU) $(BIN)/python train.py --config=configs/demo.py --workdir=$(DEMO)/training
	$(CPU) $(BIN)/python eval.py --config=configs/eval/demo.py --checkpoint=$(DEMO)/training/model --output=$(DEMO)/evaluation
	$(CPU) $(BIN)/logvggt render-room --output $(DEMO)/room --frames 48 --size 56x70 --seed 0 --split test
	$(CPU) $(BIN)/logvggt reconstruct $(DEMO)/room --checkpoint $(DEMO)/training/model --output $(DEMO)/reconstruction --longer-edge 70
	@echo
	@cat $(DEMO)/evaluation/results.md
	@echo "Results in $(DEMO):"
	@find $(DEMO) -maxdepth 2 -not -name '*.jsonl' | sort

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest --durations=10 --junitxml=runs/test/report.xml
	@echo "Test report: runs/test/report.xml"

test-all: lint
	$(BIN)/python -m pip install --quiet "libtpu>=0.0.30"
	$(BIN)/python -m pytest -m "slow or not slow" --durations=20 -rA --junitxml=runs/test-all/report.xml
	@echo "Test report: runs/test-all/report.xml"

clean:
	rm -rf $(VENV) runs
