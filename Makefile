# make train | test | test-order | test-deep | test-slow | coverage | test-browser | test-site | test-lowest | test-newest | package | bench | bench-jaxmarl | bench-quick | bench-training | bench-gpu | fleet | fleet-campaign | benchmarl | upstream | pictures | docs | page-libraries | weight | check | format
# (each sets up what it needs)

PYTHON ?= python3
VENV   ?= .venv
TORCH  ?= torch==2.13.0
PY     := $(VENV)/bin/python
# Modules are compiled, and kept so, when they are first imported: pip would compile all of them.
PIP     = $(PY) -m pip install --quiet --disable-pip-version-check --no-compile $(CONSTRAINTS)
export PYTHONDONTWRITEBYTECODE :=

RUN := runs/timeline_$(shell date +%Y-%m-%d_%H-%M-%S)
.PHONY: train test test-order test-deep test-slow coverage test-browser test-site test-lowest test-newest package bench bench-jaxmarl bench-quick bench-training bench-gpu fleet fleet-campaign benchmarl upstream pictures docs page-libraries weight check format clean

train: $(VENV)/base
	$(VENV)/bin/damian train scenario=delaybench/crowded delay.obs=1..7 aware=timeline \
	  frames=1000000 hydra.run.dir=$(RUN) $(ARGS)
	$(VENV)/bin/damian evaluate checkpoint=$(RUN) delay.obs=2 # which it was not trained for

# Each of the two takes half of the tests, and of the other's rest when it is done: what a module shares is made once.
test: $(VENV)/test
	$(PY) -m pytest -n 2 --dist worksteal $(ARGS)

# Every test must pass alone and in any order: twice in a random order, then each module by itself.
test-order: $(VENV)/test
	$(PY) -m pytest -n 2 --random-order $(ARGS)
	$(PY) -m pytest -n 2 --random-order $(ARGS)
	mkdir -p build
	for file in $$(find tests -name 'test_*.py' | sort); do \
	  $(PY) -m pytest -q $$file > build/alone.log 2>&1 || [ $$? = 5 ] || { cat build/alone.log; exit 1; }; done

# Property tests with thousands of new random examples each.
test-deep: $(VENV)/test
	$(PY) -m pytest -n 2 -m "property and not slow" --hypothesis-profile=deep $(ARGS)

# Lines and branches that the tests run, programs in other processes not counted. OC_CAUSE: OmegaConf takes coverage for a
# debugger, for which its errors differ.
coverage: $(VENV)/dev
	OC_CAUSE=0 $(PY) -m pytest -n 2 --cov=damian --cov=recipes --cov-branch --cov-report=term:skip-covered $(ARGS)

test-slow: $(VENV)/slow
	OMP_NUM_THREADS=1 $(PY) -m pytest -n 2 --dist worksteal -m slow $(ARGS)

# The replay page, the map of a fleet, and every page of the documentation site, in Chromium: Debian and Ubuntu have it in these packages.
CHROMIUM = command -v chromium && command -v chromedriver || (apt-get update && apt-get install -y chromium chromium-driver)
test-browser: $(VENV)/browser $(VENV)/fleet
	$(CHROMIUM)
	$(PY) -m pytest -m browser tests/show/test_replay_browser.py $(ARGS)
	cd examples/fleet && $(abspath $(PY)) -m pytest -m browser $(ARGS)

test-site: $(VENV)/browser $(VENV)/docs
	$(CHROMIUM)
	$(PY) -m pytest -m browser tests/test_site_browser.py $(ARGS)

# With the lowest versions that pyproject.toml admits, and with the newest.
test-lowest: build/lowest.txt
	$(MAKE) test VENV=build/lowest CONSTRAINTS="--constraint build/lowest.txt" ARGS="-W ignore $(ARGS)"

