"""What the API pages need to know of this repository's docstrings; loaded by mkdocstrings.

Fields of records have their shape in a comment beside them, and settings that belong together share
a line of their docstring; the reader of docstrings knows neither.
"""

import re
from collections.abc import Iterator
from typing import Any

from griffe import Attribute, Class, Docstring, Extension, Module, Object

COMMENT = re.compile(r"\s#\s(?!type:)(.*)$")


def within(thing: Module | Class) -> Iterator[Object]:
    """Everything that is defined in a module or class, itself included."""
    yield thing
    for member in thing.members.values():
        if isinstance(member, (Module, Class)):
            yield from within(member)
        elif isinstance(member, Object):
            yield member


def describe_by_comment(field: Attribute) -> None:
    """The comment beside a field of a class becomes its docstring."""
    comment = COMMENT.search(field.source.splitlines()[-1]) if field.source else None
    if comment:
        field.docstring = Docstring(comment[1], parent=field)


def join_names(thing: Object) -> None:
    """`a, b: what they are`: read as a name `a,` of the type `b`."""
    for section in thing.docstring.parsed if thing.docstring else ():
        for item in section.value if isinstance(section.value, list) else ():
            name = getattr(item, "name", None)
            if isinstance(name, str) and name.endswith(","):
                item.name, item.annotation = f"{name} {item.annotation}", None


class Fields(Extension):
    """Runs over the whole package once it is read."""

    def on_package(self, *, pkg: Module, **_: Any) -> None:
        for thing in within(pkg):
            if isinstance(thing, Attribute) and thing.parent is not None:
                if thing.docstring is None and thing.parent.is_class:
                    describe_by_comment(thing)
            else:
                join_names(thing)
