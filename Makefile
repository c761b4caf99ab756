# Every target runs in the project's environment: .ci/in-env builds it on first use.
ENV := .ci/in-env
PYTEST := python3 -m pytest -n auto --maxprocesses 4 --dist worksteal  # a worker grows to some 3 GB
# OPENBLAS_CORETYPE, on the command line or in the environment, must reach OpenBLAS in there
CORE_TYPE = $(if $(OPENBLAS_CORETYPE),$(ENV) .ci/core-type $(OPENBLAS_CORETYPE))

LIMITED = $(if $(LIMIT),timeout --signal=INT --kill-after=30 $(LIMIT))
MARK ?= not slow
TESTS ?= tests

CAMPAIGN := sh -c 'PYTHONPATH=cases:$$PYTHONPATH exec python3 -m "$$@"' campaign

define HELP
make run CASE=cases/dimple_buckling.yaml [OUT=dir] [N=ranks] [ARGS="--set a=b"]
make check CASE=...   validate a case, print what would be built
make figures          the paper's figures into results/figures/: 45 minutes on one core, N=ranks share it
make benchmarks       the nonlinear obstacle course into docs/benchmarks/: three quarters of an hour on one core
make extremes         shells far from the ordinary ones into docs/extremes/: 5 minutes
make noise            every case under relative noise into docs/noise/: an hour on one core (ARGS="--seeds 3")
make bench            error, time and memory of a fixed set into results/bench.json (OUT=file), and the ratios
                      to docs/bench/bench.json: 10 minutes on an idle machine
make effectivity      estimated errors over true ones, as a table: half an hour
make studies          error against run time of two cases into docs/study/: 10 minutes
make test             lint and the tests that are not marked slow: 10 minutes on two cores
                      (TESTS="tests/simulate ...": of these folders; MARK=slow, MARK=telling: those so marked;
                      LIMIT=seconds; OPENBLAS_CORETYPE=Haswell, Nehalem, ... rounds as on another processor;
                      ROOT=sid: on Debian unstable, ROOT=pypi: with the packages of PyPI, both without lint)
make test-all         lint and all tests
make lint             ruff, import-linter and mypy
make gallery          every case with picture, command, result and time into docs/gallery/: 25 minutes on one core
make site             the documentation as a site in results/site (Sphinx, from PyPI)
make image            the Docker image magshell_fenicsx
make clean            remove caches and compiled kernels; keeps .env/root*, .env/pypi* and results
endef
export HELP

.PHONY: help run check figures benchmarks extremes noise bench effectivity studies gallery site test test-all lint image clean

help:
	@echo "$$HELP"

run check:
	@$(if $(CASE),,$(error name a case: make $@ CASE=cases/dimple_buckling.yaml))
	$(ENV) $(if $(N),mpirun -n $(N)) magshell $@ $(CASE) $(if $(OUT),--out $(OUT)) $(ARGS)

figures:
	$(ENV) $(if $(N),mpirun -n $(N)) $(CAMPAIGN) figures.figures $(ARGS)

benchmarks:
	$(ENV) $(CAMPAIGN) benchmarks.obstacles $(ARGS)

extremes:
	$(ENV) $(if $(N),mpirun -n $(N)) $(CAMPAIGN) extreme.extremes $(ARGS)

noise:
	@mkdir -p docs/noise
	$(ENV) $(CAMPAIGN) noise.table $(ARGS) > results/noise.md && mv results/noise.md docs/noise/README.md

effectivity:
	$(ENV) $(CAMPAIGN) effectivity $(ARGS)

bench:
	$(ENV) $(CAMPAIGN) speed $(if $(OUT),--out $(OUT)) --compare docs/bench/bench.json $(ARGS)

# $(call study,NAME,CASE and options): study.* of results/study_NAME to docs/study/NAME.*
define study
$(ENV) magshell study $(2) --repeat 1 --out results/study_$(1)
for kind in csv png; do cp results/study_$(1)/study.$$kind docs/study/$(1).$$kind; done
sed 's/study\.png/$(1).png/' results/study_$(1)/study.md > docs/study/$(1).md
endef

MESHES := --over mesh.degree=3,4,5 --over mesh.refinement=0.5,0.7,1,1.4

studies:
	$(call study,indentation,cases/indentation.yaml --result force@w_over_h=10 \
		--set loading.depth=10 --set loading.points=10 $(MESHES))
	$(call study,buckling,cases/dimple_buckling.yaml --result knockdown --reference 0.552053778 \
		--set symmetry=half --set magnetic.lambda_m=0.00184 $(MESHES))

gallery:
	$(ENV) $(CAMPAIGN) gallery $(ARGS)

site:
	$(ENV) docs/site/build

test: $(if $(ROOT),,lint)
	$(CORE_TYPE)
	$(ENV) $(LIMITED) $(PYTEST) -m '$(MARK)' $(if $(filter sid,$(ROOT)),tests/versions) $(TESTS)

test-all: lint
	$(ENV) $(LIMITED) $(PYTEST) $(TESTS)

lint:
	$(ENV) ruff check --exclude .env .
	$(ENV) ruff format --check --exclude .env .
	$(ENV) mypy magshell_fenicsx
	$(ENV) lint-imports --no-logo --no-cache

image:
	docker build -t magshell_fenicsx .

clean:
	rm -rf .env/cache* .env/tools .mypy_cache .ruff_cache .pytest_cache .hypothesis build *.egg-info
	find . -path ./.env -prune -o -name __pycache__ -exec rm -rf {} +
