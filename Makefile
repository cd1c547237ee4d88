# stimrig: two commands on a fresh machine, `make demo` and `make test`; `make help` lists the others.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
VENV := .venv
BIN := $(VENV)/bin
export PYTHONUNBUFFERED = 1
export PYTHONDONTWRITEBYTECODE = # empty: the processes of a test run share what is compiled

.PHONY: docs demo test frozen check lint types serve bench soak campaigns mutation lock clean help setup setup-test simulate

help:
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

demo: setup ## one whole pre-session test on the emulated rig, with its report
	@$(BIN)/stimrig demo

serve: setup ## service and page on 127.0.0.1:8000 (emulated rig unless RIG=file is given)
	@$(BIN)/stimrig serve $(if $(RIG),--rig $(RIG))

test: setup-test lint types ## style, layers, types and every test but the campaigns
	@$(BIN)/python -m pytest -n 4 --dist loadfile -m "not wire"
	@$(BIN)/python -m pytest -n 2 --dist loadfile -m wire

check: setup-test lint ## run at each save: style, layers and the fast tests
	@$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow and not wire and not browser"

lint: setup-test ## style and layers
	@$(BIN)/ruff check . ; $(BIN)/ruff format --check .
	@$(BIN)/lint-imports --no-cache

types: setup-test ## types
	@$(BIN)/pyrefly check --min-severity error

bench: $(VENV)-bench/.bench ## the figures in docs/, measured on this machine
	@$(VENV)-bench/bin/python -m bench

docs: $(VENV)-docs/.docs ## the site of the documentation, in build/site; its notebooks are run (NOTEBOOKS=off: not), a warning is an error
	@$(VENV)-docs/bin/python -m sphinx -c docs -W -n --keep-going -q -d build/doctrees . build/site
	@echo "build/site/index.html"

soak: setup-test ## an hour of recording with fits beside it (docs/results/soak.md)
	@$(BIN)/python -m bench.soak --minutes 60

campaigns: setup-test ## tests that take long or need an idle machine
	@$(BIN)/python -m pytest -m campaign

frozen: setup-test ## what users hold, compared with golden files (tests/frozen/README.md); ONLY=PATTERN
	@$(BIN)/python -m tests.frozen check --only '$(ONLY)'

simulate: setup-test ## lives of a rig in simulated time; MINUTES=10 or LIVES=1000, SEED=1 (docs/simulator.md)
	@$(BIN)/python -m tests.simulator --seed $(or $(SEED),1) $(if $(LIVES),--lives $(LIVES),--minutes $(or $(MINUTES),10))

mutation: setup-test ## which changes of the rig's safety code no test sees (docs/results/mutation.md; needs mutmut)
	@$(BIN)/python -m mutmut run --max-children 2
	@$(BIN)/python -m mutmut results

setup: $(VENV)/.run ## the virtual environment from the hash-locked list

setup-test: $(VENV)/.test ## what tests need, a browser included

$(VENV)/.run: requirements/run.txt pyproject.toml deploy/setup.sh
	@bash deploy/setup.sh run

$(VENV)/.test: requirements/test.txt pyproject.toml deploy/setup.sh
	@bash deploy/setup.sh test

$(VENV)-docs/.docs: requirements/docs.txt pyproject.toml deploy/setup.sh
	@bash deploy/setup.sh docs

$(VENV)-bench/.bench: requirements/bench.txt pyproject.toml deploy/setup.sh
	@bash deploy/setup.sh bench

lock: ## resolve the locked lists anew (needs uv; for maintainers)
	@bash deploy/lock.sh

clean: ## remove the environment and what tools left
	@rm -rf $(VENV) $(VENV)-bench $(VENV)-docs build *.egg-info .ruff_cache .pytest_cache
