"""What was built is what should be given away: contents, size and metadata of wheel and sdist.

python ci/check_wheel.py dist
"""

import sys
import tarfile
import zipfile
from email import message_from_string
from pathlib import Path

MOST_BYTES = 6 * 2**20
"""Of a wheel: the package's code, and `MOST_TRAINED` of trained policies at most."""
MOST_TRAINED = 4 * 2**20
STORE = "sumajax/store/policies/"
NEEDED = ("sumajax/py.typed", "sumajax/cli/__init__.py", "sumajax/experiment/plan.py")
NEVER = ("tests/", "experiments/", "__pycache__", ".pyc", "runs/")


def check(folder: Path) -> None:
    """Raises AssertionError with what is wrong."""
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        (place,) = [name for name in names if name.endswith(".dist-info/METADATA")]
        metadata = message_from_string(file.read(place).decode())
        check_store({i.filename: i.file_size for i in file.infolist()})
        (entry,) = [name for name in names if name.endswith("entry_points.txt")]
        assert "sumajax = sumajax.cli:main" in file.read(entry).decode()
    for name in NEEDED:
        assert name in names, f"{wheel.name} lacks {name}"
    for name in names:
        assert not any(part in name for part in NEVER), f"{wheel.name} holds {name}"
    assert wheel.stat().st_size <= MOST_BYTES, f"{wheel.name} has {wheel.stat().st_size} bytes"
    extras = set(metadata.get_all("Provides-Extra") or ())
    assert {"experiments", "export", "cuda"} <= extras, extras
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["License-Expression"] == "MIT"
    with tarfile.open(sdist) as archive:
        held = [name.partition("/")[2] for name in archive.getnames()]
    assert "pyproject.toml" in held
    assert any(name.startswith("tests/") for name in held), "the sdist is tested where it lands"
    print(f"{wheel.name}: {len(names)} files, {wheel.stat().st_size} bytes; {sdist.name} too.")


def check_store(sizes: dict[str, int]) -> None:
    """Trained policies: parameters and card of each, and nothing else."""
    held = {name.removeprefix(STORE): size for name, size in sizes.items() if STORE in name}
    cards = {name.removesuffix(".json") for name in held if name.endswith(".json")}
    assert cards, "no trained policies"
    assert set(held) == {f"{name}.{kind}" for name in cards for kind in ("json", "npz")}, held
    assert sum(held.values()) <= MOST_TRAINED, f"trained policies of {sum(held.values())} bytes"


if __name__ == "__main__":
    check(Path(sys.argv[1]))
