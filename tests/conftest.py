"""Compiling is most of what the tests do: compile little, and nothing twice."""

import os

# The compiler's least effort: what is checked here is what programs compute, not how fast.
os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"
).strip()

import jax


def pytest_configure(config):
    """Compiled programs are shared by the tests of a run, its worker processes and later runs."""
    jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("jax")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
