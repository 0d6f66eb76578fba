"""The matrix products of a program: counted in its jaxpr, and timed alone on this machine.

A policy's step is little else than products of activations with weights. Their number of
multiply-adds says how fast the step could be; timing them alone, at the very shapes the policy
has, says how fast this machine can do them.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from sumajax.environments.types import Environment, agents_leave
from sumajax.policies import Policy

if TYPE_CHECKING:  # of an interface that may move
    from jax.extend.core import Jaxpr, JaxprEqn

TRAINING = 3
"""Products of training for each of the forward pass: itself, and one for each of its operands."""


@dataclass(frozen=True)
class Product:
    """`batch` products of an (m, k) with a (k, n) matrix."""

    batch: int
    m: int
    k: int
    n: int

    @property
    def multiply_adds(self) -> int:
        return self.batch * self.m * self.k * self.n


def products(function: Callable[..., Any], *arguments: Any) -> Counter[Product]:
    """Every matrix product of `function` and how often it is done, loops counted by length."""
    return Counter(dict(_gather(jax.make_jaxpr(function)(*arguments).jaxpr)))


def multiply_adds(counted: Counter[Product]) -> int:
    return sum(product.multiply_adds * times for product, times in counted.items())


def step_products(env: Environment, policy: Policy, num_envs: int) -> Counter[Product]:
    """The products of one policy step in `num_envs` environments, all prepared that can be."""
    key = jax.random.key(0)
    params = jax.eval_shape(lambda: policy.prepare(policy.init(key)))
    carry = jax.eval_shape(lambda: policy.initial_carry((num_envs,)))
    team = policy.team
    states = jax.ShapeDtypeStruct((env.num_agents, *team.state_shape), jnp.float32)
    features = jax.eval_shape(policy.encode_states, params, states)
    mine = jax.ShapeDtypeStruct((num_envs, env.num_agents, features.shape[-1]), jnp.float32)
    view = jax.ShapeDtypeStruct((num_envs, env.num_agents, *team.view_shape), jnp.float32)
    noise = jax.eval_shape(lambda: policy.sample_noise(key, (num_envs,)))
    alive = (
        jax.ShapeDtypeStruct((num_envs, env.num_agents), jnp.bool_) if agents_leave(env) else None
    )
    return products(policy.step, params, carry, mine, view, noise, alive)


def _gather(jaxpr: "Jaxpr", times: int = 1) -> Iterator[tuple[Product, int]]:
    found: Counter[Product] = Counter()
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            found[_product(equation)] += times
        inner = times * (equation.params["length"] if equation.primitive.name == "scan" else 1)
        for value in equation.params.values():
            for nested in _jaxprs(value):
                found.update(dict(_gather(nested, inner)))
    yield from found.items()


def _jaxprs(value: Any) -> "Iterator[Jaxpr]":
    """The programs inside an equation's parameter: bodies of loops, of calls, of branches."""
    for part in value if isinstance(value, tuple | list) else (value,):
        if hasattr(part, "eqns"):
            yield part
        elif hasattr(part, "jaxpr"):
            yield part.jaxpr


def _product(equation: "JaxprEqn") -> Product:
    (contract_left, contract_right), (batch_left, batch_right) = equation.params[
        "dimension_numbers"
    ]
    left, right = (variable.aval.shape for variable in equation.invars)  # type: ignore[attr-defined]
    return Product(
        batch=math.prod(left[i] for i in batch_left),
        m=math.prod(n for i, n in enumerate(left) if i not in (*contract_left, *batch_left)),
        k=math.prod(left[i] for i in contract_left),
        n=math.prod(n for i, n in enumerate(right) if i not in (*contract_right, *batch_right)),
    )


@dataclass(frozen=True)
class Rate:
    """Floating-point operations per second over all devices: of the repeats."""

    median: float
    least: float
    most: float


SETS = 4
"""Sets of operands that a timed call goes through, so that none waits in the nearest cache."""


def product_rate(
    counted: Counter[Product], mesh: Mesh, repeats: int = 5, seconds: float = 0.5
) -> Rate:
    """How fast this machine does nothing but these products and the two of their derivatives.

    Each device does them all on operands of its own, at the same time as the others. Products of
    single rows or columns are left out: they are bound by memory, not by multiplication.
    """
    shapes = [p for p, times in counted.items() for _ in range(times) if min(p.m, p.k, p.n) > 1]
    flops = SETS * TRAINING * 2 * sum(p.multiply_adds for p in shapes) * mesh.size
    operands = [_operands(p, SETS) for p in shapes]

    def all_products(operands: Any) -> Any:
        return [
            [
                (x[i] @ w[i], y[i] @ jnp.swapaxes(w[i], -1, -2), jnp.swapaxes(x[i], -1, -2) @ y[i])
                for i in range(SETS)
            ]
            for x, w, y in operands
        ]

    everywhere = jax.jit(
        jax.shard_map(
            lambda operands: jax.tree.map(lambda a: a[None], all_products(operands)),
            mesh=mesh,
            in_specs=P(),
            out_specs=P(mesh.axis_names),
            check_vma=False,
        )
    )
    jax.block_until_ready(everywhere(operands))
    rates = []
    for _ in range(repeats):
        began, calls = time.perf_counter(), 0
        while time.perf_counter() - began < seconds:
            jax.block_until_ready(everywhere(operands))
            calls += 1
        rates.append(calls * flops / (time.perf_counter() - began))
    return Rate(median(rates), min(rates), max(rates))


def _operands(product: Product, sets: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """x (sets, [batch,] m, k), w (k, n) and y (m, n), normal random numbers."""
    keys = jax.random.split(jax.random.key(0), 3)
    lead = (sets,) if product.batch == 1 else (sets, product.batch)
    m, k, n = product.m, product.k, product.n
    x, w, y = (
        jax.random.normal(key, (*lead, *shape))
        for key, shape in zip(keys, ((m, k), (k, n), (m, n)), strict=True)
    )
    return x, w, y