build/lowest.txt: pyproject.toml
	mkdir -p build
	sed -n '/^dependencies/,/^]/p; /^interop\|^export/p' $< | \
	  grep -oE '"[A-Za-z-]+>=[0-9.]+' | tr -d '"' | sed 's/>=/==/' > $@

test-newest:
	$(MAKE) test VENV=build/newest TORCH="torch<3"

# A wheel and a source distribution in build/dist, checked, and the wheel tried in an environment of its own.
package: $(VENV)/package
	rm -rf build/dist build/wheel
	$(PY) -m build --outdir build/dist
	$(PY) -m twine check --strict build/dist/*
	$(PYTHON) -m venv build/wheel
	build/wheel/bin/python -m pip install --quiet --disable-pip-version-check "$(TORCH)" build/dist/*.whl
	cd build && wheel/bin/damian train frames=2000 hydra.run.dir=wheel/run

bench: $(VENV)/bench
	$(PY) examples/benchmarks/bench.py $(ARGS)

BENCHMARL := build/benchmarl-venv

# How long trainings take to reach a return, beside TorchRL and BenchMARL: fifteen minutes.
bench-training: $(BENCHMARL)/ready
	PYTHONPATH=examples/benchmarl $(BENCHMARL)/bin/python examples/benchmarks/bench_training.py $(ARGS)

# On a machine with a GPU; ARGS="--device cpu --worlds 64" tries it without.
bench-gpu: $(VENV)/bench
	$(PY) examples/benchmarks/bench_gpu.py $(ARGS)

# The same beside JaxMARL, in an environment of its own: it asks for other versions than we do.
JAXMARL := build/jaxmarl-venv
bench-jaxmarl: $(VENV)/bench $(JAXMARL)/ready
	$(PY) examples/benchmarks/bench.py $(ARGS)

$(JAXMARL)/ready:
	$(PYTHON) -m venv $(JAXMARL)
	$(JAXMARL)/bin/python -m pip install --quiet --disable-pip-version-check jaxmarl
	touch $@

# The tests of the service for fleets, a distribution of its own (examples/fleet).
fleet: $(VENV)/fleet
	cd examples/fleet && $(abspath $(PY)) -m pytest $(ARGS)

# 1,000 seeded faults over a fleet of five in virtual time: the tables of its README, in some minutes.
fleet-campaign: $(VENV)/fleet
	cd examples/fleet && PYTHONPATH=. $(abspath $(PY)) -W ignore tests/campaign.py $(ARGS)

bench-quick: $(VENV)/bench
	$(PY) examples/benchmarks/bench.py quick

# Algorithms of BenchMARL, in an environment of its own: it asks for another TorchRL than ours. Fails if one learns nothing.
BENCHMARL_TRAIN = TQDM_DISABLE=1 $(BENCHMARL)/bin/python examples/benchmarl/train.py --folder build/benchmarl
benchmarl: $(BENCHMARL)/ready
	$(BENCHMARL_TRAIN) --algorithm mappo $(ARGS)
	$(BENCHMARL_TRAIN) --algorithm masac $(ARGS)
	$(BENCHMARL_TRAIN) --algorithm qmix $(ARGS)
	$(BENCHMARL_TRAIN) --algorithm mappo --scenario vmas/navigation $(ARGS)

# Delays in a checkout of TorchRL, as docs/upstream.md proposes them, and TorchRL's tests of them.
RL := ../rl
upstream: $(VENV)/test
	$(PY) docs/upstream/to_torchrl.py $(RL)
	cd $(RL) && PYTHONPATH=. $(abspath $(PY)) -m pytest test/transforms/test_delay_transforms.py $(ARGS)

# The film of the README, the figures of the delays, and those of the stored results.
pictures: $(VENV)/base
	rm -rf build/flight
	$(VENV)/bin/damian fly scenario=delaybench/intermittent delay=burst aware=belief seed=2 episode.max_steps=40 \
	  "formats=[gif]" hydra.run.dir=build/flight
	cp build/flight/episode_0.gif docs/images/flight.gif
	$(PY) docs/figures.py
	$(PY) docs/leaderboard_pages.py
	$(VENV)/bin/damian compare experiment=delays report_only=true hydra.run.dir=docs/results/delays > build/delays.md
	$(VENV)/bin/damian compare experiment=delaybench report_only=true hydra.run.dir=docs/results/delaybench "tasks=[crowded]" \
	  "delays=['1-7',lag,paper]" "methods=[undelayed,naive,naive+gru,naive+timeline,backupdate,backupdate+gru,backupdate+gru+hold,timeline,timeline+gru,forecast+filter]" > build/delaybench.md

# The documentation site, in build/site.
docs: $(VENV)/docs
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict

# The libraries of the replay page, in one file that is committed; only a change of their versions or of what is taken needs it.
PAGE := damian/show/page
page-libraries:
	npm install --prefix $(PAGE)/libraries --no-package-lock --no-audit --no-fund --silent
	cd $(PAGE)/libraries && node_modules/.bin/esbuild libraries.js --bundle --minify --format=esm \
	  --legal-comments=none --target=es2022 --outfile=../libraries.min.js
	cp $(PAGE)/libraries/node_modules/uplot/dist/uPlot.min.css $(PAGE)/uplot.css
	(printf 'three.js\n========\n\n'; cat $(PAGE)/libraries/node_modules/three/LICENSE; \
	 printf '\n\nuPlot\n=====\n\n'; cat $(PAGE)/libraries/node_modules/uplot/LICENSE) > $(PAGE)/LICENSES.txt

# Tokens of code, and how many stand in a line.
weight:
	$(PYTHON) tests/weight.py

check: $(VENV)/dev
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/pyright --pythonpath $(PY)

format: $(VENV)/dev
	$(VENV)/bin/ruff format .
	$(VENV)/bin/ruff check --fix .

# An unpinned torch would bring gigabytes of CUDA along.
$(PY):
	$(PYTHON) -m venv $(VENV)

$(VENV)/base: pyproject.toml | $(PY)
	$(PIP) -e . "$(TORCH)"
	touch $@

# All at once: each installation of ours builds it anew.
$(VENV)/test: pyproject.toml | $(PY)
	$(PIP) -e ".[test]" "$(TORCH)"
	touch $(VENV)/base $@

$(VENV)/slow: $(VENV)/test
	$(PIP) -e ".[slow]" "$(TORCH)"
	touch $@

$(VENV)/docs: $(VENV)/base
	$(PIP) -e ".[docs]" "$(TORCH)"
	touch $@

$(VENV)/dev: pyproject.toml | $(PY)
	$(PIP) -e ".[test,dev]" "$(TORCH)"
	touch $(VENV)/base $(VENV)/test $@

$(VENV)/package: $(VENV)/base
	$(PIP) build twine
	touch $@

$(VENV)/browser: $(VENV)/test
	$(PIP) -e ".[browser]" "$(TORCH)"
	touch $@

$(VENV)/fleet: $(VENV)/base examples/fleet/pyproject.toml
	$(PIP) -e . -e "examples/fleet[test]" "$(TORCH)"
	touch $@

$(VENV)/bench: $(VENV)/base
	$(PIP) -e ".[bench]" "$(TORCH)"
	touch $@

$(BENCHMARL)/ready: pyproject.toml examples/benchmarl/requirements.txt
	$(PYTHON) -m venv $(BENCHMARL)
	$(BENCHMARL)/bin/pip install --quiet --disable-pip-version-check "$(TORCH)"
	$(BENCHMARL)/bin/pip install --quiet --disable-pip-version-check -e . "$(TORCH)"
	$(BENCHMARL)/bin/pip install --quiet --disable-pip-version-check --no-deps -r examples/benchmarl/requirements.txt
	touch $@

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache .hypothesis
