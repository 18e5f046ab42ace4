PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin
DEMO := demo
# MNIST, where it is at hand: tests and benchmarks that need the real digits look there
IMAGES ?= $(firstword $(wildcard $(SPADMNIST_DATA)) $(wildcard ../shared/mnist))

.PHONY: help demo test verify verify-all docs docs-two faults bench profile matrix package challenge lint clean

help:  ## say what there is
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(VENV)/installed: pyproject.toml
	test -x $(RUN)/python || $(PYTHON) -m venv $(VENV)
	$(RUN)/python -m pip install --quiet --upgrade pip
	$(RUN)/python -m pip install --quiet -e '.[dev]'
	@touch $@

demo: $(VENV)/installed  ## set up, and run the main job in seconds: digits, four light levels, three readouts
	@echo "spadmnist generate configs/quick.yaml -o $(DEMO)/quick"
	@$(RUN)/spadmnist generate configs/quick.yaml -o $(DEMO)/quick
	@$(RUN)/spadmnist verify $(DEMO)/quick
	@$(RUN)/spadmnist inspect $(DEMO)/quick --plot $(DEMO)/quick.png > /dev/null
	@echo
	@echo "Look at $(DEMO)/quick.png: the same digits from 5 to 2560 mlux, in every readout and reconstruction."
	@echo "Then read $(DEMO)/quick/config.yaml, change configs/quick.yaml, or open the data:"
	@echo "  $(RUN)/python -c \"import spadmnist; print(spadmnist.open('$(DEMO)/quick')['2560 mlux', 'train'].tr[0])\""

# Neighbours stay together, for what they share, until a worker has nothing left to do. The tests start programs by the
# hundred: compiled modules are kept for them, wherever the environment says that none be written
test verify verify-all: export PYTHONDONTWRITEBYTECODE =
PYTEST = $(RUN)/python -m pytest -q -n 2 --dist worksteal

test: $(VENV)/installed lint  ## set up, and run the tests (a quarter of an hour)
	$(PYTEST) -m "not slow"

verify: $(VENV)/installed  ## the slow statistical and fault tests
	$(PYTEST) -m "slow and not long"

verify-all: $(VENV)/installed  ## the same, and the tests that take minutes each
	$(PYTEST) -m slow

# Tries of each class at most, drawn by lot, which take an hour on two slow cores. TRIES=700 takes all kills and full disks
# there are: python scripts/faults.py list
TRIES ?= 100

faults: $(VENV)/installed  ## kills, full disks, damage and hostile files by the thousand (up to an hour)
	$(RUN)/python scripts/faults.py run --sample $(TRIES) -o docs/faults.md

$(VENV)/installed-docs: $(VENV)/installed
	$(RUN)/python -m pip install --quiet -e '.[docs]'
	@touch $@

# Pages of the gallery and the reference are made from the classes; a warning is an error. Cells that did not change are
# not executed again (build/docs-cells). One page at a time: what its cells call uses all cores
DOCS = build/docs

docs: $(VENV)/installed-docs  ## build the pages with every cell executed, into build/docs (minutes; again: seconds)
	$(RUN)/python -m sphinx -W --keep-going -q -b html $(DOCS_ONLY) docs $(DOCS)
	@echo "Open $(DOCS)/index.html"

# All pages, all links; of the notebooks the first two alone are executed
docs-two: DOCS = build/docs-two
docs-two: DOCS_ONLY = -t two
docs-two: docs  ## the same with the cells of two pages alone: what a change must pass

lint: $(VENV)/installed
	$(RUN)/ruff check spadmnist scripts tests docs
	$(RUN)/ruff format --check spadmnist scripts tests docs/conf.py docs/_pages
	$(RUN)/mypy

bench: $(VENV)/installed  ## measure the benchmark's table on this machine (about ten minutes; never fails on time)
	$(RUN)/python scripts/benchmark.py $(if $(IMAGES),--images-dir $(IMAGES)) --output benchmarks.md

# For example OPTIONS="--limit 20000 --lux all --threads"
OPTIONS ?=
profile: export PYTHONDONTWRITEBYTECODE =

profile: $(VENV)/installed  ## where the time of a generate goes: a table and a timeline of its workers, in build/profile
	$(RUN)/python scripts/timeline.py $(if $(IMAGES),--images-dir $(IMAGES)) $(OPTIONS)

matrix: $(VENV)/installed  ## the same bytes under each Python, oldest and newest libraries? (minutes for each)
	$(RUN)/python scripts/matrix.py -o build/matrix

# So many cases of the list, drawn by lot; QUICK= for all simulations. What is there is not made again, and only missing
# answers are asked for, no new ones after so many minutes: run it again to go on. The score is of what has been asked
CASES ?= all
SAMPLE ?= 150
QUICK ?= --quick
MINUTES ?= 90
CHALLENGE ?= $(DEMO)/challenge

package: $(VENV)/installed  ## build sdist and wheel, install the wheel in an empty environment, run the first commands there
	$(PYTHON) scripts/package.py

challenge: $(VENV)/installed  ## hidden effects of an independent generator, diagnosed blind, then scored
	@test -d $(CHALLENGE)/cases || $(RUN)/python scripts/challenge.py make $(CASES) --sample $(SAMPLE) -o $(CHALLENGE)
	@$(RUN)/python scripts/challenge.py run $(CHALLENGE) $(QUICK) --minutes $(MINUTES) || true
	@$(RUN)/python scripts/challenge.py score $(CHALLENGE)

clean:  ## remove what was made here
	rm -rf $(VENV) $(DEMO) benchmarks.md build .pytest_cache .mypy_cache .ruff_cache .hypothesis
