# The verbs a newcomer needs. Each one sets up first whatever is missing.
.DEFAULT_GOAL := help
.PHONY: help setup demo test check docs lock

PYTHON := .venv/bin/python
ARGS ?=

help: ## list these commands
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1\t\2/p' $(MAKEFILE_LIST)

setup: ## install uv, .venv and system libraries (quick when there is nothing to do)
	@scripts/setup

demo: ## expert on four tasks, two policies on one; videos and report in outputs/demo (4 minutes)
	@scripts/setup
	@$(PYTHON) examples/demo.py $(ARGS)

test: ## run the tests; ARGS are passed to pytest (ARGS="-m slow")
	@scripts/setup --tests
	@$(PYTHON) -m pytest -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder $(ARGS)

check: ## lint, formatting, types and declared dependencies
	@scripts/setup
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/mypy
	@.venv/bin/deptry src research

docs: ## build the documentation site into outputs/site; links that lead nowhere fail (ARGS="serve" to look at it)
	@scripts/setup
	@NO_MKDOCS_2_WARNING=1 $(PYTHON) -m mkdocs $(or $(ARGS),build --strict)

lock: ## resolve pyproject.toml again into requirements.lock
	@scripts/setup
	@scripts/lock $(ARGS)
