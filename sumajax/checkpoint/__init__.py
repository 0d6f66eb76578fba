"""Checkpoints: the state of a run on disk, written and read by Orbax in this one place.

A checkpoint directory holds the last few checkpoints of one training run, each a directory of its
own that is complete or absent, never half there:

    <directory>/000004-step-120/         serial number of the save, step (epoch) of the run
        checkpoint.json                  what it is: format, version, meta, leaves, files, checksum
        state/                           the arrays, as Orbax wrote them

`checkpoint.json` gives the shape, dtype and SHA-256 of every leaf and the size and SHA-256 of every
file, and is itself under a checksum, so whatever was truncated, altered or lost is found before
anything is trained on. Reading executes nothing from the directory, unpickles nothing, and is
bounded. One program at a time may write to a directory; any number may read.
"""

from sumajax.checkpoint.format import DESCRIPTION, MAX_DESCRIPTION_BYTES, MAX_STATE_BYTES
from sumajax.checkpoint.reading import identity, latest, load, load_params, read_meta
from sumajax.checkpoint.writing import check_directory, save
from sumajax.description import CheckpointError, check_compatible, describe, rebuild

__all__ = [
    "DESCRIPTION",
    "MAX_DESCRIPTION_BYTES",
    "MAX_STATE_BYTES",
    "CheckpointError",
    "check_compatible",
    "check_directory",
    "describe",
    "identity",
    "latest",
    "load",
    "load_params",
    "read_meta",
    "rebuild",
    "save",
]
