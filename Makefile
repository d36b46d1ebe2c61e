# make demo      render one picture with the reference and the adapter: out/demo.png
# make test      lint and fast tests; takes minutes
# make test-all  lint, types and all tests, with quick runs of the experiments and benches; what .ci/run runs
# make lint      ruff, import contracts and clang-format
# make figures   list the experiments; run them with make figures ARGS=all, or ARGS="shipped --quick"
# make types     run the type checker
# make wheel     build dist/*.whl
# make lock      write requirements.lock again, with the newest versions
# All targets except lock set up .venv first; see tools/setup.sh.
BIN := .venv/bin
WORKERS ?= 2
PYTEST = $(BIN)/python -m pytest --quiet --numprocesses $(WORKERS) --dist worksteal

.PHONY: demo test test-all lint figures types wheel lock
demo:
	@tools/setup.sh demo
	$(BIN)/nma demo

test: lint
	$(PYTEST) $(ARGS)

# All tests run in one pytest process, so that its summary comes last.
test-all: lint types
	$(PYTEST) -m "slow or not slow" $(ARGS)

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
