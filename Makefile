# Every target does its own set-up in .venv, from the locked versions in requirements/.
#   PYTHON=/path/to/python3.12   the interpreter to make .venv with, after `make clean` (default: the first >= 3.11 found)
#   JUNIT=folder                 `make check` and `make test` also write their results there as XML
#   PGO=1                        `make compiled` compiles twice, the second time for what drives take (gcc only)

SHELL := /bin/sh
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
MAKEFLAGS += --no-builtin-rules --no-print-directory
# Settings of the caller's that would send an installation, or an import, somewhere else than .venv.
unexport PYTHONHOME PYTHONPATH PIP_USER PIP_TARGET PIP_PREFIX PIP_REQUIRE_VIRTUALENV VIRTUAL_ENV
# Many containers have it. Each of the thousands of processes that tests start would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
PY := $(VENV)/bin/python
PIP_INSTALL := $(PY) -m pip install --quiet --disable-pip-version-check
# Modules are compiled as they are first imported: most of pymavlink and fontTools never is, which is 80 MB less.
LOCKED := $(PIP_INSTALL) --require-hashes --only-binary :all: --no-compile
PROJECT := $(PIP_INSTALL) --no-deps --no-build-isolation --no-index --editable .

# The same with what runs in every tick as C; built of a copy, which the compiler leaves its files in.
COMPILED := .venv-compiled
COMPILED_BUILD := build/compiled
SOURCES := $(shell find agent plant bridges deploy handfast -type f ! -name '*.pyc')
# No fused multiply-add: all forms give the same numbers, to the bit.
COMPILED_CFLAGS := -ffp-contract=off -g0
# $(1): more options of the compiler.
WHEEL = CFLAGS="$(COMPILED_CFLAGS) $(1)" HATCH_BUILD_HOOKS_ENABLE=1 $(PY) -m pip wheel --quiet --disable-pip-version-check \
	--no-deps --no-build-isolation --no-index --wheel-dir $(COMPILED_BUILD) $(COMPILED_BUILD)
# Profile-guided optimization: what these drives hardly ever come to stands apart from what they do all the time.
# What they never come to is as without (a profile of virtual time has nothing of Zenoh).
TRAINING := "" "--set faults.delay=500ms --set faults.loss=30%"
USE_PROFILE := -fprofile-use=$$tmp/profile -fprofile-partial-training -Wno-missing-profile
# What is there without a profile is made again where one is asked for.
UNPROFILED := $(if $(PGO),$(shell grep -qsx pgo $(COMPILED)/.built || echo FORCE))

DEMO_OUT ?= runs/demo
# Every test in these folders starts processes. Naming them saves collecting the others again.
STARTING := tests/process tests/hosts
PURE := $(addprefix --ignore=,$(STARTING))
QUICK := not slow and not long and not autopilot and not compiled
OF_COMPILED := $(addprefix tests/,unit/agent unit/plant property simulation)
# What users add in Python must drive with what is compiled, and who watches whom goes by it.
ON_COMPILED := own_laws.py own_plants.py supervision.py
DRIVES := slip or in_run or mid_drive or supervision
# Tests of one module share what it has set up, and those of tests/hosts have one worker (tests/conftest.py).
WAITING := -n 2 --dist loadfile --no-loadscope-reorder
junit = $(if $(JUNIT),--junitxml=$(abspath $(JUNIT))/$(1).xml)

.PHONY: help demo test test-long test-compiled check lint format chaos bench docs lock setup compiled clean FORCE

help: ## show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1|\2/p' $(MAKEFILE_LIST) | \
	  while IFS='|' read -r name text; do printf '%-14s %s\n' "$$name" "$$text"; done

demo: $(VENV)/.operator ## drive the paper's formation on this machine; leaves its report in runs/demo
	@rm -rf '$(DEMO_OUT)'
	@status=0; $(VENV)/bin/handfast run delta --out '$(DEMO_OUT)' || status=$$?; \
	if [ -e '$(DEMO_OUT)/report.html' ]; then printf '\nReport: %s\n' '$(abspath $(DEMO_OUT))/report.html'; fi; \
	exit $$status

test: $(VENV)/.dev ## unit, property and virtual-time tests, then those with processes and test hosts
	$(PY) -m pytest -n 2 $(PURE) -m 'not long and not compiled' $(call junit,computing)
	$(PY) -m pytest $(STARTING) $(WAITING) -m 'not long and not alone' $(call junit,processes)
	$(PY) -m pytest $(STARTING) -m 'alone and not long' $(call junit,alone)

