# Every target sets up what it needs; a fresh machine needs Python 3.11 or newer, make and git.
.DEFAULT_GOAL := help
.PHONY: help setup setup-clients setup-system quick lint test test-vcan test-flash hil accept bench mutants lock clean

BIN := .venv/bin
PY := $(BIN)/python
STAMP := .venv/.stamp
CLIENTS_STAMP := .venv-clients/.stamp
# The Python of the distribution first: it is built with profile-guided optimisation and runs a tick a fifth faster than a plain build.
PYTHONS := /usr/bin/python3.12 /usr/bin/python3.11 python3.12 python3.11 python3
SYSTEM_PACKAGES := qemu-system-x86 busybox-static cpio kmod can-utils iproute2 gcc
FLASH_PACKAGES := debootstrap e2fsprogs openssh-client
PYTHON_PACKAGES := python3-venv
# Peer that `make bench` compares with; nothing else needs it.
PEERS := mujoco==4.0.0
# For tools/ and tests/, mypy checks names, attributes and the arguments of calls. Arrays and lambdas there are checked as loosely as the code that they are passed to.
# Their cache is one of their own, as other options spoil it.
MYPY_LOOSE := --cache-dir .mypy_cache/loose --allow-untyped-defs --allow-incomplete-defs --allow-untyped-calls --allow-any-generics --no-warn-return-any \
	--no-warn-unused-ignores --implicit-reexport $(addprefix --disable-error-code=,arg-type list-item misc union-attr)
PIP_INSTALL := -m pip install --quiet --quiet --disable-pip-version-check --no-deps

# $(call make_venv,DIR): keep DIR if its Python runs, else make it with the first Python that is new enough.
define make_venv
	@$(1)/bin/python -c '' 2>/dev/null && exit 0; \
	for python in $(PYTHONS); do \
	    $$python -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || continue; \
	    exec $$python -m venv --clear $(1); \
	done; \
	echo 'setup: no Python 3.11 or newer with venv found (Debian: apt-get install python3-venv)' >&2; exit 1
endef

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1	/p' Makefile | expand -t 16

setup: $(STAMP) ## make .venv from the lock (nothing to do when up to date)

$(STAMP): requirements.lock pyproject.toml
	@echo 'setup 1/3: virtual environment .venv'
	$(call make_venv,.venv)
	@echo 'setup 2/3: packages of requirements.lock (1.3 GB on disk, a minute or two)'
	@$(PY) $(PIP_INSTALL) --require-hashes -r requirements.lock
	@echo 'setup 3/3: modcube itself, editable'
	@$(PY) $(PIP_INSTALL) --no-build-isolation --editable .
	@touch $@

setup-clients: $(CLIENTS_STAMP) ## make .venv-clients with the ground-station clients (a gigabyte)

$(CLIENTS_STAMP): requirements-clients.lock
	@rm -f $@
	@echo 'setup-clients 1/2: virtual environment .venv-clients'
	$(call make_venv,.venv-clients)
	@echo 'setup-clients 2/2: packages of requirements-clients.lock (about a gigabyte)'
	@.venv-clients/bin/python $(PIP_INSTALL) --require-hashes -r requirements-clients.lock
	@touch $@

setup-system: ## install the Debian packages of the virtual machine with real SocketCAN
	@sudo=; [ "$$(id -u)" = 0 ] || sudo=sudo; set -e; \
	echo 'setup-system: $(SYSTEM_PACKAGES) $(FLASH_PACKAGES) $(PYTHON_PACKAGES)'; \
	$$sudo apt-get -qq update; \
	$$sudo env DEBIAN_FRONTEND=noninteractive apt-get -qq install --no-install-recommends $(SYSTEM_PACKAGES) $(FLASH_PACKAGES) $(PYTHON_PACKAGES) >/dev/null

lint: setup ## ruff, mypy and the import contracts
	@$(BIN)/ruff check --quiet .
	@$(BIN)/mypy --no-error-summary
	@$(BIN)/mypy --no-error-summary $(MYPY_LOOSE) tools tests
	@found=$$($(BIN)/lint-imports --no-logo) || { echo "$$found"; exit 1; }

quick: lint ## lint and the fast tests, a minute on two idle cores: for every commit
	@$(PY) -m pytest -x -q -n 2 -m 'not slow and not vcan and not clients and not jetson'

test: setup ## lint and all tests that this machine can run; names what is left out in its last lines
	@MAKE='$(MAKE)' $(PY) tools/run_tests.py $(SYSTEM_PACKAGES)

test-vcan: setup ## the tests on real SocketCAN: here, or in the virtual machine where there is none
	@$(PY) -m pytest -rs --capture=no -m vcan tests/vcan

test-flash: setup ## flash a Debian machine with systemd, break it, cut its power: half an hour
	@$(PY) -m pytest -rs -x -m jetson tests/jetson

hil: setup ## fly the spiral on the bench and name the report
	@$(BIN)/modcube hil run spiral --out runs/spiral

accept: setup ## every acceptance figure, long ones too; writes accept.json and the tables of README and docs/figures.md
	@$(PY) tools/accept.py $(if $(ONLY),--only $(ONLY)); status=$$?; [ $$status = 2 ] || $(PY) tools/readme_tables.py; exit $$status

mutants: setup ## change limiter, supervisor and fail-safes one thing at a time: every mutant must fail its tests
	@$(PY) tools/mutants.py

bench: setup ## measure the code; writes bench.json and the tables of README and docs/figures.md
	-@$(PY) -m pip install --quiet --disable-pip-version-check $(PEERS)
	@$(PY) tools/bench.py && $(PY) tools/readme_tables.py

# The locks pin the newest releases that pyproject.toml allows; `make lock UPGRADE=--upgrade` moves the pins.
UV_COMPILE = uv pip compile --quiet --python-version 3.11 --generate-hashes --no-emit-index-url \
	--fork-strategy fewest --custom-compile-command 'make lock' $(UPGRADE)

lock: setup ## write both locks again from pyproject.toml (needs uv)
	@$(UV_COMPILE) --universal --extra bench --extra tools --extra dev pyproject.toml --output-file requirements.lock
	@$(PY) -c 'import tomllib; project = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
	print(*project["optional-dependencies"]["clients"], sep="\n")' | \
	$(UV_COMPILE) - --output-file requirements-clients.lock

clean: ## remove everything that is made
	@rm -rf .venv .venv-clients build dist runs *.egg-info .cache .hypothesis .*_cache accept.json bench.json
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
