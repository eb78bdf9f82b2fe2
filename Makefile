# Needs Python >= 3.11 and make; everything else is installed into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := runs/demo
# Test processes; tests of one file stay together, since they share what they compile. tests/conftest.py orders them.
JOBS ?= 2
# The demo is small: it runs on the CPU wherever it is started.
CPU := JAX_PLATFORMS=cpu
# Where it is set, each of the dozens of processes of a test run would compile the package again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help install demo test test-all lint docs clean
.DEFAULT_GOAL := help

help:
	@echo "make demo      reconstruct a room, evaluate and train on procedural rooms, then open runs/demo/index.html; README says how long it takes"
	@echo "make test      linter, type checker and tests (ten to fifteen minutes on two cores, its installation included)"
	@echo "make test-all  the slow tests as well: 1B parity, compilation for TPUs, long streams"
	@echo "make lint      linter, formatter check and type checker alone"
	@echo "make docs      the documentation as a site, runs/site/index.html; make test builds it too"

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, for example: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable ".[colmap,data,docs,eval,export,formats,heic,hub,lowprecision,video,viewer,dev]"
	@touch $@

demo: install
	rm -rf $(DEMO)
	@echo "1 of 4: a walk through a room that training never saw, drawn frame by frame, with the true depth and camera path"
	$(CPU) $(BIN)/logvggt render-room --output $(DEMO)/room --frames 96 --size 56x70 --split test
	@echo "2 of 4: the model that ships sees the frames alone and gives depth, camera path and a point cloud"
	$(CPU) $(BIN)/logvggt reconstruct $(DEMO)/room --checkpoint rooms --output $(DEMO)/reconstruction
	@echo "3 of 4: the same model on eight such rooms, beside answers that need no learning; the best of a column is bold"
	$(CPU) $(BIN)/python eval.py --config=configs/eval/rooms.py --config.options.num_rooms=8 \
	  --checkpoint=rooms --output=$(DEMO)/evaluation
	@echo "4 of 4: a tiny model trains from nothing for two minutes; abs_rel, the error of its depth, falls"
	$(CPU) $(BIN)/python train.py --config=configs/demo.py --workdir=$(DEMO)/training
	@$(CPU) $(BIN)/python scripts/demo_page.py $(DEMO)

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Types are checked beside the tests, mostly while these leave a core idle.
test: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@mkdir -p runs/test
	@nice -n 10 $(BIN)/mypy > runs/test/types.txt 2>&1 & types=$$!; trap 'kill $$types 2> /dev/null; exit 130' INT TERM; \
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder --durations=10 --junitxml=runs/test/report.xml; \
	tests=$$?; wait $$types; typed=$$?; echo "Types:"; cat runs/test/types.txt; \
	test $$tests -eq 0 || exit $$tests; exit $$typed
	@echo "Test report: runs/test/report.xml"

test-all: test
	$(BIN)/python -m pip install --quiet "libtpu>=0.0.30" wandb
	$(BIN)/python -m pytest -m slow --durations=20 -rA --junitxml=runs/test-all/report.xml
	@echo "Test reports: runs/test/report.xml, and of the slow tests runs/test-all/report.xml"

docs: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "The documentation: runs/site/index.html (its search needs a server: python3 -m http.server -d runs/site)"

# What the targets above made. The other folders in runs/ are somebody's hours of training.
clean:
	rm -rf $(VENV) $(DEMO) runs/test runs/test-all runs/site