test-long: $(VENV)/.dev ## campaigns, kill matrices, long drives and the compiled form; takes an hour or two
	$(PY) -m pytest -n 2 $(PURE) -m 'long and not compiled' $(call junit,long-computing)
	$(PY) -m pytest $(STARTING) $(WAITING) -m 'long and not alone' $(call junit,long-processes)
	$(PY) -m pytest $(STARTING) -m 'long and alone' $(call junit,long-alone)
	@$(MAKE) test-compiled

test-compiled: $(COMPILED)/.built ## the tests of `make compiled`: the same bytes as the Python it is made of
	$(PY) -m pytest tests/compiled -m compiled $(call junit,compiled)
	@rm -rf $(COMPILED_BUILD)/tests $(COMPILED_BUILD)/docs
	@cp -RP tests docs Makefile requirements .ci $(COMPILED_BUILD)
	cd $(COMPILED_BUILD) && '$(CURDIR)/$(PY)' -m pytest -n 2 -p no:cacheprovider -m '$(QUICK) and not patches' \
	  $(OF_COMPILED) $(call junit,compiled-quick)
	cd $(COMPILED_BUILD) && '$(CURDIR)/$(PY)' -m pytest -n 2 --dist loadfile -p no:cacheprovider -k '$(DRIVES)' \
	  $(addprefix tests/process/test_,$(ON_COMPILED)) $(call junit,compiled-processes)

check: lint ## the quick loop: lint, then the fast tests
	$(PY) -m pytest -n 2 $(PURE) -m '$(QUICK)' $(call junit,quick)

lint: $(VENV)/.dev ## ruff, mypy --strict, import-linter
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy --strict
	$(VENV)/bin/lint-imports --no-logo

format: $(VENV)/.dev ## let ruff lay out the code and repair what it can
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

chaos: $(VENV)/.dev ## drive random scenarios in virtual time (ARGS='--scenarios 1000 --seed 7')
	$(PY) -m tests.chaos $(ARGS)

bench: $(VENV)/.dev ## benchmarks
	$(PY) -m tests.benchmarks

docs: $(VENV)/.dev ## write the references of the fleet file and of metrics
	$(PY) -m handfast.deploy.check.fleet_reference > docs/fleet-file.md
	$(PY) -m tests.docs.metrics_page > docs/metrics.md

# Keeps the pinned versions that still satisfy pyproject.toml; `make lock UPGRADE=1` takes the newest.
# The others are constrained by lock.txt, so that all of these files always agree.
UV_COMPILE = $(VENV)/bin/uv pip compile --quiet --universal --python-version 3.11 --fork-strategy fewest \
	--generate-hashes --no-build --no-annotate --no-emit-index-url --no-emit-find-links \
	--custom-compile-command 'make lock' pyproject.toml
lock: $(VENV)/.dev ## write requirements/*.txt again (UPGRADE=1: newest versions)
	$(UV_COMPILE) $(if $(UPGRADE),--upgrade) --all-extras --group pyproject.toml:build --group pyproject.toml:bundle --group pyproject.toml:compiled -o requirements/lock.txt
	$(UV_COMPILE) $(if $(UPGRADE),--upgrade) -c requirements/lock.txt --extra operator --extra rover --extra security --group pyproject.toml:build -o requirements/operator.txt
	$(UV_COMPILE) $(if $(UPGRADE),--upgrade) -c requirements/lock.txt --extra rover -o requirements/rover.txt
	$(UV_COMPILE) $(if $(UPGRADE),--upgrade) -c requirements/lock.txt --extra recorder --extra rover --extra security --group pyproject.toml:bundle -o deploy/data/robot_requirements.txt
	$(UV_COMPILE) $(if $(UPGRADE),--upgrade) -c requirements/lock.txt -o requirements/core.txt

setup: $(VENV)/.dev ## make .venv with everything a developer needs

compiled: $(COMPILED)/.built ## make .venv-compiled, whose handfast takes less of the processor (needs a C compiler)

clean: ## remove .venv, caches and builds; keeps runs/
	rm -rf $(VENV) $(COMPILED) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find agent plant bridges deploy tests -name __pycache__ -type d -prune -exec rm -rf {} +

# --- set-up -----------------------------------------------------------------------------------

