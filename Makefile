# Every target sets up what it needs by itself; `make help` lists them.
.DEFAULT_GOAL := help
.PHONY: help demo test test-all check up lock servers setup setup-dev clean

BIN := .venv/bin
TESTS := $(BIN)/python -m pytest

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: setup ## the whole product on the built-in face: scans in over HTTP, a fitted rig and a report out
	@$(BIN)/myoface demo

test: check servers ## the checks, the fast tests and one end-to-end run (under 10 minutes on two cores)
	@$(TESTS) -m "not slow or end_to_end"

test-all: check servers ## every test there is, the slow ones too
	@scripts/blender-venv || echo "no Blender here: its tests skip"
	@$(TESTS)

check: setup-dev ## style, types and the rooms' import rules
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/mypy
	@$(BIN)/lint-imports

up: setup ## the service with its broker and a worker, on http://127.0.0.1:8765
	@$(BIN)/myoface up

lock: setup-dev ## lock the newest allowed versions of all packages, with hashes
	@scripts/lock

servers: ## install what the tests start by themselves: PostgreSQL, Redis, Chromium ... (Debian, root)
	@scripts/servers

setup: ## make .venv ready for running
	@scripts/setup

setup-dev: ## make .venv ready for the tests and checks
	@scripts/setup dev

clean: ## remove what the targets made, .venv included
	rm -rf .venv .venv-blender demo-output build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
