# Common commands. Each one installs missing requirements first.
.DEFAULT_GOAL := help
.PHONY: help setup demo test check docs lock

PYTHON := .venv/bin/python
ARGS ?=

help: ## list the commands
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1\t\2/p' $(MAKEFILE_LIST)

setup: ## install uv, .venv and system libraries (fast if complete)
	@scripts/setup

demo: ## evaluate the expert and two shipped policies; videos and a report in outputs/demo (4 minutes)
	@scripts/setup
	@$(PYTHON) examples/demo.py $(ARGS)

test: ## run the tests; ARGS are arguments of pytest (ARGS="-m slow")
	@scripts/setup --tests
	@$(PYTHON) -m pytest -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder $(ARGS)

check: ## check lint, format, types and declared dependencies
	@scripts/setup
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/mypy
	@.venv/bin/deptry src research tools

docs: ## build the documentation site into outputs/site; broken links fail (ARGS="serve" for a preview)
	@scripts/setup
	@NO_MKDOCS_2_WARNING=1 $(PYTHON) -m mkdocs $(or $(ARGS),build --strict)

lock: ## update requirements.lock from pyproject.toml
	@scripts/setup
	@scripts/lock $(ARGS)
