"""What one turn of each loop of a compiled program starts, read off the optimised program.

On an accelerator every operation that is left after fusion is a launch of some microseconds, so for
small products their number, not the arithmetic, is the time of a step.
"""

import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

FREE = {"parameter", "get-tuple-element", "tuple", "bitcast", "constant", "after-all"}
"""Instructions that do nothing when the program runs."""
PRODUCT = re.compile(r" dot\(|__cublas|gemm_fusion|__triton_(?:nested_)?gemm|__onednn\$matmul")
"""A matrix product: XLA's own operation, a library's, or a fusion around one."""

_HEADER = re.compile(r"(?:ENTRY )?%?([\w.\-]+) .*\{$")
_INSTRUCTION = re.compile(r"\s+(?:ROOT )?%?[\w.\-]+ = (?:\(.*?\)|\S+) ([\w\-]+)\(")
_CALLED = re.compile(r"(?:to_apply|calls)=%?([\w.\-]+)")
_BODY = re.compile(r"body=%?([\w.\-]+)")
_TURNS = re.compile(r'"known_trip_count":\{"n":"(\d+)"')


@dataclass(frozen=True)
class Loop:
    """A loop of a program.

    Attributes:
      turns: how many, or None where that is not known before: the host then looks after each turn.
      operations: that one turn starts, without those of the loops inside.
      products: of them, matrix products.
      inner: the loops inside.
    """

    turns: int | None
    operations: int
    products: int
    inner: tuple["Loop", ...]

    @property
    def launches(self) -> int:
        """Operations of one turn with all turns of the loops inside (unknown ones counted once)."""
        return self.operations + sum((loop.turns or 1) * loop.launches for loop in self.inner)

    def all_loops(self) -> Iterator["Loop"]:
        """This loop and every one inside."""
        yield self
        for loop in self.inner:
            yield from loop.all_loops()


def loops_of(program: str) -> Loop:
    """The whole optimised program (`compiled.as_text()`) as a loop of one turn."""
    lines: dict[str, list[str]] = defaultdict(list)
    computation = entry = ""
    for line in program.splitlines():
        if header := _HEADER.match(line):
            computation = header[1]
            entry = computation if line.startswith("ENTRY") else entry
        elif _INSTRUCTION.match(line):
            lines[computation].append(line)
    return _loop(lines, entry, 1)


def _loop(lines: dict[str, list[str]], computation: str, turns: int | None) -> Loop:
    operations = products = 0
    inner: list[Loop] = []
    for line in lines[computation]:
        name = _INSTRUCTION.match(line)[1]  # type: ignore[index]
        called = _CALLED.search(line)
        if name == "while":
            count = _TURNS.search(line)
            body = _BODY.search(line)[1]  # type: ignore[index]
            inner.append(_loop(lines, body, int(count[1]) if count else None))
        elif name == "call" and called:
            part = _loop(lines, called[1], 1)
            operations, products = operations + part.operations, products + part.products
            inner += part.inner
        elif name not in FREE and not name.endswith("-done"):
            operations += 1
            fused = "".join(lines[called[1]]) if called and name == "fusion" else ""
            products += bool(PRODUCT.search(line) or PRODUCT.search(fused))
    return Loop(turns, operations, products, tuple(inner))
