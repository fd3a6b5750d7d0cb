# make demo    train the baseline controller, fly 100 trials, write report.html
# make test    the test suite        make test-slow   the trainings it leaves out
# make check   lint, types, layers   make pins        renew the pinned requirements
PYTHON ?= python3
BIN := .venv/bin
WORKERS ?= 2
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: demo test test-slow check pins clean

demo: .venv/base.stamp
	@run=$$($(BIN)/flytune train baseline | tail -n 1) && \
	$(BIN)/flytune report "$$run" --out report.html && \
	echo "open report.html in a browser"

test: .venv/dev.stamp
	$(BIN)/python -m pytest -m "not slow" -n $(WORKERS)

test-slow: .venv/dev.stamp
	$(BIN)/python -m pytest -m slow -n $(WORKERS)

check: .venv/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

.venv/base.stamp: requirements/base.txt pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/base.txt
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	touch $@

.venv/dev.stamp: requirements/dev.txt .venv/base.stamp
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/dev.txt
	touch $@

PIN := $(BIN)/pip-compile --quiet --generate-hashes --allow-unsafe --strip-extras --no-header --no-annotate \
       --no-emit-index-url --no-emit-trusted-host --no-emit-find-links --no-emit-options
pins:
	$(PIN) --extra build -o requirements/base.txt pyproject.toml
	$(PIN) --extra build --extra dev -c requirements/base.txt -o requirements/dev.txt pyproject.toml

clean:
	rm -rf .venv .jax_cache runs report.html
