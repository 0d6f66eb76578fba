"""Parameters as one plain NumPy file, for programs that have NumPy and nothing else.

`numpy.load(file)` gives the leaves by name, as `params/core/action/kernel`. It is the same file for
the same numbers, whenever it is written, and reading it unpickles nothing.
"""

import io
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sumajax.checkpoint.format import KEYS, MAX_STATE_BYTES
from sumajax.checkpoint.leaves import compare, host_arrays, leaf_kind, named_leaves, nested
from sumajax.description import CheckpointError, reason
from sumajax.reporting.metrics import write_bytes

_MEMBER = ".npy"
_FIRST_DAY = (1980, 1, 1, 0, 0, 0)
"""Of every member: the earliest date that a zip file has."""


def save_npz(path: str | os.PathLike[str], params: Any) -> Path:
    """Writes a tree of arrays as an `.npz`, a member for each leaf, and returns where.

    Args:
      path: ends in .npz; a file that is there already is replaced, in one rename.
      params: of a policy, or any tree of arrays in dictionaries, lists, tuples and records.

    Raises:
      CheckpointError: for another ending, a leaf of a kind that NumPy has no name for (bfloat16,
        keys), or a place that cannot be written.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise CheckpointError(f"file {path.name} must end in .npz; NumPy knows it by that.")
    leaves, arrays = host_arrays(params)
    for name, leaf in leaves.items():
        if leaf.dtype in KEYS or arrays[name].dtype.kind not in "biufc":
            raise CheckpointError(
                f"leaf {name} is {leaf}, which NumPy has no name for; turn it into numbers that it "
                "has, as float32 (keys with jax.random.key_data)."
            )
    try:
        write_bytes(path, packed(arrays))
    except OSError as error:
        raise CheckpointError(
            f"{path} cannot be written: {reason(error)}; choose a file in a directory that can."
        ) from error
    return path


def packed(arrays: dict[str, np.ndarray]) -> bytes:
    """The bytes of an `.npz`, compressed; they depend on nothing but names and values."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, array, allow_pickle=False)
            about = zipfile.ZipInfo(f"{name}{_MEMBER}", _FIRST_DAY)
            archive.writestr(about, member.getvalue(), zipfile.ZIP_DEFLATED)
    return content.getvalue()


def load_npz(path: str | os.PathLike[str], like: Any = None) -> Any:
    """The tree of arrays that `save_npz` wrote, the very same numbers, as NumPy arrays.

    Args:
      like: a tree of arrays or of `jax.ShapeDtypeStruct` whose structure it takes; names, shapes
        and dtypes are compared. None: nested dictionaries by name.

    Raises:
      CheckpointError: when it is no `.npz` of arrays, is damaged, or differs from `like`; names the
        leaf and both shapes.
    """
    path = Path(path)
    try:
        arrays = unpacked(_read_bounded(path))
    except FileNotFoundError as error:
        raise CheckpointError(f"{path} does not exist; give a file that save_npz wrote.") from error
    # Whatever zipfile, zlib and NumPy make of bytes that are not theirs.
    except Exception as error:
        raise CheckpointError(
            f"{path} is no .npz of parameters, or is damaged ({reason(error)}); give a file that "
            "save_npz wrote."
        ) from error
    if like is None:
        return nested(arrays)
    wanted = named_leaves(like)
    compare(
        path,
        {name: leaf_kind(name, array) for name, array in arrays.items()},
        {name: leaf_kind(name, leaf) for name, leaf in wanted.items()},
    )
    return jax.tree.unflatten(jax.tree.structure(like), [arrays[name] for name in wanted])


def unpacked(content: bytes) -> dict[str, np.ndarray]:
    """Arrays by name; raises whatever comes of bytes that are no `.npz`."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        if sum(member.file_size for member in members) > MAX_STATE_BYTES:
            raise ValueError(f"its arrays would need more than {MAX_STATE_BYTES} bytes")
        arrays = {}
        for member in members:
            if not member.filename.endswith(_MEMBER):
                raise ValueError(f"it holds {member.filename!r}, which is no array")
            data = io.BytesIO(archive.read(member))
            name = member.filename.removesuffix(_MEMBER)
            arrays[name] = np.lib.format.read_array(data, allow_pickle=False)
            if not all(name.split("/")):
                raise ValueError(f"it names an array {name!r}")
    if not arrays:
        raise ValueError("it holds no arrays")
    return arrays


def _read_bounded(path: Path) -> bytes:
    size = path.stat().st_size
    if size > MAX_STATE_BYTES:
        raise ValueError(f"it has {size} bytes, more than the {MAX_STATE_BYTES} that are read")
    return path.read_bytes()
