# `make` alone lists the targets. Each sets up .venv by itself, once.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help
.PHONY: help demo test quick nightly trials processors noble mutants docs setup clean


ARGS ?=
PYTHON ?=

# A graph of ours talks to this machine only, and tests to no other graph on it.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
# Several processes import the same tests: bytecode that one has made serves the others.
test nightly processors noble: export PYTHONDONTWRITEBYTECODE :=
# Above 101 the ports of DDS collide with those that Linux hands out.
test quick nightly processors noble: export ROS_DOMAIN_ID ?= $(shell echo $$((RANDOM % 101 + 1)))

# A sourced Jazzy is used as it is; elsewhere its wheels come from PyPI.
JAZZY := $(shell [ "$${ROS_DISTRO:-}" = jazzy ] && python3 -c 'import rclpy' 2> /dev/null && echo yes)
KIND := $(if $(JAZZY),jazzy,wheels)
# Two stamps: .venv was made of this kind (and this PYTHON, if one is asked for); the package is installed in it.
MADE := $(firstword $(wildcard .venv/made-$(KIND)$(if $(PYTHON),-$(notdir $(PYTHON)))*) \
                    .venv/made-$(KIND)-$(notdir $(or $(PYTHON),python3)))
INSTALLED := .venv/installed
NIGHTLY := .venv/installed-nightly

help:
	@cat <<'TEXT'
	make demo              simulated stroke, uncompensated and compensated; writes plots and a bag
	make demo ARGS="..."   the same with options, e.g. ARGS="--law linear"; ARGS=--help lists them
	make test              what CI runs: some nine minutes on two cores
	make test ARGS="..."   some of the tests, e.g. ARGS="-k bags"
	make quick             the tests without live nodes, long sweeps and builds: under a minute
	make nightly           all tests, with coverage, as on other processors, some mutants: one to two hours; CONTRIBUTING.md says more
	make trials ARGS="..." faults, long runs and benches of development, e.g. ARGS="faults --only foreign"
	make processors        the tests without live nodes as on four other processors: some minutes each; prints a table
	make noble             the tests without live nodes with the NumPy of Ubuntu 24.04 (Python 3.10 to 3.12)
	make mutants           200 random changes of the core: tests of the changed folder shall notice 92 %
	make mutants ARGS="..."  with options, e.g. ARGS="--seed 2 --processes 4"; ARGS=--help lists them
	make docs              the pages in docs/ as HTML in site/; a warning or a broken link fails
	make setup             only .venv with the package in it
	make clean             removes .venv and everything that was built or written
	PYTHON=python3.12      chooses the interpreter, 3.10 to 3.13
	TEXT

demo: setup
	@exec .venv/bin/straightcomp demo $(ARGS)

PYTEST := OPENBLAS_NUM_THREADS=1 .venv/bin/python -m pytest
# One process more than there are cores, since many tests wait for programs that they start.
PARALLEL := -n $$(( $$(nproc) + 1 )) --dist worksteal
# Live nodes share the machine with nothing else; the other tests share out its cores first.
define TEST_ALL
code=0
echo "Tests without live nodes:"
$(PYTEST) -m "not live and not nightly" $(PARALLEL) || code=1
echo "Tests of live nodes, one after the other:"
$(PYTEST) test/nodes -m "live and not nightly" --rerun-show-tracebacks || code=1
[ $$code = 0 ] || { echo "Tests failed: see above." >&2; exit 1; }
endef
test: setup
	$(if $(ARGS),exec .venv/bin/python -m pytest $(ARGS),$(TEST_ALL))

# What of the core is only reached through a running graph is not tested well enough: it has a figure of its own.
CORE := analysis control messages model stage straightness timing
CORE_FILES := straightcomp_ros/contract.py straightcomp_ros/parameters/declaration.py
comma_separated = $(subst $(space),$(comma),$(strip $(1)))
# What sums, solves and fits the most.
PROCESSOR_DEPENDENT := model straightness $(addprefix analysis/test_,assessment.py figures_of_strokes.py metrics.py) tuning/survey \
  bench/test_graph_bench.py control/test_observer.py control/test_sliding_mode.py
nightly: $(NIGHTLY)
	@mkdir -p .coverage_data
	.venv/bin/python -m coverage erase
	code=0
	echo "All tests without live nodes, with branch coverage:"
	$(PYTEST) -m "not live" $(PARALLEL) --cov --cov-report= || code=1
	echo "All tests of live nodes, and those in a guest kernel:"
	$(PYTEST) test/nodes test/trials test/kernel -m live --cov --cov-append --cov-report= --rerun-show-tracebacks || code=1
	echo "Branch coverage of the core:"
	.venv/bin/python -m coverage report --fail-under=95 --include='$(call comma_separated,$(CORE:%=straightcomp_ros/%/*) $(CORE_FILES))' || code=1
	echo "Branch coverage of all:"
	.venv/bin/python -m coverage report --fail-under=85 || code=1
	echo "Some tests as on other processors:"
	.venv/bin/python scripts/processors.py -m "not live and not nightly" -n logical --dist worksteal $(PROCESSOR_DEPENDENT:%=test/%) || code=1
	echo "The tests of make test without live nodes, with Ubuntu 24.04's NumPy:"
	$(MAKE) --no-print-directory noble || code=1
	echo "Do the tests notice changes of the core?"
	$(MAKE) --no-print-directory mutants ARGS="--number 40 --processes $$(nproc) --seed $$(date +%j)" || code=1
	[ $$code = 0 ] || { echo "Tests failed: see above." >&2; exit 1; }

