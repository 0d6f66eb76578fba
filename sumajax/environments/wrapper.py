"""Tasks around tasks: what a wrapper does not change is the task's own."""

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

from sumajax.environments.types import Environment

# To a type checker everything that a wrapper does not define may be the task's.
Base: Any = object


@dataclass(frozen=True)
class Wrapper(Base):
    """A task that is `env` but for what a subclass defines anew.

    Everything else is that of `env`, also what the `Environment` contract does not know: a domain's
    own fields and functions. A subclass is a frozen dataclass as well, so it is a value: compared,
    hashed, pickled, and a static argument of compiled functions. Wrappers nest.
    """

    env: Environment

    def __getattr__(self, name: str) -> Any:
        # Python asks for `__...__` before `env` is set, when it copies or unpickles.
        if name == "env" or name.startswith("__"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.env, name)


for _name in vars(Environment):
    # `isinstance(wrapper, Environment)` looks for these on the class.
    if not _name.startswith("_"):
        setattr(Wrapper, _name, property(attrgetter(f"env.{_name}")))


def unwrapped(env: Any) -> Any:
    """The innermost task: `env` itself, or what all its wrappers are around.

    A wrapper is a task that has a task in its field `env`, of `Wrapper` or not.
    """
    inner = getattr(env, "env", None)
    return unwrapped(inner) if isinstance(inner, Environment) else env


def rewrapped(env: Any, task: Environment) -> Any:
    """`task` in the wrappers of `env`, all their settings kept: the size, fill and scale it is
    seen with.

    Raises:
      ValueError: where a wrapper refuses the task, as a size that its grid does not divide.
    """
    inner = getattr(env, "env", None)
    return replace(env, env=rewrapped(inner, task)) if isinstance(inner, Environment) else task
