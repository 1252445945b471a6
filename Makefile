# mi_neural: `make` lists the targets.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/mi_neural.stamp
TESTS  := $(VENV)/tests.stamp

.DEFAULT_GOAL := help
.PHONY: help demo picture bench gallery gallery-pictures docs tables results gpu notebooks test test-all test-notebooks stress lint clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-16s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

# The environment, made once and again whenever pyproject.toml changes.
$(STAMP): pyproject.toml
	@command -v $(PYTHON) > /dev/null || { \
	    echo "mi_neural: no '$(PYTHON)' found. Install Python 3.10 or newer, or type: make PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -c 'import sys; v = sys.version_info; v >= (3, 10) or sys.exit("mi_neural: this is Python %d.%d; \
	it needs 3.10 or newer. Type: make PYTHON=python3.11" % v[:2])'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	    echo "mi_neural: could not make $(VENV). On Debian and Ubuntu type: apt install python3-venv"; exit 1; }
	$(BIN)/python -m pip install --quiet -e '.[denoise]'
	@touch $@

# What tests need beside, which a picture does not wait for.
$(TESTS): $(STAMP)
	$(BIN)/python -m pip install --quiet -e '.[denoise,test]'
	@touch $@

demo: $(STAMP)  ## path tracing beside the neural cache at equal time: table, EXR, PNG, report in out/demo
	$(BIN)/mi-neural compare ajar_door -i path -i neural_path --seconds 5 --steady 200 --frame-seconds 0.25,1 --denoise \
	    -o out/demo
	@echo "Open out/demo/report.html"

picture: demo  ## the README's picture, of the demo's frames
	$(BIN)/python -m mi_neural.bench.montage scenes/ajar_door.png $(foreach k,steady_1s.png steady_1s_denoised.png, \
	    out/demo/path_$(k) out/demo/neural_path_$(k))

BENCH := -i path -i nirc -i nrc -i neural_path -i nirc_two_level --seconds 1 --steady 64 --frame-seconds 0.25 \
    --repeats 3 --denoise

bench: $(STAMP)  ## integrators on our own scenes: tables and report in out/bench; under 20 minutes on two cores, goes on where stopped
	$(BIN)/mi-neural compare --scenes scenes $(BENCH) --size 160x90,144x144 -o out/bench

GALLERY := $(BIN)/mi-neural compare
PATHS := -i path -i nirc -i nrc -i neural_path -i nirc_two_level -i nirc_two_level:mode=progressive \
    -i plain_path:light_sampler.type=nvc_lights --steady 200 --frame-seconds 0.25
DIRECT := -i path -i plain_path:light_sampler.type=power_lights -i plain_path:light_sampler.type=nvc_lights -i restir_di \
    -i nvc_direct -i nvc_direct:mode=neural -D max_depth=2 --steady 200 --frame-seconds 0.25 --reference-spp 512
FOG := -i volpath -i plain_path:light_sampler.type=nvc_lights -i nrc -i neural_path --steady 200 --frame-seconds 0.25
LAMP := lamp_panel.to_world=translate(0.7*sin(2*pi*t),-0.4*(1-cos(2*pi*t)),0)@value

gallery: $(STAMP)  ## own scenes by every integrator, error maps, a moving light: out/gallery/index.html; minutes, goes on where stopped
	$(GALLERY) cornell_box $(PATHS) --size 144x144 -o out/gallery/1_cornell_box
	$(GALLERY) ajar_door $(PATHS) --size 320x180 -o out/gallery/2_ajar_door
	$(GALLERY) glossy_hall $(PATHS) --size 256x144 -o out/gallery/3_glossy_hall
	$(GALLERY) lamp_bays $(PATHS) --size 256x144 -o out/gallery/4_lamp_bays
	$(GALLERY) lamp_bays $(DIRECT) --size 256x144 -o out/gallery/5_direct_light
	$(BIN)/mi-neural sequence cornell_box -i path -i nirc:blend=reliability --change "$(LAMP)" --frames 36 --pretrain 128 \
	    --spp 4 --size 128x128 --no-reference -o out/gallery/6_moving_light
	$(GALLERY) foggy_hall $(FOG) --size 320x180 -o out/gallery/7_foggy_hall
	$(BIN)/python -m mi_neural.bench.gallery out/gallery

gallery-pictures: gallery  ## the README's pictures, of the gallery
	$(BIN)/python -m mi_neural.bench.gallery out/gallery --compact scenes/gallery.webp --animation scenes/moving_light.webp

# Python needs no network for it once the environment is made; warnings are errors, dead links among them.
DOCS := $(VENV)/docs.stamp

$(DOCS): $(STAMP)
	$(BIN)/python -m pip install --quiet -e '.[docs]'
	@touch $@

docs: $(DOCS)  ## the manual as HTML: out/docs/index.html
	$(BIN)/python docs/stage.py out/docs_source
	$(BIN)/sphinx-build -q -n -W --keep-going -c docs out/docs_source out/docs
	@echo "Open out/docs/index.html"

tables: $(STAMP)  ## write the tables of README and manual anew from docs/results/*.json
	$(BIN)/python docs/tables.py

results: $(STAMP)  ## measure tables again, those that a command makes (ONLY=NAME: one of them); goes on where stopped
	$(BIN)/python docs/results.py $(if $(ONLY),--only $(ONLY))

# Of xdist's ways to share the work, worksteal is one that goes on when a process ends; loadfile waits for ever.
test: $(TESTS)  ## the default tests, a few minutes on two cores
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-all: $(TESTS)  ## the default tests and the slow ones, tens of minutes
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not notebooks and not peer" -o faulthandler_timeout=0

test-notebooks: $(TESTS)  ## every notebook, shortened, two minutes
	$(BIN)/python -m pytest -n 2 --dist worksteal -m notebooks tests/test_notebooks.py

stress: $(TESTS)  ## every hard case by every integrator: table in out/stress (tests/README.md); minutes, goes on where stopped
	$(BIN)/python tests/stress.py -o out/stress

gpu: $(TESTS)  ## on a machine with an NVIDIA GPU: the default tests on cuda_ad_rgb, a table of costs in out/gpu
	mkdir -p out/gpu
	MI_NEURAL_TEST_VARIANT=cuda_ad_rgb $(BIN)/python -m pytest -n 4 --dist worksteal > out/gpu/tests.txt; tail -n 40 out/gpu/tests.txt
	$(BIN)/python studies/gpu_figures.py -o out/gpu

notebooks: $(STAMP)  ## run all notebooks in full length and keep their outputs, minutes
	$(BIN)/python -m pip install --quiet -e '.[denoise,notebooks]'
	$(BIN)/jupyter nbconvert --to notebook --execute --inplace --ExecutePreprocessor.record_timing=False \
	    --ExecutePreprocessor.timeout=900 notebooks/*.ipynb

lint: $(TESTS)  ## ruff
	$(BIN)/ruff check .

clean:  ## remove what builds, tests and the demo wrote (keeps .venv)
	rm -rf out build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
