"""A state as leaves by name: what each is, its values on the host, and what differs."""

import hashlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sumajax.checkpoint.format import DTYPES, KEYS, PART, Leaf
from sumajax.description import CheckpointError, reason


def named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves by name, as `params/params/core/action/kernel`, in the tree's order."""
    named = {}
    try:
        leaves = jax.tree_util.tree_leaves_with_path(tree)
    except ValueError as error:
        raise CheckpointError(f"the state is no tree of named leaves: {reason(error)}.") from error
    for path, leaf in leaves:
        parts = [jax.tree_util.keystr((entry,), simple=True) for entry in path]
        name = "/".join(parts)
        if not parts or not all(map(PART.fullmatch, parts)) or name in named:
            raise CheckpointError(
                f"a checkpoint cannot name the leaf {name!r}; use unique names of letters, "
                "digits, _ and - for the parts of the state."
            )
        named[name] = leaf
    return named


def leaf_kind(name: str, leaf: Any) -> Leaf:
    """Of an array, an abstract one or a Python scalar."""
    leaf = leaf if hasattr(leaf, "dtype") and hasattr(leaf, "shape") else jnp.asarray(leaf)
    kind = Leaf(tuple(leaf.shape), str(leaf.dtype))
    if kind.dtype not in DTYPES and kind.dtype not in KEYS:
        raise CheckpointError(
            f"leaf {name} has dtype {kind.dtype}, which a checkpoint cannot hold; keep numbers, "
            "booleans and PRNG keys in the state."
        )
    return kind


def host_arrays(state: Any) -> tuple[dict[str, Leaf], dict[str, np.ndarray]]:
    """What each leaf is, and its values as they are stored."""
    leaves, arrays = {}, {}
    for name, leaf in named_leaves(state).items():
        try:
            leaf = leaf if hasattr(leaf, "dtype") else jnp.asarray(leaf)
            leaves[name] = leaf_kind(name, leaf)
            arrays[name] = np.asarray(
                jax.random.key_data(leaf) if leaves[name].dtype in KEYS else leaf
            )
        except (TypeError, OverflowError, RuntimeError) as error:
            raise CheckpointError(
                f"leaf {name} is no array a checkpoint can hold: {reason(error)}."
            ) from error
    if not leaves:
        raise CheckpointError("the state to save holds no arrays; pass the learner's TrainState.")
    return leaves, arrays


def nested(named: dict[str, Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name, leaf in named.items():
        *above, last = name.split("/")
        node = tree
        for part in above:
            node = node.setdefault(part, {})
        node[last] = leaf
    return tree


def array_digest(array: np.ndarray) -> str:
    return hashlib.sha256(array.tobytes()).hexdigest()


def compare(path: Path, saved: dict[str, Leaf], wanted: dict[str, Leaf]) -> None:
    """Refuses the first leaf that differs."""
    mend = "use the policy, settings and seeds it was saved with, or train anew"
    for name in wanted:
        if name not in saved:
            raise CheckpointError(
                f"{path} has no leaf {name}, which is {wanted[name]} in this program; {mend}."
            )
    for name, leaf in saved.items():
        if name not in wanted:
            raise CheckpointError(
                f"{path} has a leaf {name}, {leaf}, which this program does not; {mend}."
            )
        if leaf != wanted[name]:
            raise CheckpointError(
                f"leaf {name} is {leaf} in {path} but {wanted[name]} in this program; {mend}."
            )
