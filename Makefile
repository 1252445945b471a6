# mi_neural: `make` lists the targets.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/mi_neural.stamp

.DEFAULT_GOAL := help
.PHONY: help demo picture test stress notebooks lint clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

# The environment, made once and again whenever pyproject.toml changes.
$(STAMP): pyproject.toml
	@command -v $(PYTHON) > /dev/null || { \
	    echo "mi_neural: no '$(PYTHON)' found. Install Python 3.10 or newer, or type: make PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -c 'import sys; v = sys.version_info; v >= (3, 10) or sys.exit("mi_neural: this is Python %d.%d; \
	it needs 3.10 or newer. Type: make PYTHON=python3.11" % v[:2])'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	    echo "mi_neural: could not make $(VENV). On Debian and Ubuntu type: apt install python3-venv"; exit 1; }
	$(BIN)/python -m pip install --quiet -e '.[denoise,test]'
	@touch $@

demo: $(STAMP)  ## path tracing beside the neural cache at equal time: table, EXR, PNG, report in out/demo
	$(BIN)/mi-neural compare ajar_door -i path -i nirc --seconds 5 --steady 200 --frame-seconds 0.25,1 --denoise \
	    --reference scenes/ajar_door_320x180.exr -o out/demo
	@echo "Open out/demo/report.html"

picture: demo  ## the README's picture, of the demo's frames
	$(BIN)/python -m mi_neural.measure.montage scenes/ajar_door.png $(foreach k,steady_1s.png steady_1s_denoised.png, \
	    out/demo/path_$(k) out/demo/nirc_$(k))

# Of xdist's ways to share the work, worksteal is one that goes on when a process ends; loadfile waits for ever.
test: $(STAMP)  ## the default tests, a few minutes on two cores
	$(BIN)/python -m pytest -n 2 --dist worksteal

stress: $(STAMP)  ## every hard case by every integrator: table in out/stress (tests/README.md); minutes, goes on where stopped
	$(BIN)/python tests/stress.py -o out/stress

notebooks: $(STAMP)  ## run all notebooks in full length and keep their outputs, minutes
	$(BIN)/python -m pip install --quiet -e '.[denoise,notebooks]'
	$(BIN)/jupyter nbconvert --to notebook --execute --inplace --ExecutePreprocessor.record_timing=False \
	    --ExecutePreprocessor.timeout=900 notebooks/*.ipynb

lint: $(STAMP)  ## ruff
	$(BIN)/ruff check .

clean:  ## remove what builds, tests and the demo wrote (keeps .venv)
	rm -rf out build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
