# `make demo` sets up and runs the main job; `make test` sets up and passes the tests.
.PHONY: demo test setup clean

demo: .venv/.ready-base
	.venv/bin/python -m sceneslam +scenario=bright_to_dark

test: .venv/.ready-dev
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/python -m pytest -n 2

setup: .venv/.ready-dev

.venv/.ready-%: pyproject.toml constraints.txt
	@.ci/setup $*

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
