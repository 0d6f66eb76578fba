"""Recorded steps of the original policy cores, and our answer to the same inputs.

A recording is one `.npz` file; tests/data/policies/README.md defines its fields and the symbols
S, T, N, K used here. `answer` gives our value of every `out.*` and `grad.*` field, in the same
layout, so that a test only compares two arrays.
Set SUMAJAX_CONFORMANCE_DATA to a directory with folders `policies/` and `traffic_junction/` (of
which the files `policy_alive_*` are meant here) to answer other files.
"""

import os
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sumajax.policies.attention import SELF_LOOPS, GraphAttention
from sumajax.policies.hetnet import HetGraph, HetNetCarry, HetNetCore
from sumajax.policies.ic3net import IC3NetCarry, IC3NetCore
from sumajax.policies.magic import MAGICCarry, MAGICCore
from sumajax.policies.tarmac import TarMACCore

Arrays = dict[str, Any]

FORCED = 1e4
"""Logistic noise that decides a bit whatever the logits are."""


ALIVE = "policy_alive_"
"""Start of the names of the files where agents come and go."""


def directory() -> Path:
    default = Path(__file__).parents[1] / "data"
    return Path(os.environ.get("SUMAJAX_CONFORMANCE_DATA", default)) / "policies"


def recordings() -> list[Path]:
    where_agents_leave = (directory().parent / "traffic_junction").glob(f"{ALIVE}*.npz")
    return [*sorted(directory().glob("*.npz")), *sorted(where_agents_leave)]


@lru_cache(maxsize=64)
def load(path: Path) -> Arrays:
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


def expected(path: Path) -> Arrays:
    """The recorded results: every field of the file that is neither given nor configuration."""
    given = ("cfg.", "in.", "param.")
    return {k: v for k, v in load(path).items() if not case_free(k).startswith(given)}


def case_free(name: str) -> str:
    """ "c3.grad.W" -> "grad.W"."""
    head, _, tail = name.partition(".")
    return tail if head[:1] == "c" and head[1:].isdigit() else name


@cache
def answer(path: Path, dtype: type) -> Arrays:
    """Our value of every recorded result, computed in `dtype` by one program for the file."""
    given = load(path)
    real = {k: v.astype(dtype) for k, v in given.items() if v.dtype.kind == "f"}
    with jax.enable_x64(dtype == np.float64):
        answers = jax.jit(lambda real: answering(path)(given | real))(real)
        return jax.tree.map(np.asarray, answers)


def answering(path: Path) -> Callable[[Arrays], Arrays]:
    """The function that answers this kind of file."""
    if path.stem.startswith("magic_") and "cfg.n_cases" in load(path):
        return answer_attention
    by_prefix = {
        "ic3net_": answer_ic3net,
        "magic_": answer_magic,
        "het_": answer_hetnet,
        "tarmac_grad_": answer_tarmac_gradient,
        "tarmac_": answer_tarmac,
        f"{ALIVE}magic_": answer_magic_alive,
        ALIVE: answer_ic3net_alive,
    }
    for prefix, function in by_prefix.items():
        if path.stem.startswith(prefix):
            return function
    raise ValueError(f"{path.name}: no policy core answers files of this name.")


def answer_ic3net(fields: Arrays) -> Arrays:
    """README section 1."""
    gated, messages = bool(fields["cfg.gated"]), bool(fields["cfg.comm"])
    x = fields["in.x"]
    core = IC3NetCore(
        hidden=x.shape[-1],
        num_actions=fields["param.action.bias"].shape[0],
        communicates=bool(fields["cfg.comm_layer"]),
        gated=gated,
        comm_passes=int(fields["cfg.comm_passes"]),
    )
    # Without a gate everybody talks; where messages are forced to zero, nobody does.
    gate = jnp.asarray(fields["in.gate"] if gated else np.full(x.shape[:3], messages), x.dtype)
    params = {"params": nested(fields, "param.")}

    def step(carry, inputs):
        x, gate, alive = inputs
        h, s, logits, value = core.apply(params, IC3NetCarry(*carry, gate), x, alive)
        heads = {f"out.logp_{name}": jax.nn.log_softmax(y) for name, y in logits.items()}
        return (h, s), {"out.h": h, "out.s": s, "out.value": value, **heads}

    start, alive = jnp.zeros_like(x[:, 0]), fields.get("in.alive")
    return unroll(step, (start, start), (x, gate, alive), fields["in.reset"])


