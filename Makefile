# make demo   the whole job on an emulated stage, ending in demo/report.html
# make test   every test
# make blender   Blender, for targets that it renders
# Both do their own set-up.

SIZE ?= small
OUT ?= demo/$(SIZE)$(if $(OBJECT),-$(notdir $(basename $(OBJECT))))
SEED ?= 1
OBJECT ?=
NAME ?=

.PHONY: demo blender test lint bench lock clean

demo:
	@.ci/setup demo
	@.venv/bin/velatura demo --size $(SIZE) --out $(OUT) --seed $(SEED) $(if $(OBJECT),--object "$(OBJECT)")

blender:
	@.ci/setup-blender

test:
	@.ci/setup test
	@.ci/setup-blender
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
	rm -rf .venv .venv-blender build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
