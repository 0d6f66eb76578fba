"""Compiling is most of what the tests do: compile little, and nothing twice."""

import mmap
import os
from importlib.util import find_spec
from pathlib import Path

import pytest

LEAST_EFFORT = (
    "xla_backend_optimization_level=0",
    "xla_cpu_use_fusion_emitters=false",
    "xla_cpu_parallel_codegen_split_count=1",
)
"""What is checked here is what programs compute, not how fast: with the first two flags HetNet's
update is compiled in a quarter of the time that the first alone takes. The third saves a sixth: a
program is not cut into parts for cores that other workers have."""


def known(flag: str) -> bool:
    """Whether this jaxlib has a flag: XLA ends the process at one that it does not know.

    A flag's name is a string of its own in the library, ended by a zero on either side; names that
    were flags once stay in descriptions of messages (the second one, with JAX 0.12).
    """
    name = b"\0" + flag.split("=")[0].encode() + b"\0"
    for library in Path(find_spec("jaxlib").origin).parent.glob("*jax_common*"):
        with open(library, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as m:
            if m.find(name) >= 0:
                return True
    return False


flags = [f"--{flag}" for flag in LEAST_EFFORT if known(flag)]
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *flags]).strip()


def pytest_configure(config):
    """Compiled programs are shared by the tests of a run, its worker processes and later runs."""
    import jax  # after its flags

    jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("jax")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


MOST_PIECES = 20_000
"""Of memory, that a worker may have mapped at the end of a file: Linux allows a process 65,530, and
every compiled program has several. 46,201 were counted in one worker after four fifths of the
tests; with JAX 0.12, whose programs have more, workers died while a program was written down."""


@pytest.fixture(autouse=True, scope="module")
def room_for_programs():
    """What earlier files compiled is forgotten in time."""
    yield
    from sumajax.learning import parallel  # after JAX's flags

    parallel.make_room(MOST_PIECES)