def answer_ic3net_alive(fields: Arrays) -> Arrays:
    """`policy_alive_*` of the IC3Net family: one pass, an alive mask besides."""
    return answer_ic3net(fields | {"cfg.comm": 1, "cfg.comm_layer": 1, "cfg.comm_passes": 1})


def answer_tarmac(fields: Arrays) -> Arrays:
    """README_tarmac.md section 1."""
    return tarmac_outputs(fields, nested(fields, "param."), fields["in.x"])


def answer_tarmac_gradient(fields: Arrays) -> Arrays:
    """`tarmac_grad_*`: derivatives of a weighted sum of the outputs, through all steps."""

    def weighed(params: Arrays, x: jax.Array) -> tuple[jax.Array, Arrays]:
        out = tarmac_outputs(fields, params, x)
        named = {"action": "out.logp_action", "gate": "out.logp_gate", "value": "out.value"}
        given = {k: v for k, v in named.items() if f"in.cot_{k}" in fields}
        return sum((fields[f"in.cot_{k}"] * out[v]).sum() for k, v in given.items()), out

    run = jax.value_and_grad(weighed, (0, 1), has_aux=True)
    (scalar, out), (params, x) = run(nested(fields, "param."), fields["in.x"])
    return out | dotted(params, "grad.") | {"grad.x": x, "out.scalar": scalar}


def tarmac_outputs(fields: Arrays, params: Arrays, x: jax.Array) -> Arrays:
    """What TarMAC with these parameters makes of x (S, T, N, H)."""
    gated = bool(fields["cfg.gated"])
    core = TarMACCore(
        hidden=x.shape[-1],
        num_actions=params["action"]["bias"].shape[0],
        gated=gated,
        comm_passes=int(fields["cfg.comm_passes"]),
    )
    if not fields["cfg.comm"]:  # what is said is made of nothing, so of the biases alone
        silent = {k: params[k] | {"kernel": 0 * params[k]["kernel"]} for k in SAID}
        params = params | silent
    params = {"params": params}
    folded = core.apply(params, jnp.zeros((0, x.shape[-1]), x.dtype), method=core.fold)
    gate = jnp.asarray(fields["in.gate"] if gated else np.ones(x.shape[:3]), x.dtype)

    def step(carry, inputs):
        x, gate, alive = inputs
        projected = core.apply(params, x, method=core.project_input)
        h, s, logits, value, attention = core.apply(
            params, IC3NetCarry(*carry, gate), projected, x[..., :0], folded, alive
        )
        heads = {f"out.logp_{name}": jax.nn.log_softmax(y) for name, y in logits.items()}
        out = {"out.h": h, "out.s": s, "out.value": value, "out.attention": attention}
        return (h, s), out | heads

    start, alive = jnp.zeros_like(x[:, 0]), fields.get("in.alive")
    return unroll(step, (start, start), (x, gate, alive), fields["in.reset"])


SAID = ("query", "key", "message")
"""The layers of TarMAC that read the memory that is said, or compared with it."""


def answer_magic_alive(fields: Arrays) -> Arrays:
    """`policy_alive_magic_*`: complete graphs among the living, as published for the domain."""
    x = fields["in.x"]
    heads, features = fields["param.gat1.a_i"].shape
    core = MAGICCore(
        hidden=x.shape[-1],
        num_actions=fields["param.action.bias"].shape[0],
        first_heads=heads,
        first_features=features,
        second_heads=fields["param.gat2.a_i"].shape[0],
        second_graph=False,
        decode_messages=True,
        drawn=False,
    )
    params = {"params": nested(fields, "param.")}
    folded = core.apply(params, jnp.zeros((0, x.shape[-1]), x.dtype), method=core.fold)

    def step(carry, inputs):
        x, alive = inputs
        projected = core.apply(params, x, method=core.project_input)
        (carry, logits, value, *_), caught = core.apply(
            params,
            carry,
            projected,
            x[..., :0],
            None,
            folded,
            alive,
            capture_intermediates=True,
        )
        layer = returned(caught["intermediates"])
        out = {"out.h": carry.h, "out.s": carry.s, "out.value": value}
        out |= {"out.logp_action": jax.nn.log_softmax(logits), "out.decoded": layer["decoder"]}
        out |= {"out.gat1": layer["gat1"][0], "out.gat2": layer["gat2"][0]}
        return carry, out

    start = jnp.zeros_like(x[:, 0])
    return unroll(step, MAGICCarry(start, start), (x, fields["in.alive"]), fields["in.reset"])


