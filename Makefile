# `make land` and `make test` each do all set-up from a bare clone.
VENV := .venv
BIN := $(VENV)/bin
# Libraries leave out the byte code of the many modules that nothing imports.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile \
    --constraint constraints.txt
# What compiling kernels takes, the first to be installed: kernels are compiled beside the rest.
FOR_KERNELS := annotated-types mujoco numba opencv-contrib-python-headless scipy zstandard
# Both processes of the tests would compile these as they start; without it they still do.
IMPORTED_BY_TESTS := dash dm_control IPython matplotlib numba numpy OpenGL pandas PIL rerun scipy
KERNELS_OF_TESTS := experiments/flight/kernels_zou2024.txt tests/kernels.txt
READY := $(VENV)/.ready
READY_TO_TEST := $(VENV)/.ready-to-test
READY_FOR_DOCS := $(VENV)/.ready-for-docs
# The first interpreter that is new enough; override with `make PYTHON=...`.
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	command -v $$p >/dev/null 2>&1 && \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' && echo $$p && break; done)

export MUJOCO_GL ?= egl

.DEFAULT_GOAL := help
.PHONY: help land test check mutation regress bench results network docs format clean

help:
	@echo "make land    set everything up, fly over crossroad and land"
	@echo "make test    the tests"
	@echo "make check   style, types, architecture"
	@echo "make regress four short landings beside the stored ones; fails where they are worse"
	@echo "make mutation changes algorithms one statement at a time; the tests must see it"
	@echo "make bench   real-time factor and the time of each stage"
	@echo "make results fly what README and the results pages print; write their tables"
	@echo "make network train the ground classifier that flights use, DATA=folder of photographs"
	@echo "make docs    the pages as a site, in site/"
	@echo "make format  put the sources in order"
	@echo "make clean   remove the environment and what was built"

land: $(READY)
	$(BIN)/touchdown land crossroad

test: $(READY_TO_TEST)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow" \
	    --durations=10

check: $(READY_TO_TEST)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest tests/project/test_architecture.py

# Goes on where an earlier call stopped; about twenty minutes of two cores from the start.
mutation: $(READY_TO_TEST)
	$(BIN)/python tests/mutations/run.py

regress: $(READY)
	$(BIN)/touchdown regress configs/regress.toml --bounds \
	    --baseline configs/regress_baseline.json

bench: $(READY)
	$(BIN)/touchdown bench loop

# Goes on where an earlier call stopped; `touchdown results --part NAME` flies one page.
results: $(READY)
	$(BIN)/touchdown results --out runs/results --write

# Goes on where an earlier call stopped; docs/ground-classification.md names the folders of DATA.
NETWORK := runs/network
RENDER = test -d $(NETWORK)/$(1) || $(BIN)/touchdown dataset render --jobs 2 --out $(NETWORK)/$(1)
# Not rooftop_parking: in other colours its marked deck, a path, looks like a road.
SCENES := $(addprefix --scene ,cottage crossroad dunes flat forest houses lake open_water snow turf)
PHOTOGRAPHS = $(foreach kind,ucmerced textures aerial caliterra,--data $(kind)=$(DATA)/$(kind))
PATCHES := $(addprefix --data $(NETWORK)/,patches coloured-8 coloured-10 dressed-11 dressed-12)
TRAIN = $(BIN)/touchdown train --network efficientnet_lite0 --frozen 6 --image-size 128 \
    --weather 0.6 --variation 0.6 --markings 0.4 --colours 0.15 --textures 0.2 \
    --miss-cost water=10 --threads 2 $(PHOTOGRAPHS) $(PATCHES) --out $(NETWORK)
TEACHERS := $(addprefix --teacher ,$(NETWORK)/second/network.onnx \
    landing/classification/trained/onboard.onnx)

network: $(READY_TO_TEST)
	@test -d "$(DATA)" || { echo "make network DATA=FOLDER: no such folder" >&2; exit 2; }
	$(PIP) --editable ".[train]"
	$(call RENDER,patches) --images 2400 --seed 6
	$(call RENDER,coloured-8) --images 1200 --seed 8 --new-colours 0.5 $(SCENES)
	$(call RENDER,coloured-10) --images 3000 --seed 10 --new-colours 0.5 $(SCENES)
	$(call RENDER,dressed-11) --images 3000 --seed 11 --new-colours 0.5 --new-materials 1 $(SCENES)
	$(call RENDER,dressed-12) --images 3000 --seed 12 --new-colours 0.5 --new-materials 1 $(SCENES)
	$(TRAIN)/first --start-from imagenet --epochs 16 --learning-rate 1e-3
	$(TRAIN)/second --start-from $(NETWORK)/first --epochs 8 --learning-rate 5e-4
	$(TRAIN)/trained --start-from $(NETWORK)/second --epochs 14 --learning-rate 1e-3 $(TEACHERS)
	$(BIN)/touchdown quantize $(NETWORK)/trained/network.onnx --type float16 --false-safe 0.01 \
	    --out $(NETWORK)/efficientnet_lite0.onnx $(PHOTOGRAPHS) $(PATCHES)

docs: $(READY_FOR_DOCS)
	NO_MKDOCS_2_WARNING=1 PATH=$(abspath $(BIN)):$$PATH $(BIN)/mkdocs build
	@echo "open site/index.html, or with search: $(BIN)/python -m http.server -d site"

format: $(READY_TO_TEST)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(READY): pyproject.toml constraints.txt .ci/system-libraries
	@test -n "$(PYTHON)" || { \
	    echo "touchdown needs Python 3.11 or newer; none was found on PATH" \
	         "(Debian: apt-get install python3 python3-venv)" >&2; exit 1; }
	@.ci/system-libraries $(PYTHON)
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) $(FOR_KERNELS)
	PYTHONPATH=src $(BIN)/python -m touchdown.experiments.flight.kernels & \
	    $(PIP) --editable .; installed=$$?; wait; exit $$installed
	@touch $@

# Tests need more than a flight does: torch above all, and kernels of more than one estimator.
$(READY_TO_TEST): $(READY)
	$(BIN)/python -m touchdown.experiments.flight.kernels $(KERNELS_OF_TESTS) & \
	    $(PIP) --compile --editable ".[dev,rl]"; installed=$$?; wait; exit $$installed
	-cd $(VENV)/lib/python3*/site-packages && $(abspath $(BIN))/python -m compileall -q -j 0 \
	    -x /tests/ $(IMPORTED_BY_TESTS) $(abspath src/touchdown)/*/
	@touch $@

$(READY_FOR_DOCS): $(READY)
	@$(PIP) --editable ".[docs]"
	@touch $@

clean:
	rm -rf $(VENV) build dist site *.egg-info
