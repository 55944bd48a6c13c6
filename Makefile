# `make demo` and `make test` are enough by themselves: they set up what is missing first.
VENV ?= .venv
RUN = "$(VENV)/bin/python" -m
# a file's tests stay together, because they share what they have tracked; a process that has crashed is not started
# again, because the new one would repeat the test that crashed it
EACH_CORE = -n auto --dist loadfile --max-worker-restart 0

# compiled modules are kept: each process that a test starts would compile tk again
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help install demo test test-slow test-random lint format docs bench clean
.DEFAULT_GOAL := help

help:
	@echo "make demo       track the capture that ships with tk, compare with its truth"
	@echo "make test       the tests"
	@echo "make test-slow  the accuracy tests on whole captures (minutes)"
	@echo "make test-random  the tests, with new random examples"
	@echo "make lint       ruff and mypy"
	@echo "make docs       the pages of docs/ as a site, in docs/_build/html"
	@echo "make bench      the benchmarks of scripts/bench.py"
	@echo "make install    only set up $(VENV)"
	@echo "make clean      remove $(VENV) and caches"
	@echo "PYTHON=python3.12 chooses the interpreter, VENV=folder where to install"

install: $(VENV)/.installed

# the stamp: set up again only when the dependencies or the set-up have changed
$(VENV)/.installed: pyproject.toml scripts/setup.sh
	@bash scripts/setup.sh "$(VENV)"
	@touch "$@"

demo: install
	@"$(VENV)/bin/tk" demo --force

test: install
	@$(RUN) pytest $(EACH_CORE)

test-slow: install
	@$(RUN) pytest -m slow --timeout 3600

test-random: install
	@$(RUN) pytest $(EACH_CORE) --hypothesis-profile default

lint: install
	@$(RUN) ruff check .
	@$(RUN) ruff format --check .
	@$(RUN) mypy

format: install
	@$(RUN) ruff check --fix .
	@$(RUN) ruff format .

docs: install
	@$(RUN) sphinx -W --keep-going -q -b html docs docs/_build/html

bench: install
	@$(RUN) scripts.bench

clean:
	rm -rf "$(VENV)" docs/_build .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist *.egg-info
	find tk tests scripts -name __pycache__ -type d -prune -exec rm -rf {} +
