"""Several processes (hosts) that train as one: how they meet, and what they tell each other.

Each runs the same program. Host 0 alone reads and writes files and tells the others what it found;
all train. One host may keep the others waiting for minutes (compiling, held-out episodes), and a
collective operation does not wait so long (gloo: half a minute), so waiting goes through JAX's
coordination service, and hosts enter a collective operation together. With one process everything
here does nothing.
"""

import contextlib
import itertools
import json
import socket
import sys
import time
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import NamedSharding, Sharding
from jax.sharding import PartitionSpec as P

T = TypeVar("T")

MEETING_SECONDS = 300
"""How long hosts wait for all to be started."""
LEAVING_SECONDS = 20
"""How long a host that ends waits for the others to end."""
_FOR_LONG = 7 * 24 * 3600 * 1000
"""Milliseconds; a host that dies ends the waiting of the others long before."""

_number = itertools.count()
"""Of messages: all hosts send and await the same ones in the same order."""


class HostError(ValueError):
    """What went wrong on host 0, as the other hosts are told."""


def address(coordinator: str) -> tuple[str, int]:
    """Name and port of HOST:PORT, an IPv6 host in brackets.

    Raises:
      ValueError: when it is not that.
    """
    name, _, port = coordinator.rpartition(":")
    if not name or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise ValueError(f"coordinator is the HOST:PORT of host 0, got {coordinator!r}.")
    return name.strip("[]"), int(port)


def connect(hosts: int, host: int, coordinator: str, seconds: int = MEETING_SECONDS) -> None:
    """Meets the other hosts, so that `jax.devices()` are those of all; before JAX has been used.

    Args:
      hosts: how many there are.
      host: which of them this process is, from 0.
      coordinator: HOST:PORT on which host 0 listens and the others find it.
      seconds: how long to wait.

    Raises:
      OSError: when the port is taken, or host 0 does not answer.
      TimeoutError: when not all hosts come.
    """
    name, port = address(coordinator)
    began = time.monotonic()
    if host == 0:
        _check_free(port)
        print(f"waiting for {hosts - 1} more at {coordinator}.", file=sys.stderr, flush=True)
    else:
        _await_answer(name, port, seconds)
    # Its handler would swallow SIGTERM, and `kill` should end a run.
    jax.config.update("jax_enable_preemption_service", False)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            coordinator,
            hosts,
            host,
            cluster_detection_method="deactivate",
            initialization_timeout=max(1, round(seconds - (time.monotonic() - began))),
            shutdown_timeout_seconds=LEAVING_SECONDS,
        )
    except jax.errors.JaxRuntimeError as error:
        raise TimeoutError(
            f"not all {hosts} hosts came to {coordinator} within {seconds} s; start each with "
            "the same command and its own --host."
        ) from error


def _check_free(port: int) -> None:
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(("", port))
        except OSError as error:
            raise OSError(
                f"host 0 cannot listen on port {port} ({error.strerror}); choose another port for "
                "--coordinator."
            ) from None


def _await_answer(name: str, port: int, seconds: float) -> None:
    """Until host 0 listens: JAX itself would end the program without a sentence."""
    end = time.monotonic() + seconds
    while True:
        try:
            with socket.create_connection((name, port), timeout=max(1.0, end - time.monotonic())):
                return
        except OSError as error:
            if time.monotonic() >= end or isinstance(error, socket.gaierror):
                raise OSError(
                    f"host 0 does not answer at {name}:{port} ({error.strerror or error}); start "
                    "it, or mend --coordinator."
                ) from None
        time.sleep(0.2)


def several() -> bool:
    """Whether this process is one of several."""
    return jax.distributed.is_initialized()


def is_first() -> bool:
    """Whether this process is the one that reads and writes files."""
    return not several() or jax.process_index() == 0


# --- What hosts tell each other ----------------------------------------------------------------


def everyone_says(value: T) -> list[T]:
    """What each host gave, in their order; it goes through JSON."""
    if not several():
        return [value]
    number = next(_number)
    _set(f"{number}/{jax.process_index()}", {"value": value})
    return [_heard(f"{number}/{host}") for host in range(jax.process_count())]


def first_does(work: Callable[[], T]) -> T:
    """`work()` on host 0 alone; every host gets the result, which is JSON, or the error.

    Raises:
      HostError: on the other hosts, when `work` raised, or when host 0 has ended (`leading`).
    """
    if not several():
        return work()
    number = next(_number)
    if not is_first():
        return _heard(str(number))
    try:
        value = work()
    except BaseException as error:
        _set(str(number), _told(error))
        raise
    _set(str(number), {"value": value})
    return value


