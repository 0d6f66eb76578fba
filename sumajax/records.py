"""Records that cross the border of a compiled program, and can be written with it."""

import contextlib
from typing import Any, TypeVar, cast

import jax.export

Record = TypeVar("Record", bound=type)


def exportable(cls: Record) -> Record:
    """A class decorator, above `flax.struct.dataclass`: lets `jax.export` save programs with it.

    An exported program names the records that it takes and gives; JAX refuses to write the names
    of those that it was not told of. Only for records of arrays, without static fields.
    """

    def made(_: Any, children: Any) -> Any:
        return cls(*children)

    # A module that is loaded again finds its names taken, by the records that it had before.
    with contextlib.suppress(ValueError):
        jax.export.register_pytree_node_serialization(
            cls,
            serialized_name=f"{cls.__module__}.{cls.__qualname__}",
            serialize_auxdata=lambda _: b"",
            deserialize_auxdata=lambda _: (),
            from_children=cast(Any, made),
        )
    return cls
