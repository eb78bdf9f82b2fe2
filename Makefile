# Needs Python >= 3.11 and make; everything else is installed into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := runs/demo
# Test processes; tests of one file stay together, since they share what they compile.
JOBS ?= 2
# The demo is small: it runs on the CPU wherever it is started.
CPU := JAX_PLATFORMS=cpu

.PHONY: help install demo test test-all lint clean
.DEFAULT_GOAL := help

help:
	@echo "make demo      train, evaluate and reconstruct on procedural rooms; README says how long it takes"
	@echo "make test      linter, type checker and tests (under 10 minutes)"
	@echo "make test-all  the slow tests as well: 1B parity, compilation for TPUs, long streams"
	@echo "make lint      linter, formatter check and type checker alone"

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, for example: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable ".[data,eval,heic,hub,video,viewer,dev]"
	@touch $@

demo: install
	rm -rf $(DEMO)
	$(CPU) $(BIN)/python train.py --config=configs/demo.py --workdir=$(DEMO)/training
	$(CPU) $(BIN)/logvggt render-room --output $(DEMO)/room --frames 48 --size 56x70 --split test
	$(CPU) $(BIN)/logvggt reconstruct $(DEMO)/room --checkpoint $(DEMO)/training/model \
	  --output $(DEMO)/reconstruction --longer-edge 70
	$(CPU) $(BIN)/python eval.py --config=configs/eval/rooms.py --config.options.num_rooms=8 \
	  --checkpoint=$(DEMO)/training/model --output=$(DEMO)/evaluation
	@echo
	@echo "Results in $(DEMO)/:"
	@echo "  evaluation/report.html         the tables above and the figures on one page; report.md and results.json as well"
	@echo "  evaluation/figures/            trajectories and depth beside the truth"
	@echo "  reconstruction/points.ply      coloured point cloud of a room that training never saw"
	@echo "  reconstruction/trajectory.txt  its camera path (TUM format); cameras.json has the intrinsics as well"
	@echo "  reconstruction/previews/       its depth as pictures; depth/ has the values"
	@echo "  training/model/                the trained model; checkpoints/, metrics.jsonl and tensorboard/ beside it"

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --durations=10 --junitxml=runs/test/report.xml
	@echo "Test report: runs/test/report.xml"

test-all: test
	$(BIN)/python -m pip install --quiet "libtpu>=0.0.30"
	$(BIN)/python -m pytest -m slow --durations=20 -rA --junitxml=runs/test-all/report.xml
	@echo "Test reports: runs/test/report.xml, and of the slow tests runs/test-all/report.xml"

clean:
	rm -rf $(VENV) runs