def answer_magic(fields: Arrays) -> Arrays:
    """README section 2.2."""
    x, rounds = fields["in.x"], 1 + int(fields["cfg.second_graph"])
    core = MAGICCore(
        hidden=x.shape[-1],
        num_actions=fields["param.action.bias"].shape[0],
        encoder_heads=int(fields["cfg.gat_enc_heads"]),
        encoder_features=int(fields["cfg.gat_enc_out"]),
        first_heads=int(fields["cfg.gat1_heads"]),
        first_features=int(fields["cfg.gat1_out"]),
        second_heads=int(fields["cfg.gat2_heads"]),
        second_graph=bool(fields["cfg.second_graph"]),
        decode_messages=bool(fields["cfg.message_decoder"]),
    )
    graphs = jnp.stack([fields[f"in.graph{q + 1}"] for q in range(rounds)], axis=2)
    params = {"params": magic_parameters(fields, rounds)}
    folded = core.apply(params, jnp.zeros((0, x.shape[-1]), x.dtype), method=core.fold)

    def step(carry, inputs):
        x, graphs = inputs
        projected = core.apply(params, x, method=core.project_input)
        nothing_seen, noise = x[..., :0], forcing(graphs, x.dtype)
        (carry, logits, value, drawn, _), caught = core.apply(
            params, carry, projected, nothing_seen, noise, folded, capture_intermediates=True
        )
        layer = returned(caught["intermediates"])
        out = {"out.h": carry.h, "out.s": carry.s, "out.value": value}
        out["out.logp_action"] = jax.nn.log_softmax(logits)
        out |= {f"out.{name}": layer[name][0] for name in ("gat_enc", "gat1", "gat2")}
        out |= {f"out.logits{q + 1}": layer["scheduler"][:, q] for q in range(rounds)}
        out |= {"out.decoded": layer["decoder"]} if "decoder" in layer else {}
        return carry, out | {f"in.graph{q + 1}": drawn[:, q] for q in range(rounds)}

    start = jnp.zeros_like(x[:, 0])
    return unroll(step, MAGICCarry(start, start), (x, graphs), fields["in.reset"])


def answer_attention(fields: Arrays) -> Arrays:
    """README section 2.3."""
    answers = {}
    for n in range(int(fields["cfg.n_cases"])):
        case = {k.removeprefix(f"c{n}."): v for k, v in fields.items() if k.startswith(f"c{n}.")}
        heads, features = case["param.a_i"].shape
        layer = GraphAttention(
            case["in.m"].shape[-1],
            heads,
            features,
            average=bool(case["cfg.average"]),
            normalize=bool(case["cfg.normalize"]),
            self_loop=SELF_LOOPS[int(case["cfg.self_loop"])],
        )

        def output(inputs, layer=layer):
            return layer.apply({"params": inputs["param"]}, inputs["m"], inputs["graph"])[0]

        inputs = {"m": case["in.m"], "graph": case["in.graph"], "param": nested(case, "param.")}
        inputs["graph"] = jnp.asarray(inputs["graph"], inputs["m"].dtype)
        y, pull_back = jax.vjp(output, inputs)
        (gradient,) = pull_back(jnp.asarray(case["in.cotangent"], y.dtype))
        gradient |= gradient.pop("param")
        answers |= {f"c{n}.out.y": y, **{f"c{n}.grad.{k}": v for k, v in gradient.items()}}
    return answers


