# make demo   the whole job on an emulated stage, ending in demo/report.html
# make test   every test
# make blender   Blender, for targets that it renders
# make campaign NAME=camera_faults COUNT=10000   a test of hours that has a short version in `make test` (tests/campaigns/)
# All do their own set-up.

SIZE ?= small
OUT ?= demo/$(SIZE)$(if $(OBJECT),-$(notdir $(basename $(OBJECT))))
SEED ?= 1
OBJECT ?=
NAME ?=
COUNT ?=
WORKERS ?= 3

.PHONY: demo blender test lint bench campaign lock clean

demo:
	@.ci/setup demo
	@.venv/bin/velatura demo --size $(SIZE) --out $(OUT) --seed $(SEED) $(if $(OBJECT),--object "$(OBJECT)")

blender:
	@.ci/setup-blender

test:
	@.ci/setup test
	@.ci/setup-blender
	@.ci/system-packages
	.venv/bin/python -m pytest -n $(WORKERS) --dist loadfile $(TESTS)

lint:
	@.ci/setup test
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports

bench:
	@.ci/setup test
	.venv/bin/python -m benchmarks $(NAME) --size $(SIZE)

campaign:
	@.ci/setup test
	@.ci/system-packages
	.venv/bin/python -m tests.campaigns.$(NAME) $(COUNT)

lock:
	.ci/lock

clean:
	rm -rf .venv .venv-blender build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
