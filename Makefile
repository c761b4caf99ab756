# Every target runs in the project's environment: .ci/in-env builds it on first use.
ENV := .ci/in-env

define HELP
make run CASE=cases/dimple_buckling.yaml [OUT=dir] [N=ranks] [ARGS="--set a=b"]
make check CASE=...   validate a case, print what would be built
make figures          the paper's figures into results/figures/: 45 minutes on one core, N=ranks share it
make extremes         shells far from the ordinary ones into docs/extremes/: 5 minutes
make bench            error, time and memory of a fixed set into a JSON; ARGS="--compare OLD.json" for ratios
make test             lint and all tests
make fast             lint and the tests that are not marked slow
make lint             ruff and mypy
make image            the Docker image magshell_fenicsx
make clean            remove caches and compiled kernels; keeps .env/root and results
endef
export HELP

.PHONY: help run check figures extremes bench test fast lint image clean

help:
	@echo "$$HELP"

run check:
	@$(if $(CASE),,$(error name a case: make $@ CASE=cases/dimple_buckling.yaml))
	$(ENV) $(if $(N),mpirun -n $(N)) magshell $@ $(CASE) $(if $(OUT),--out $(OUT)) $(ARGS)

figures:
	$(ENV) $(if $(N),mpirun -n $(N)) python3 -m magshell_fenicsx.figures $(ARGS)

extremes:
	$(ENV) $(if $(N),mpirun -n $(N)) python3 -m magshell_fenicsx.extremes $(ARGS)

bench:
	$(ENV) python3 -m magshell_fenicsx.bench $(ARGS)

test: lint
	$(ENV) python3 -m pytest

fast: lint
	$(ENV) python3 -m pytest -m 'not slow'

lint:
	$(ENV) ruff check --exclude .env .
	$(ENV) ruff format --check --exclude .env .
	$(ENV) mypy magshell_fenicsx

image:
	docker build -t magshell_fenicsx .

clean:
	rm -rf .env/cache .env/tools .mypy_cache .ruff_cache .pytest_cache .hypothesis build *.egg-info
	find . -path ./.env -prune -o -name __pycache__ -exec rm -rf {} +
