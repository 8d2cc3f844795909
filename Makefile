# make demo   install into .venv and run the main job on the sample log
# make test   install, then lint, types and tests
# make bench  benchmarks: print figures, assert nothing
# make results  every figure of docs/results.md from recordings (an hour or more; needs ../shared/data)
# make docs   the documentation as a site in runs/site

PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
STAMP  := $(VENV)/.installed

.PHONY: demo test lint types bench results docs clean

demo: $(STAMP)
	$(PY) -m fusion.run --log samples/kitti06.mcap --config samples/kitti06.toml --out runs/demo --segment-lengths 10,20,30,40,50

# A worker for each core, with one thread; a file stays with one worker, so that what its tests share is made once.
test: lint types
	OMP_NUM_THREADS=1 $(PY) -m pytest --numprocesses auto --dist loadfile

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
	$(PY) benchmarks/consistency.py
	$(PY) benchmarks/online.py

# The stamp is older than these files when the installation no longer matches them.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version) if sys.version_info < (3, 11) else None'
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $(STAMP)

results: $(STAMP)
	$(PY) benchmarks/results.py

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict

clean:
	rm -rf $(VENV) runs .pytest_cache .mypy_cache .ruff_cache .hypothesis