def answer_hetnet(fields: Arrays) -> Arrays:
    """README section 3."""
    binary, n_p, n_a = bool(fields["cfg.binary"]), int(fields["cfg.n_P"]), int(fields["cfg.n_A"])
    with_lstm = bool(fields["cfg.lstm_front"])
    names = ["x_state_P", "x_state_A", "x_obs_P"] if with_lstm else ["feat_P", "feat_A"]
    inputs = {name: fields[f"in.{name}"] for name in names if f"in.{name}" in fields}
    bits = None
    if binary:
        layers = [[fields.get(f"in.bits{layer}_{c}") for c in "PA"] for layer in (1, 2)]
        layers = [jnp.concatenate([b for b in layer if b is not None], axis=-2) for layer in layers]
        inputs["bits"] = jnp.stack(layers, axis=-3)
        bits = int(inputs["bits"].shape[-1])
    heads, width = fields["param.layer1.p2p.dst"].shape
    settings = {"heads": heads, "features": width, "bits": bits}
    step = hetnet_sequence_step if with_lstm else hetnet_step
    return step(fields, inputs, settings, n_p, n_a)


def hetnet_step(fields: Arrays, inputs: Arrays, settings: Arrays, n_p: int, n_a: int) -> Arrays:
    """`cfg.lstm_front` = 0: a batch of agent features."""
    widths = tuple(fields[f"param.layer1.self_{c}.kernel"].shape[0] for c in "PA")
    graph = HetGraph(widths, **settings)
    f_p = inputs["feat_P"]
    f_a = inputs.get("feat_A", jnp.zeros((*f_p.shape[:-2], 0, widths[1]), f_p.dtype))
    noise = forcing(inputs["bits"], f_p.dtype) if "bits" in inputs else None

    params, meta = {"params": hetnet_parameters(fields)}, fields["in.feat_S"]
    result, seen = graph.apply(params, f_p, f_a, meta, noise, capture_intermediates=True)
    return hetnet_results(result, seen["intermediates"], n_p, n_a)


def hetnet_sequence_step(
    fields: Arrays, inputs: Arrays, settings: Arrays, n_p: int, n_a: int
) -> Arrays:
    """`cfg.lstm_front` = 1: sequences of encoded observations."""
    x_p, x_obs = inputs["x_state_P"], inputs["x_obs_P"]
    x_a = inputs.get("x_state_A", jnp.zeros((*x_p.shape[:2], 0, x_p.shape[-1]), x_p.dtype))
    x_state = jnp.concatenate([x_p, x_a], axis=-2)
    core = HetNetCore(x_state.shape[-1], x_obs.shape[-1], **settings)
    params, meta = {"params": hetnet_core_parameters(fields)}, jnp.asarray(fields["in.feat_S"])
    bits = inputs.get("bits")

    def step(carry, inputs):
        x_state, x_obs, bits = inputs
        projected = core.apply(params, x_state, method=core.project_states)
        noise = None if bits is None else forcing(bits, x_state.dtype)
        (carry, *result), seen = core.apply(
            params, carry, projected, x_obs, meta, noise, capture_intermediates=True
        )
        out = hetnet_results(result, seen["intermediates"]["graph"], n_p, n_a)
        states = {"h_state": carry.h_state, "s_state": carry.s_state}
        out |= {f"out.{name}_P": y[..., :n_p, :] for name, y in states.items()}
        out |= {f"out.{name}_A": y[..., n_p:, :] for name, y in states.items() if n_a}
        return carry, out | {"out.h_obs_P": carry.h_obs, "out.s_obs_P": carry.s_obs}

    state, view = jnp.zeros_like(x_state[:, 0]), jnp.zeros_like(x_obs[:, 0])
    start = HetNetCarry(state, state, view, view)
    return unroll(step, start, (x_state, x_obs, bits), fields["in.reset"])