# The interpreters to try, and what one must answer.
CANDIDATES := $(if $(PYTHON),'$(PYTHON)',python3 python3.13 python3.12 python3.11 python)
IS_RECENT := import sys; sys.exit(sys.version_info < (3, 11))

# A .venv whose interpreter is gone, or that was made for another folder, is made again.
STALE := $(shell $(PY) -c '' 2>/dev/null && grep -qxF '$(CURDIR)' $(VENV)/.made 2>/dev/null || echo FORCE)

$(VENV)/.made: $(STALE)
	@python=; for candidate in $(CANDIDATES); do \
	  if "$$candidate" -c '$(IS_RECENT)' >/dev/null 2>&1; then python=$$candidate; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	  echo "handfast needs Python 3.11 or later; tried: $(CANDIDATES). Name one: make PYTHON=/path/to/python3" >&2; exit 1; \
	fi; \
	if ! "$$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then \
	  echo "$$python lacks the modules venv and ensurepip (Debian, Ubuntu: apt install python3-venv)" >&2; exit 1; \
	fi; \
	echo "making $(VENV) with $$("$$python" --version)"; \
	rm -rf $(VENV) && "$$python" -m venv $(VENV)
	@echo '$(CURDIR)' > $@

$(VENV)/.operator: $(VENV)/.made requirements/operator.txt pyproject.toml
	@echo 'installing requirements/operator.txt'
	@$(LOCKED) -r requirements/operator.txt
	@$(PROJECT)
	@touch $@

$(VENV)/.dev: $(VENV)/.made requirements/lock.txt requirements/operator.txt pyproject.toml
	@echo 'installing requirements/lock.txt'
	@$(LOCKED) -r requirements/lock.txt
	@$(PROJECT)
	@touch $(VENV)/.operator $@

COMPILER := os.environ.get("CC") or s.get_config_var("CC").split()[0]
CAN_COMPILE := import os, shutil, sys, sysconfig as s; sys.exit(not (shutil.which($(COMPILER)) and os.path.exists(s.get_path("include") + "/Python.h")))

$(COMPILED)/.built: $(VENV)/.dev $(SOURCES) $(UNPROFILED)
	@if ! $(PY) -c '$(CAN_COMPILE)'; then \
	  echo "a C compiler and Python's headers are needed (Debian, Ubuntu: apt install gcc libc6-dev python3-dev)" >&2; exit 1; \
	fi
	@$(if $(PGO),if "$$($(PY) -c 'import os, sysconfig as s; print($(COMPILER))')" -dM -E -x c /dev/null | grep -q __clang__; then \
	  echo "PGO=1 needs gcc: clang takes profiles in another form (CC=gcc)" >&2; exit 1; \
	fi,:)
	@echo 'compiling, which takes some $(if $(PGO),fifteen,five) minutes'
	@rm -rf $(COMPILED_BUILD) && mkdir -p $(COMPILED_BUILD)
	@cp -RL handfast pyproject.toml README.md LICENSE $(COMPILED_BUILD)
	@$(PY) -m handfast.agent.messages.fast_path > $(COMPILED_BUILD)/handfast/agent/messages/compiled_fast_path.py
ifdef PGO
	@set -e; tmp=$$(mktemp -d); trap 'rm -rf "$$tmp"' EXIT; trap 'exit 130' INT TERM; \
	export HATCH_MYPYC_BUILD_DIR="$$tmp/c"; mkdir "$$tmp/c"; \
	$(call WHEEL,-fprofile-generate=$$tmp/profile -fprofile-update=single); \
	for more in $(TRAINING); do rm -rf "$$tmp/out"; \
	  (cd $(COMPILED_BUILD) && '$(CURDIR)/$(PY)' -m handfast.deploy.cli simulate delta --no-report --out "$$tmp/out" $$more >"$$tmp/said" 2>&1) || \
	    { cat "$$tmp/said" >&2; exit 1; }; \
	done; \
	find $(COMPILED_BUILD) -name '*.so' -delete; rm -rf "$$tmp/c" $(COMPILED_BUILD)/*.whl; mkdir "$$tmp/c"; \
	$(call WHEEL,$(USE_PROFILE))
else
	@$(call WHEEL)
endif
	@echo 'making $(COMPILED)'
	@$(PY) -m venv --clear $(COMPILED)
	@$(COMPILED)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --only-binary :all: -r requirements/operator.txt
	@$(COMPILED)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-index $(COMPILED_BUILD)/*.whl
	@echo '$(if $(PGO),pgo)' > $@
