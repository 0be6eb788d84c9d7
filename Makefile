# Every target sets up what it needs by itself; `make help` lists them.
.DEFAULT_GOAL := help
.PHONY: help demo quick kernels test test-all chaos fuzz costs slow-clients load two-hosts compose-check check up lock fast-servers servers setup setup-dev clean

BIN := .venv/bin
TESTS := $(BIN)/python -m pytest
PROCESSORS := $(shell nproc 2>/dev/null || echo 2)
# One process more than processors: many tests wait for servers, leases and timeouts.
WORKERS ?= $(shell expr $(PROCESSORS) + 1)
# Containers like to set this; then each of a hundred processes compiles all modules anew.
unexport PYTHONDONTWRITEBYTECODE

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: setup ## the whole product on the built-in face: scans in over HTTP, a fitted rig and a report out
	@$(BIN)/myoface demo

quick: setup-dev ## style, types, and unit tests that need no data and no process (a minute)
	@$(BIN)/ruff check --quiet
	@$(BIN)/ruff format --check --quiet
	@$(BIN)/mypy
	@$(TESTS) --quick --quiet -n $(PROCESSORS)

test: setup-dev ## what CI runs: the checks and all tests that are not slow (how long: docs/develop/development.md)
	@$(MAKE) --no-print-directory --jobs 3 --output-sync=target check fast-servers kernels
	@$(TESTS) -n $(WORKERS) -m "not slow or end_to_end and not servers"

test-all: servers ## also the slow tests: all on the servers, the browser, campaigns (30 minutes)
	@scripts/blender-venv || echo "no Blender here: its tests skip"
	@scripts/jax || echo "no JAX here: its tests skip"
	@scripts/mediapipe || echo "no MediaPipe here: its tests skip"
	@$(MAKE) --no-print-directory test
	@$(TESTS) -m "slow and (servers or not end_to_end)"

chaos: setup-dev ## 60 jobs while processes, disks, locks, clock and files fail; prints the tally (5 minutes)
	@$(BIN)/python -m tests.campaigns.chaos

fuzz: setup-dev ## 20,000 hostile inputs to every reader of strangers' bytes; prints what they cost
	@$(BIN)/python -m tests.campaigns.fuzz

costs: setup-dev ## the dearest requests, and another tenant beside eight who send them
	@$(BIN)/python -m tests.campaigns.costs

slow-clients: setup-dev ## 2,000 slow clients without a key, and a customer
	@$(BIN)/python -m tests.campaigns.slow_clients

load: setup-dev ## eight stations upload and look on while two workers fit; prints how long the API takes
	@$(BIN)/python -m tests.campaigns.load

two-hosts: setup-dev servers ## workers on another host, and a link that breaks (network namespaces)
	@$(BIN)/python -m tests.campaigns.two_hosts

compose-check: setup-dev servers ## docker-compose.yml: valid, and every command in it run by hand
	@$(BIN)/python -m tests.campaigns.compose

check: setup-dev ## style, types and the rooms' import rules
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/mypy
	@$(BIN)/lint-imports

kernels: setup-dev ## compile the solver's kernels, once (two minutes)
	@$(BIN)/python -m worker.kernels

up: setup ## the service with its broker and a worker, on http://127.0.0.1:8765
	@$(BIN)/myoface up

lock: setup-dev ## lock the newest allowed versions of all packages, with hashes
	@scripts/lock

fast-servers: ## install what `make test` starts by itself: PostgreSQL, Redis, Chromium, docker-compose (Debian, root)
	@scripts/servers fast

servers: ## install all that tests start by themselves: also Caddy, ip, C# (Debian, root)
	@scripts/servers

setup: ## make .venv ready for running
	@scripts/setup

setup-dev: ## make .venv ready for the tests and checks
	@scripts/setup dev

clean: ## remove what the targets made, .venv included
	rm -rf .venv .venv-blender .jax .jax.new .mediapipe .mediapipe.new demo-output build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
