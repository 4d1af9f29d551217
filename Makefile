# Palpate. `make` alone prints this help. Each target sets up what it needs by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SUDO = $$( [ `id -u` = 0 ] || echo sudo )
PIP := $(BIN)/python -m pip --disable-pip-version-check -q
# Python compiles a module when it is first imported: compiling all of them here takes 30 s.
INSTALL := $(PIP) install --no-compile
# A wheel of another hash is refused, and nothing is built from sources.
LOCKED := $(INSTALL) --require-hashes --only-binary :all:
RUNTIME := $(VENV)/runtime.done
FLEET := $(VENV)/fleet.done
DESKTOP := $(VENV)/desktop.done
TOOLS := $(VENV)/tools.done
SITE := $(VENV)/site.done
NO_HOST = $(error name a box with HOST=user@box, or many with HOSTS=inventory.py)
# The value of a variable as one word for the shell, whatever is in it.
quoted = '$(subst ','\'',$(value $(1)))'
WHERE = $(if $(value HOSTS),--hosts $(call quoted,HOSTS),$(if $(value HOST),--host \
  $(call quoted,HOST),$(NO_HOST))) $(if $(KNOWN),--known-hosts-only)
# Files of tests are in memory if there is 1 GB for them: a sync to a disk takes as long as a test.
SCRATCH = $(or $(shell df -Pk /dev/shm 2>/dev/null | awk 'NR > 1 && $$4 > 1000000 { print $$6 }'),/tmp)
# One process more than there are cores: some tests wait for time to pass.
# Bytecode is kept: without it each process compiles all modules again, half of a fast run.
PYTEST = PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q -n $(shell expr `nproc` + 1)

.DEFAULT_GOAL := help
.PHONY: help demo desktop test test-fast test-all lint bundle bench site deploy install deb client release clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo "Campaigns and the virtual box: $(BIN)/python -m tests.campaigns lists them."
	@echo "Studies, result pages and tables: $(BIN)/python -m palpate_studies lists them."

demo: $(RUNTIME) ## watch simulated sweeps being classified, live
	$(BIN)/palpate demo

desktop: $(DESKTOP) ## install palpate, palpate-train and all that training needs; run no test
	@echo "palpate and palpate-train are in $(BIN): call $(BIN)/palpate-train,"
	@echo "or first: source $(BIN)/activate"

test: $(TOOLS) ## run the tests, without those marked `thorough`
	TMPDIR=$(SCRATCH) $(PYTEST) --dist worksteal -m "not thorough"

test-fast: $(TOOLS) ## run the tests that are neither `slow` nor `thorough`
	TMPDIR=$(SCRATCH) $(PYTEST) --dist worksteal -m "not slow and not thorough" \
	  $(PYTEST_OPTIONS)

test-all: test ## run all tests; those on real sweeps need their folder in PALPATE_DATA
	$(PYTEST) --dist loadfile -m thorough

lint: $(TOOLS) ## check style, imports between packages, prose, and types (mypy --strict)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/python -m tests.prose
	$(BIN)/mypy

bundle: $(DESKTOP) ## train, quantize and pack the default bundle again
	@mkdir -p build
	$(BIN)/palpate-train fit --set sim:T-REAL/level-blind:1-6 --seed 1 --reattached --stages 1200 \
	  --out build/default.npz
	$(BIN)/palpate-train export build/default.npz --out appliance/palpate/default_bundle --name default \
	  --version 3 --with displacement

bench: $(TOOLS) ## measure this machine: docs/data/bench.json, and the tables of README and manual
	$(BIN)/python -m tests.campaigns bench
	$(BIN)/python -m palpate_studies tables

site: $(SITE) ## build the documents and the pages of results as a site: build/site/index.html
	PYTHONPATH=systemd $(BIN)/python docs/site/build.py build

deploy: $(FLEET) ## put a signed BUNDLE= on HOST= or HOSTS=inventory.py; SHADOW=1: as the candidate
	$(BIN)/python systemd/deploy.py $(WHERE) $(if $(value SIGNERS),--signers $(call quoted,SIGNERS)) \
	  $(if $(SHADOW),--shadow) $(if $(OTHER_SKIN),--other-skin) \
	  $(if $(value BUNDLE),$(call quoted,BUNDLE),$(error name the bundle with BUNDLE=its folder))

# setuptools would put leftovers of an older build into the wheel
WHEELS = rm -rf build/lib build/bdist.*; $(PIP) wheel --no-deps --no-build-isolation -w dist . \
  $(if $(filter 0,$(TEACH)),,&& $(PIP) wheel --no-deps --no-build-isolation -w dist ./train)