# No live graph, no build, no whole strokes: what a change of an equation, a format or a parameter needs while one works.
QUICK := model control straightness timing doctor packaging/test_gates.py messages parameters
LONGER := control/test_learning.py control/test_smc_observer.py
quick: setup
	@exec .venv/bin/python -m pytest $(QUICK:%=test/%) $(LONGER:%=--ignore=test/%) $(ARGS)

trials: setup
	@exec .venv/bin/python -m trials $(ARGS)

processors: setup
	@exec .venv/bin/python scripts/processors.py -n logical --dist worksteal $(ARGS)

# NumPy, and with the desktop Matplotlib, as a sourced Jazzy brings them; that of the wheels comes with newer ones.
noble: setup
	@$(if $(JAZZY),echo "A sourced Jazzy's own: make test has shown it"; exit,)
	if [ ! -e .venv/noble/installed ]; then
	  .venv/bin/python -m venv --clear .venv/noble
	  .venv/noble/bin/python -m pip install --quiet --disable-pip-version-check --no-compile --editable '.[ros,test]' 'numpy==1.26.*' 'matplotlib<3.8'
	  touch .venv/noble/installed
	fi
	OPENBLAS_NUM_THREADS=1 exec .venv/noble/bin/python -m pytest -m "not live and not nightly" $(PARALLEL) $(ARGS)

# Ends with an error if the draw refutes that the tests of the core's folders notice 92 % of all changes.
mutants: $(NIGHTLY)
	@OPENBLAS_NUM_THREADS=1 exec .venv/bin/python scripts/mutants.py $(ARGS)

docs: setup
	@.venv/bin/python -c 'import material' 2> /dev/null || $(INSTALL) --quiet '.[docs]'
	NO_MKDOCS_2_WARNING=1 .venv/bin/python -m mkdocs build --strict
	echo "site/index.html"

# One line that changes, where it goes to a terminal. Errors of pip are on standard error.
PIP_PROGRESS := if [ -t 1 ]; then awk '{ line = "" } /^Collecting/ { line = ++n " packages: " $$2 } \
  /^Building|^Preparing|^Installing/ { line = "unpacking " n " packages" } \
  line { printf "\r\033[K  %s", line; fflush() } END { printf "\r\033[K" }'; else cat > /dev/null; fi

# Bytecode of what is used is made by scripts/prepare.py; that of everything takes as long as to unpack it.
INSTALL := .venv/bin/python -m pip install --disable-pip-version-check --no-compile --editable

setup: $(INSTALLED)

$(INSTALLED): $(MADE) setup.py setup.cfg package.xml pyproject.toml
	@echo "Installing the package and what it needs into .venv: one to three minutes the first time ..."
	$(INSTALL) '.[$(if $(JAZZY),,ros$(comma))test]' | $(PIP_PROGRESS)
	echo "Compiling the control laws ..."
	PYTHONDONTWRITEBYTECODE= .venv/bin/python scripts/prepare.py
	touch $@

$(NIGHTLY): $(INSTALLED)
	@echo "Installing what only the nightly tests need ..."
	$(INSTALL) '.[nightly]' | $(PIP_PROGRESS)
	if [ "$$(id -u)" = 0 ] && command -v apt-get > /dev/null; then
	  apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
	    user-mode-linux kmod iproute2 can-utils gcc libc6-dev ||
	    echo "Not installed: user-mode-linux, kmod, iproute2, can-utils, gcc; the tests of a kernel's CAN are skipped." >&2
	fi
	touch $@

comma := ,
space := $(subst ,, )

$(MADE):
	@fits() { "$$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2> /dev/null; }
	first_fitting() { for python in "$$@"; do if fits "$$python"; then echo "$$python"; return; fi; done; }
	apt() {
	  [ "$$(id -u)" = 0 ] && command -v apt-get > /dev/null || return 1
	  echo "Installing $$* with apt-get ..."
	  apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$$@" > /dev/null
	}
	candidates=($(or $(PYTHON),$(if $(JAZZY),python3,python3 python3.13 python3.12 python3.11 python3.10)))
	# Distributions build theirs with profile-guided optimisation: the loop's nodes take 10 % less of a core with it.
	system=/usr/bin/python3
	if [ -z "$(PYTHON)" ] && "$$system" -c 'import ensurepip, venv' 2> /dev/null; then candidates=("$$system" "$${candidates[@]}"); fi
	python=$$(first_fitting "$${candidates[@]}")
	if [ -z "$$python" ] && [ -z "$(PYTHON)" ]; then
	  apt python3 python3-venv || true
	  python=$$(first_fitting "$${candidates[@]}")
	fi
	if [ -z "$$python" ]; then
	  echo "No Python 3.10 to 3.13 among: $${candidates[*]}" >&2
	  echo "Remedy: sudo apt-get install python3 python3-venv, or name an interpreter: make PYTHON=/path/to/python3.12" >&2
	  exit 1
	fi
	venv_package=$$("$$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
	if ! "$$python" -c 'import ensurepip, venv' 2> /dev/null && ! apt "$$venv_package"; then
	  echo "$$python cannot make virtual environments. Remedy: sudo apt-get install $$venv_package" >&2
	  exit 1
	fi
	echo "Making .venv with $$("$$python" --version)$(if $(JAZZY), and the sourced ROS 2 Jazzy) ..."
	rm -rf .venv
	"$$python" -m venv $(if $(JAZZY),--system-site-packages) .venv
	touch $@

clean:
	rm -rf .venv build install log demo_output site *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis .coverage*
	find straightcomp_ros trials test launch -name __pycache__ -type d -prune -exec rm -rf {} +
