# make demo    one picture of the whole path: out/demo.png
# make test    lint and tests, in minutes
# make test-all   those, types, the experiments and benches in their quick forms: what continuous integration runs
# make figures list the experiments, and how to run them: make figures ARGS=all, or ARGS="shipped --quick"
# make types   the type checker
# make wheel   dist/*.whl
# make lock    write requirements.lock anew from the newest versions
# All of them set up .venv first; see tools/setup.sh.
BIN := .venv/bin
WORKERS ?= 2
PYTEST = $(BIN)/python -m pytest --quiet --numprocesses $(WORKERS) --dist worksteal

.PHONY: demo test test-all lint figures types wheel lock
demo:
	@tools/setup.sh demo
	$(BIN)/nma demo

test: lint
	$(PYTEST) $(ARGS)

# One run of pytest, so that its summary is the last that is printed.
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
