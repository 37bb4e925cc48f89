# Two commands do everything, set-up included: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= runs

# With bytecode, whatever the environment says: else each of the many processes that tests start compiles all modules.
TESTS := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

.PHONY: demo test test-slow check format docs docs-check dist bench bench-serving gpu-parity gpu-bench clean

$(VENV)/.installed: pyproject.toml setup.py constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(f"nurec_sim needs Python 3.11 or newer; $(PYTHON) is {sys.version.split()[0]}. Try: make PYTHON=python3.11" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: $(VENV)/.installed ## log -> Gaussian scene -> gRPC server -> closed loop -> report
	$(BIN)/nurec-sim demo --out $(OUT)

test: $(VENV)/.installed ## every rule once, some five minutes on two cores
	$(TESTS) -m "not slow"

test-slow: $(VENV)/.installed ## tests that take many seconds, and repetitions of quick ones
	$(TESTS) -m slow

check: $(VENV)/.installed ## format, lint, import arrows, types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/mypy

format: $(VENV)/.installed ## rewrite the code in house style
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: $(VENV)/.installed-docs ## these pages and an API reference as a site with search, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "build/site: python3 -m http.server --directory build/site"

docs-check: $(VENV)/.installed-docs ## run the notebooks, and the commands in the tutorial
	$(BIN)/python docs/check.py

$(VENV)/.installed-docs: $(VENV)/.installed
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[docs]'
	@touch $@

dist: $(VENV)/.installed ## the wheel and the source distribution, in dist
	rm -rf build/lib build/bdist.* nurec_sim.egg-info
	$(BIN)/python -m build --no-isolation --outdir dist
	rm -rf build/lib build/bdist.* nurec_sim.egg-info

bench: $(VENV)/.installed ## timings of the renderer and the network, written to build/bench.json and build/bench_network.json
	$(BIN)/python benchmarks/render.py
	$(BIN)/python benchmarks/gpu_host.py
	$(BIN)/python benchmarks/network.py

bench-serving: $(VENV)/.installed ## 32 clients for 60 s against one, written to build/bench_serving.json
	$(BIN)/python benchmarks/serving.py

gpu-parity: $(VENV)/.installed ## the CUDA kernels against the reference, on this machine's GPU
	$(BIN)/python -m nurec_sim.render.gpu
	$(BIN)/python -m pytest -m needs_gpu tests/render/test_render_gpu.py tests/render/test_render_gpu_gradients.py \
		tests/render/test_render_gpu_frame.py tests/reconstruct/test_optimize.py

gpu-bench: $(VENV)/.installed ## GPU timings, written to build/bench_gpu.json
	$(BIN)/python benchmarks/gpu.py

clean: ## forget the virtual environment and everything built
	rm -rf $(VENV) build dist *.egg-info