@contextlib.contextmanager
def leading() -> Iterator[None]:
    """Around what host 0 does: an error ends the other hosts too, with the same sentence."""
    try:
        yield
    except BaseException as error:
        if several() and is_first():
            _set(str(next(_number)), _told(error))
        raise


def meet() -> None:
    """Returns on all hosts at once; to be called before a collective operation.

    Raises:
      HostError: as for `first_does`.
    """
    if not several():
        return
    first_does(lambda: None)
    _service().wait_at_barrier(f"sumajax/{next(_number)}", _FOR_LONG)


def _told(error: BaseException) -> dict[str, Any]:
    return {"error": str(error), "interrupt": isinstance(error, KeyboardInterrupt)}


def _set(key: str, message: dict[str, Any]) -> None:
    _service().key_value_set(f"sumajax/{key}", json.dumps(message))


def _heard(key: str) -> Any:
    message = json.loads(_service().blocking_key_value_get(f"sumajax/{key}", _FOR_LONG))
    if message.get("interrupt"):
        raise KeyboardInterrupt
    if "error" in message:
        raise HostError(f"host 0: {message['error']}")
    return message["value"]


def _service() -> Any:
    """The coordination service has no public face; used here alone."""
    from jax._src import distributed

    return distributed.global_state.client


# --- Arrays ------------------------------------------------------------------------------------


def first_makes(work: Callable[[], tuple[T, Any]], like: Callable[[], Any]) -> tuple[T, Any]:
    """`work()` on host 0 alone, which gives JSON and a tree of arrays; every host gets both.

    Args:
      like: the tree's structure, shapes and dtypes, in arrays or `jax.ShapeDtypeStruct`.

    Raises:
      HostError: as for `first_does`.
    """
    if not several():
        return work()
    made: list[Any] = []

    def work_on_first() -> T:
        value, tree = work()
        made.append(tree)
        return value

    value = first_does(work_on_first)
    kinds = jax.eval_shape(_raw, like())
    sizes = [x.size * x.dtype.itemsize for x in jax.tree.leaves(kinds)]
    if made:
        leaves = jax.tree.leaves(jax.device_get(_raw(made[0])))
        content = np.frombuffer(b"".join(np.asarray(x).tobytes() for x in leaves), np.uint8)
    else:
        content = np.zeros(sum(sizes), np.uint8)
    meet()
    content = np.asarray(multihost_utils.broadcast_one_to_all(content), np.uint8)
    parts = np.split(content, np.cumsum(sizes)[:-1])
    shaped = [
        np.frombuffer(part.tobytes(), kind.dtype).reshape(kind.shape)
        for part, kind in zip(parts, jax.tree.leaves(kinds), strict=True)
    ]
    return value, _typed(jax.tree.unflatten(jax.tree.structure(kinds), shaped), like())


def gathered(tree: Any) -> Any:
    """`tree`, whose arrays are spread over the devices of all hosts, whole on each host.

    With one process the same arrays.
    """
    if not several():
        return tree
    meet()
    whole = _gather(jax.tree.leaves(tree)[0].sharding.mesh)(tree)
    return _typed(jax.tree.map(lambda x: np.asarray(x.addressable_data(0)), whole), tree)


def placed(tree: Any, sharding: Sharding) -> Any:
    """`tree`, the same on every host, spread over the devices of `sharding`."""
    if sharding.is_fully_addressable:
        return jax.device_put(tree, sharding)
    return jax.tree.map(
        lambda x: jax.make_array_from_callback(x.shape, sharding, lambda index: x[index]), tree
    )


@lru_cache
def _gather(mesh: Any) -> Callable[[Any], Any]:
    """One program for a whole tree, where `process_allgather` compiles one for every leaf."""
    return jax.jit(_raw, out_shardings=NamedSharding(mesh, P()))


def _is_key(x: Any) -> bool:
    return jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key)


def _raw(tree: Any) -> Any:
    """Keys as numbers."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)


def _typed(raw: Any, like: Any) -> Any:
    """Numbers as keys again where `like` has keys."""

    def typed(x: Any, kind: Any) -> Any:
        return jax.random.wrap_key_data(x, impl=_implementation(kind)) if _is_key(kind) else x

    return jax.tree.map(typed, raw, like)


def _implementation(kind: Any) -> str:
    """Of keys or their abstract value, which `jax.random.key_impl` does not take."""
    return kind.dtype._impl.name
