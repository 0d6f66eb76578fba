"""Checkpoints: the state of a run on disk, its arrays written and read by Orbax.

A checkpoint directory holds the last few checkpoints of one training run, each a directory of its
own that is complete or absent, never half there:

    <directory>/000004-step-120/         serial number of the save, step (epoch) of the run
        checkpoint.json                  what it is: format, version, meta, leaves, files, checksum
        state/                           the arrays, as Orbax wrote them

`checkpoint.json` gives the shape, dtype and SHA-256 of every leaf and the size and SHA-256 of every
file, and is itself under a checksum, so whatever was truncated, altered or lost is found before
anything is trained on. What it does not list was written by others and is ignored; what it lists
may be links to files elsewhere. A save counts only once it has been read back as a loader would.
Reading executes nothing from the directory, unpickles nothing, and is bounded. One program at a
time may write to a directory; any number may read.

Orbax has a `Checkpointer` that names, keeps and removes a sequence of checkpoints. It is not used:
it gives a checkpoint its name within the save, before digests can be added to it or anybody has
read it, and removes the one before it on that ground; it removes in place, so that a kill leaves
half a checkpoint under the name of a whole one; after going back to an earlier good checkpoint it
silently saves nothing until the step of the damaged one is passed; and it does not put values onto
the disk itself (fsync). tests/checkpoint/test_orbax_checkpointer.py shows the first three.

`format` says what is on disk, `leaves` how a state has names, `files` what is verified, `directory`
which checkpoints there are, `writing` and `reading` do it, `orbax` is all that knows Orbax. `npz`
stands beside them: parameters alone, as one plain file of NumPy's.
"""

from sumajax.checkpoint.directory import remove_unfinished
from sumajax.checkpoint.format import DESCRIPTION, MAX_DESCRIPTION_BYTES, MAX_STATE_BYTES
from sumajax.checkpoint.npz import load_npz, save_npz
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
    "load_npz",
    "load_params",
    "read_meta",
    "rebuild",
    "remove_unfinished",
    "save",
    "save_npz",
]
