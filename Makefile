# make demo    three responses of one policy (three-responses.html); then train a controller, write report.html
# make test    the test suite        make test-slow   the trainings it leaves out
# make test-sb3  the tests that need PyTorch (a large download)
# make test-floor  a few tests of every extra, with the lowest versions that pyproject.toml allows
# make test-busy  the test suite while every core is kept busy: no test may depend on the speed of the machine
# make docs    the documentation as a site, build/docs
# make check   lint, types, layers   make pins        renew the pinned requirements
PYTHON ?= python3
BIN := .venv/bin
WORKERS ?= 2
# a file's tests share compiled programs, so one worker runs all of them
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: demo test test-busy test-slow test-sb3 test-floor check docs pins clean

demo: .venv/base.stamp
	@$(BIN)/flytune report dial@settling_time=2.5 dial@settling_time=5 dial@settling_time=10 --duration 20 \
		--out three-responses.html
	@run=$$($(BIN)/flytune train baseline | tail -n 1) && \
	$(BIN)/flytune report "$$run" --out report.html && \
	echo "open three-responses.html and report.html in a browser"

test: .venv/dev.stamp
	$(PYTEST) -m "not slow"

# the loops are ended also where the tests fail or are interrupted; a loop whose shell was killed ends itself
BUSY := import os; shell = os.getppid()\nwhile os.getppid() == shell: sum(range(100_000))
test-busy: .venv/dev.stamp
	@for core in $$(seq $(WORKERS)); do printf '$(BUSY)\n' | $(BIN)/python - & loops="$$loops $$!"; done; \
	trap 'kill $$loops' EXIT; trap 'exit 130' INT TERM; \
	$(PYTEST) -m "not slow"

test-slow: .venv/dev.stamp
	$(PYTEST) -m slow

# TORCH says what to install where torch is missing; set PIP_INDEX_URL or PIP_FIND_LINKS to take its smaller CPU build
TORCH ?= torch==2.13.0
test-sb3: .venv/sb3.stamp
	$(PYTEST) tests/sb3 tests/test_docs.py

# an import that fails would only skip its tests, so all are imported first
FLOOR := .venv-floor
test-floor: $(FLOOR)/stamp
	$(FLOOR)/bin/python -c "import gymnasium, mujoco, onnxruntime, optuna, pybullet, stable_baselines3, tensorboard"
	$(FLOOR)/bin/python -m pytest -n $(WORKERS) --dist loadfile -m floor
	$(FLOOR)/bin/python -m sphinx -W --keep-going -q docs build/docs-floor

check: .venv/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

docs: .venv/dev.stamp
	$(BIN)/python -m sphinx -W --keep-going -q docs build/docs
	@echo "open build/docs/index.html in a browser"

.venv/base.stamp: requirements/base.txt pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/base.txt
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	touch $@

.venv/dev.stamp: requirements/dev.txt .venv/base.stamp
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/dev.txt
	touch $@

.venv/sb3.stamp: requirements/sb3.txt .venv/dev.stamp
	$(BIN)/python -c "import torch" 2>/dev/null || $(BIN)/python -m pip install --quiet "$(TORCH)"
	$(BIN)/python -m pip install --quiet --no-deps --require-hashes -r requirements/sb3.txt
	touch $@

# each `name>=version` of pyproject.toml as the constraint `name==version`
$(FLOOR)/stamp: pyproject.toml
	rm -rf $(FLOOR) && $(PYTHON) -m venv $(FLOOR)
	grep -oE '"[a-z0-9-]+>=[0-9.]+"' pyproject.toml | sed 's/"//g; s/>=/==/' | sort -u > $(FLOOR)/lowest.txt
	$(FLOOR)/bin/python -m pip install --quiet -c $(FLOOR)/lowest.txt setuptools wheel
	$(FLOOR)/bin/python -m pip install --quiet -c $(FLOOR)/lowest.txt --no-build-isolation "$(TORCH)" \
		pytest pytest-xdist hypothesis beartype -e ".[build,docs,gymnasium,mujoco,onnx,optuna,pybullet,sb3,tensorboard]"
	touch $@

PIN := $(BIN)/pip-compile --quiet --generate-hashes --allow-unsafe --strip-extras --no-header --no-annotate \
       --no-emit-index-url --no-emit-trusted-host --no-emit-find-links --no-emit-options
EXTRAS := $(foreach extra,build dev docs gymnasium mujoco onnx optuna pybullet tensorboard,--extra $(extra))
pins:
	$(PIN) --extra build -o requirements/base.txt pyproject.toml
	$(PIN) $(EXTRAS) -c requirements/base.txt -c requirements/limits.txt -o requirements/dev.txt pyproject.toml
	rm -rf build/sb3 && $(BIN)/python -m pip download --quiet --no-deps -d build/sb3 stable-baselines3
	cd build/sb3 && for file in *.whl; do echo "$$file" | sed -E 's/_/-/; s/-py3.*/ \\/; s/-([0-9.]+ )/==\1/' && \
		sha256sum "$$file" | sed -E 's/ .*//; s/^/    --hash=sha256:/'; done > ../../requirements/sb3.txt

clean:
	rm -rf .venv .venv-floor .jax_cache build runs report.html three-responses.html
