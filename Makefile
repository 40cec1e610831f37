# make demo   the whole job on an emulated stage, ending in demo/report.html
# make test   every test
# Both do their own set-up.

SIZE ?= small
OUT ?= demo/$(SIZE)$(if $(OBJECT),-$(notdir $(basename $(OBJECT))))
SEED ?= 1
OBJECT ?=
NAME ?=

.PHONY: demo test lint bench lock clean

demo:
	@.ci/setup demo
	@.venv/bin/velatura demo --size $(SIZE) --out $(OUT) --seed $(SEED) $(if $(OBJECT),--object "$(OBJECT)")

test:
	@.ci/setup test
	@.ci/system-packages
	.venv/bin/python -m pytest $(TESTS)

lint:
	@.ci/setup test
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports

bench:
	@.ci/setup test
	.venv/bin/python -m benchmarks $(NAME) --size $(SIZE)

lock:
	.ci/lock

clean:
	rm -rf .venv build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