install: $(FLEET) ## install or upgrade Debian boxes, HOST= or HOSTS=; BOARD=rpi5, SIGNERS=FILE, KEY=FILE, TEACH=0
	$(WHEELS)
	$(BIN)/python systemd/install.py $(WHERE) $(if $(value BOARD),--board $(call quoted,BOARD)) \
	  $(if $(value SIGNERS),--signers $(call quoted,SIGNERS)) $(if $(filter 0,$(TEACH)),--no-teach) \
	  $(if $(value KEY),--key $(call quoted,KEY))

deb: $(FLEET) $(DESKTOP) ## pack the same as dist/palpate_*.deb for arm64 and amd64, a list of what is in it, and the notes
	$(WHEELS)
	$(BIN)/python systemd/debian.py dist $(if $(value KEY),--key $(call quoted,KEY))
	PYTHONPATH=. $(BIN)/python systemd/sbom.py dist/palpate.cdx.json
	awk '/^## / { part++ } part == 1' CHANGELOG.md >dist/notes.md

client: $(RUNTIME) ## build the robot's client alone: dist/palpate_client-*.whl
	$(PIP) wheel --no-deps --no-build-isolation -w dist ./appliance/plugins/client
	rm -rf appliance/plugins/client/build appliance/plugins/client/*.egg-info

release: ## publish what `make deb` has packed as the release TAG=, with gh
	gh release create $(if $(value TAG),$(call quoted,TAG),$(error name the release with TAG=v0.2.0)) \
	  --title $(call quoted,TAG) --notes-file dist/notes.md dist/*.whl dist/*.deb dist/*.cdx.json

clean: ## remove everything that was built, the virtual environment too
	rm -rf $(VENV) build dist *.egg-info appliance/*.egg-info train/*.egg-info train/studies/*.egg-info

# A virtual environment with the locked runtime and the commands, nothing else.
$(RUNTIME): appliance/requirements.lock systemd/build.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Palpate needs Python 3.11 or later; this is `$(PYTHON) --version`."; \
	    echo "Name another with make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "installing python3-venv"; \
	  $(SUDO) apt-get install -y -q python3-venv; }
	$(PYTHON) -m venv $(VENV)
	$(LOCKED) -r appliance/requirements.lock -r systemd/build.lock
	$(INSTALL) --no-deps --no-build-isolation -e .
	@touch $@

# The same with the tools that reach boxes.
$(FLEET): $(RUNTIME) systemd/fleet.lock
	$(LOCKED) -r systemd/fleet.lock
	@touch $@

# The same with training and export. Only PyTorch is left to the second line.
$(DESKTOP): $(RUNTIME) train/pyproject.toml train/desktop.lock
	$(LOCKED) -r train/desktop.lock
	$(INSTALL) --no-build-isolation -e train[stages,reports]
	@touch $@

# The same with tests, studies, and the tools that check the code. flexitac has no wheel.
# All that the studies need is in the lock.
$(TOOLS): $(DESKTOP) tests/tools.lock train/studies/pyproject.toml
	$(LOCKED) --no-binary flexitac --no-build-isolation -r tests/tools.lock
	$(INSTALL) --no-deps --no-build-isolation -e train/studies
	@touch $@

# The same with what builds the site; the studies draw its pages of results.
$(SITE): $(DESKTOP) docs/site/site.lock train/studies/pyproject.toml
	$(LOCKED) -r docs/site/site.lock
	$(INSTALL) --no-deps --no-build-isolation -e train/studies
	@touch $@

# ROS 2 with palpate_msgs, in a virtual environment of its own.
MESSAGES := appliance/plugins/palpate_msgs
build/ros/ready: $(wildcard $(MESSAGES)/* $(MESSAGES)/*/*) tests/robots/messages.py pyproject.toml \
  | $(RUNTIME)
	@{ command -v cmake && command -v g++ && $(PYTHON) -c 'import pathlib, sysconfig, sys; \
	  sys.exit(not pathlib.Path(sysconfig.get_path("include"), "Python.h").exists())'; } \
	  >/dev/null || \
	  $(SUDO) apt-get install -y -q --no-install-recommends cmake make g++ python3-dev
	$(PYTHON) -m venv build/ros
	build/ros/bin/python -m pip install -q --disable-pip-version-check pyserial numpy \
	  `$(BIN)/python -c 'import tomllib; \
	  extras = tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]; \
	  print(*extras["ros"], *extras["ros-build"])'`
	build/ros/bin/python tests/robots/messages.py >build/ros/messages.log
	@touch $@