def hetnet_results(result: Any, intermediates: Arrays, n_p: int, n_a: int) -> Arrays:
    """What `HetGraph` returned and passed on inside, as the fields of a recording."""
    logits, value, exchanges = result
    (hidden, _), (last, _) = (returned(intermediates)[f"layer{n}"] for n in (1, 2))
    classes = {"P": slice(None, n_p), "A": slice(n_p, n_p + n_a)}
    out = {"out.layer1_S": hidden["S"], "out.layer2_S": last["S"]}
    out |= {"out.value_P": value[..., 0], "out.value_A": value[..., 1]}
    for name, members in classes.items():
        if name == "A" and n_a == 0:
            continue
        out |= {f"out.layer1_{name}": hidden[name], f"out.logits_{name}": logits[name]}
        for layer, exchange in enumerate(exchanges, start=1):
            if exchange.bits is not None:
                out[f"out.bit_logits{layer}_{name}"] = exchange.bit_logits[..., members, :, :]
                out[f"in.bits{layer}_{name}"] = exchange.bits[..., members, :]
    return out


def unroll(step: Callable, start: Any, inputs: Any, reset: np.ndarray) -> Arrays:
    """`step` over the time axis of inputs (S, T, ...), the carry zeroed where `reset` (S, T)."""

    def one_step(carry, inputs):
        *inputs, reset = inputs
        carry = jax.tree.map(lambda c: jnp.where(reset[:, None, None] == 1, 0, c), carry)
        return step(carry, inputs)

    def swap(tree):
        return jax.tree.map(lambda y: jnp.swapaxes(y, 0, 1), tree)

    return swap(jax.lax.scan(one_step, start, swap((*inputs, jnp.asarray(reset))))[1])


def forcing(bits: jax.Array, dtype: Any) -> jax.Array:
    """Logistic noise with which a policy draws exactly these bits."""
    return (2 * bits.astype(dtype) - 1) * FORCED


def drawn_bits(fields: Arrays) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Every recorded draw as its logits (..., 2), Gumbel noise (..., 2) and bits (...)."""
    triples = [(f"out.logits{q}", f"in.noise{q}", f"in.graph{q}") for q in (1, 2)]
    triples += [
        (f"out.bit_logits{layer}_{c}", f"in.bit_noise{layer}_{c}", f"in.bits{layer}_{c}")
        for layer in (1, 2)
        for c in "PA"
    ]
    return [tuple(fields[name] for name in names) for names in triples if names[0] in fields]


def returned(intermediates: Arrays) -> Arrays:
    """What each submodule returned when it was called."""
    return {
        name: value["__call__"][0]
        for name, value in intermediates.items()
        if name != "__call__" and "__call__" in value
    }


def nested(fields: Arrays, prefix: str) -> Arrays:
    """ "param.lstm.w_ih" -> {"lstm": {"w_ih": ...}}, for the fields that start with `prefix`."""
    tree: Arrays = {}
    for name, value in fields.items():
        if name.startswith(prefix):
            *path, leaf = name.removeprefix(prefix).split(".")
            branch = tree
            for part in path:
                branch = branch.setdefault(part, {})
            branch[leaf] = value
    return tree


def dotted(tree: Any, prefix: str) -> Arrays:
    """{"lstm": {"w_ih": y}} -> {prefix + "lstm.w_ih": y}, the inverse of `nested`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {prefix + ".".join(key.key for key in path): leaf for path, leaf in leaves}


def magic_parameters(fields: Arrays, rounds: int) -> Arrays:
    """Our scheduler keeps the layers of both graphs in one array, graph first."""
    tree = nested(fields, "param.")
    schedulers = [tree.pop(f"sched{q + 1}") for q in range(rounds)]
    tree["scheduler"] = {
        f"{kind}_{layer}": jnp.stack([scheduler[layer][kind] for scheduler in schedulers])
        for layer in schedulers[0]
        for kind in ("kernel", "bias")
    }
    return tree


def hetnet_parameters(fields: Arrays) -> Arrays:
    """Ours have flat names inside a layer: `p2a_kernel`."""
    tree = nested(fields, "param.")
    for layer in ("layer1", "layer2"):
        tree[layer] = {
            f"{name}_{kind}": value
            for name, kinds in tree[layer].items()
            for kind, value in kinds.items()
        }
    return tree


def hetnet_core_parameters(fields: Arrays) -> Arrays:
    graph = hetnet_parameters(fields)
    lstms = {name: graph.pop(name) for name in ("lstm_state", "lstm_obs")}
    return lstms | {"graph": graph}
