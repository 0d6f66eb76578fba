"""Communication policies; they know nothing of learning.

A policy of your own needs no entry here: `Policy("mine", MyModule(TeamSpec.of(env)))` is one.
"""

from dataclasses import fields
from typing import Any, Literal, get_args, get_origin

from sumajax.environments.types import Environment
from sumajax.plain import plain
from sumajax.policies import hetnet, ic3net, magic, tarmac
from sumajax.policies.types import Decision, Policy, PolicyModule, PolicyOutput, TeamSpec

__all__ = [
    "POLICIES",
    "Decision",
    "Policy",
    "PolicyModule",
    "PolicyOutput",
    "TeamSpec",
    "make_policy",
]

POLICIES: dict[str, tuple[type[PolicyModule], dict[str, Any]]] = {
    **ic3net.VARIANTS,
    **magic.VARIANTS,
    **tarmac.VARIANTS,
    **hetnet.VARIANTS,
}
"""Every named policy: its module and the settings that make it this variant."""


def make_policy(name: str, env: Environment, **settings: Any) -> Policy:
    """The policy called `name`, shaped for `env`.

    Args:
      settings: fields of the policy's module, as `hidden=128` or `encoder="flat"`.

    Raises:
      ValueError: for an unknown name or setting, with what there is.
    """
    if name not in POLICIES:
        raise ValueError(f"policy {name!r} is unknown; choose one of {', '.join(POLICIES)}.")
    module, variant = POLICIES[name]
    known = {f.name for f in fields(module) if f.init} - {"team", "parent", "name"} - set(variant)
    unknown = sorted(set(settings) - known)
    if unknown:
        raise ValueError(
            f"policy {name!r} has no setting {unknown[0]!r}; it has {', '.join(sorted(known))}."
        )
    settings = plain(settings)
    for setting, value in settings.items():
        if isinstance(value, int) and value < 1 and not isinstance(value, bool):
            raise ValueError(f"policy setting {setting} must be at least 1, got {value}.")
        choices = module.__dataclass_fields__[setting].type
        if get_origin(choices) is Literal and value not in get_args(choices):
            raise ValueError(
                f"{setting} {value!r} is unknown; choose one of {', '.join(get_args(choices))}."
            )
    return Policy(name, module(team=TeamSpec.of(env), **variant, **settings))
