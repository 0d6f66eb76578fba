"""Small spaces with the attributes that gymnax's and JaxMARL's have, where neither is installed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp


@dataclass(frozen=True)
class Discrete:
    """The whole numbers 0..n-1."""

    n: int
    shape: tuple[int, ...] = ()
    dtype: Any = jnp.int32

    def sample(self, key: chex.PRNGKey) -> chex.Array:
        """() int32, every number equally likely."""
        return jax.random.randint(key, self.shape, 0, self.n, self.dtype)

    def contains(self, x: chex.Array) -> chex.Array:
        """() bool."""
        return (x >= 0) & (x < self.n)


@dataclass(frozen=True)
class Box:
    """Arrays of `shape` with every entry between `low` and `high`, both included."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any = jnp.float32

    def sample(self, key: chex.PRNGKey) -> chex.Array:
        """(*shape) uniform in [low, high)."""
        return jax.random.uniform(key, self.shape, self.dtype, self.low, self.high)

    def contains(self, x: chex.Array) -> chex.Array:
        """() bool."""
        return ((x >= self.low) & (x <= self.high)).all()


@dataclass(frozen=True)
class Tuple:
    """A fixed number of values, each in a space of its own; an array along its first axis."""

    spaces: Sequence[Any]

    def sample(self, key: chex.PRNGKey) -> tuple[Any, ...]:
        """A sample of each."""
        keys = jax.random.split(key, len(self.spaces))
        return tuple(space.sample(key) for space, key in zip(self.spaces, keys, strict=True))

    def contains(self, x: Any) -> Any:
        """() bool."""
        inside = [space.contains(x[index]) for index, space in enumerate(self.spaces)]
        return jnp.stack(inside).all()


@dataclass(frozen=True)
class Dict:
    """A record with a space for each of its attributes."""

    spaces: Mapping[str, Any]

    def sample(self, key: chex.PRNGKey) -> dict[str, Any]:
        """A sample of each, by name."""
        keys = jax.random.split(key, len(self.spaces))
        items = zip(self.spaces.items(), keys, strict=True)
        return {name: space.sample(key) for (name, space), key in items}

    def contains(self, x: Any) -> Any:
        """() bool, of the attributes of `x`."""
        inside = [space.contains(getattr(x, name)) for name, space in self.spaces.items()]
        return jnp.stack(inside).all()
