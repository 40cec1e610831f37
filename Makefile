# make demo   the whole job on an emulated stage, ending in demo/report.html; OBJECT=painting, relief or statue; PROJECTORS=1; CAMERAS=2
# make test   every test but the long ones; WORKERS=3 chooses how many run side by side, TESTS=tests/hal which
# make test-long   the long ones: booted machines, whole stages, a second renderer
# make test-all    both at once, in less time than one after the other: the others run while a long one waits
# make check  lint, types, import contracts, documentation and the fast tests, side by side, in two minutes
# make docs   this documentation as a website in build/docs; fails on a broken link
# make figures   measured figures into the documents that name them, and the pages of the study from their data
# make blender   Blender, for targets that it renders
# make campaign NAME=camera_faults COUNT=10000   a test of hours that has a short version in `make test` (tests/campaigns/)
# make campaign NAME=mutants COUNT=100 SEED=7   changed lines that no test notices; continues where it stopped
# make deb DEBIAN=bookworm   the Debian package of a kiosk in build/; trixie too, with DEBIAN_ROOT=the root folder of a Debian 13
# make nightly COUNT=3   every experiment of the study at size small, for so many seeds; about an hour for each
# All do their own set-up.

# A demo or a test run starts many Python programs, each of which would compile all of its modules anew.
unexport PYTHONDONTWRITEBYTECODE

SIZE ?= small
# The mesh's name without its folder and ending; make's own functions would split it at its spaces.
empty :=
OBJECT_NAME = $(notdir $(basename $(subst $(empty) $(empty),_,$(OBJECT))))
quoted = '$(subst ','\'',$(1))'
ROOM ?=
PROJECTORS ?=
CAMERAS ?=
OUT ?= demo/$(SIZE)$(if $(OBJECT),-$(OBJECT_NAME))$(if $(ROOM),-$(ROOM))$(if $(PROJECTORS),-$(PROJECTORS))$(if $(CAMERAS),-$(CAMERAS)-cameras)
SEED ?= 1
OBJECT ?=
DEBIAN ?= bookworm
DEBIAN_ROOT ?=
NAME ?=
COUNT ?=
CORES := $(shell nproc 2>/dev/null || echo 2)
# Many tests wait for devices and programs, so there are more workers than cores. A worker that crashed is not started
# again: pytest-xdist would run its file again and again, without an end.
WORKERS ?= $(shell expr $(CORES) + 2)
# Folders of tests that need no other program. `slow` marks those that take seconds.
FAST ?= tests/hal/codecs $(addprefix tests/controller/,bundle config core kiosk/decide optics stage/report) \
	tests/plugins/ptp tests/test_architecture.py tests/test_house.py
DOCS_PYTHON ?= .venv/bin/python

.PHONY: deb demo docs figures blender test test-long test-all test-setup fast check lint style types contracts website timings campaign nightly lock clean

demo:
	@.ci/setup demo
	@.venv/bin/velatura demo --size $(SIZE) --out $(call quoted,$(OUT)) --seed $(SEED) $(if $(ROOM),--room $(ROOM)) $(if $(PROJECTORS),--projectors $(PROJECTORS)) $(if $(CAMERAS),--cameras $(CAMERAS)) $(if $(OBJECT),--object $(call quoted,$(OBJECT)))

blender:
	@.ci/setup-blender

PYTEST := .venv/bin/python -m pytest --durations=10 -n $(WORKERS) --dist loadfile --max-worker-restart=0

test: test-setup
	$(PYTEST) $(if $(TESTS),$(TESTS),-m "not long")

test-long: test-setup
	$(PYTEST) -m long $(TESTS)

test-all: test-setup
	$(PYTEST) $(TESTS)

test-setup:
	@.ci/setup test
	@.ci/setup-blender
	@.ci/setup-peer homeassistant
	@.ci/setup-peer openapi
	@.ci/system-packages
	@.ci/setup-npm
	@.venv/bin/python -m hal.runtime.kernels compile
	@.venv/bin/python -m tests.booted.trees
	@.venv/bin/python -m tests.real_kernel.machine

check:
	@.ci/setup test
	@$(MAKE) --no-print-directory --jobs=$(CORES) --output-sync=target style types contracts website fast

# The parts of `check` have their set-up done.
fast:
	@.venv/bin/python -m hal.runtime.kernels compile
	.venv/bin/python -m pytest -q -m "not slow" -n $(WORKERS) --dist loadfile $(FAST)

style:
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .

types:
	.venv/bin/mypy

contracts:
	.venv/bin/lint-imports

website:
	$(DOCS_PYTHON) -m docs.figures
	$(DOCS_PYTHON) -m sphinx --jobs auto --quiet --fail-on-warning --keep-going docs build/docs

lint:
	@.ci/setup test
	@$(MAKE) --no-print-directory style types contracts

figures:
	@.ci/setup test
	$(DOCS_PYTHON) -m docs.figures write

docs:
	@.ci/setup test
	@$(MAKE) --no-print-directory website

timings:
	@.ci/setup test
	.venv/bin/python -m lab.timings $(NAME) --size $(SIZE)

nightly:
	@.ci/setup test
	@.ci/setup-blender
	.venv/bin/python -m tests.campaigns.study $(COUNT)

campaign:
	@.ci/setup test
	@.ci/system-packages
	.venv/bin/python -m tests.campaigns.$(NAME) $(COUNT) $(if $(filter-out file,$(origin SEED)),$(SEED))

deb:
	@.ci/setup demo
	@.venv/bin/python .ci/debian_package.py $(DEBIAN) --out build $(if $(DEBIAN_ROOT),--debian $(call quoted,$(DEBIAN_ROOT)))

lock:
	.ci/lock

clean:
	@if [ -x .venv/bin/python ]; then python=.venv/bin/python; else python=python3; fi; \
	  PYTHONDONTWRITEBYTECODE=1 "$$python" -m hal.runtime.caches remove
	rm -rf .venv .venv-blender .venv-homeassistant .venv-openapi .venv-npm build docs/generated *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
