# make demo      render one picture with the reference and the adapter: out/demo.png
# make test      lint and fast tests; takes minutes
# make test-all  lint, types, fast tests and slow tests
# make test-runs quick runs of experiments and benches; .ci/run runs test-all, then test-runs
# make lint      ruff, import contracts and clang-format
# make figures   list the experiments; run them with make figures ARGS=all, or ARGS="shipped --quick"
# make types     run the type checker
# make wheel     build dist/*.whl
# make lock      write requirements.lock again, with the newest versions
# All targets except lock set up .venv first; see tools/setup.sh.
BIN := .venv/bin
WORKERS ?= 2
PYTEST = $(BIN)/python -m pytest --quiet --numprocesses $(WORKERS) --dist worksteal

.PHONY: demo test test-all test-runs lint figures types wheel lock
demo:
	@tools/setup.sh demo
	$(BIN)/nma demo

test: lint
	$(PYTEST) $(ARGS)

test-all: lint types
	$(PYTEST) -m "not runs" $(ARGS)

test-runs:
	@tools/setup.sh test
	$(PYTEST) -m runs $(ARGS)

lint:
	@tools/setup.sh test
	$(BIN)/ruff check --quiet .
	$(BIN)/ruff format --quiet --check .
	@told=$$($(BIN)/lint-imports --no-cache --no-logo) || { echo "$$told"; exit 1; }
	git ls-files '*.h' '*.cpp' '*.inl' '*.c' | xargs $(BIN)/clang-format --dry-run --Werror

figures:
	@tools/setup.sh test
	$(BIN)/python -m figures $(ARGS)

types:
	@tools/setup.sh test
	$(BIN)/mypy

wheel:
	@tools/setup.sh test
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .

lock:
	rm -rf build/lock && python3 -m venv build/lock
	build/lock/bin/pip install --quiet --editable '.[dev]'
	(head -n 1 requirements.lock; build/lock/bin/pip freeze --exclude-editable) > build/requirements.lock
	mv build/requirements.lock requirements.lock
