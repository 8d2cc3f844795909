# make demo   install into .venv and run the main job on the sample log
# make test   install, then lint, types and tests
# make bench  benchmarks: print figures, assert nothing

PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
STAMP  := $(VENV)/.installed

.PHONY: demo test lint types bench clean

demo: $(STAMP)
	$(PY) -m fusion.run --log samples/kitti06.mcap --config samples/kitti06.toml --out runs/demo --segment-lengths 10,20,30,40,50

test: lint types
	$(PY) -m pytest

lint: $(STAMP)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

types: $(STAMP)
	$(PY) -m mypy

bench: $(STAMP)
	$(PY) benchmarks/memory.py
	$(PY) benchmarks/speed.py
	$(PY) benchmarks/simulator.py
	$(PY) benchmarks/claims.py
	$(PY) benchmarks/covariance.py

# The stamp is older than these files when the installation no longer matches them.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version) if sys.version_info < (3, 11) else None'
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $(STAMP)

clean:
	rm -rf $(VENV) runs .pytest_cache .mypy_cache .ruff_cache .hypothesis
