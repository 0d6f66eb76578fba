"""Makes entries of the package's store of trained policies from finished runs.

    python -m experiments.pretrained RUN... --commit COMMIT [--arms ARM...]

Every stage of a run gives one entry: its best seed, as it comes back from the store. Runs that
differ in nothing but their seeds, as where seeds were added later, are taken together. The best is
the one that takes the fewest steps, sampled and greedy together, on 1,024 starts that are none of
those of the card's figures, and with another key. The card's figures are measured anew.
"""

import argparse
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sumajax import checkpoint, store
from sumajax.cli.domains import DOMAINS, domain_of, grid_label, team_label
from sumajax.description import versions
from sumajax.environments.wrapper import unwrapped
from sumajax.evaluation import (
    EPISODES,
    Agent,
    Evaluation,
    evaluate,
    load_agent,
    shortest_path_steps,
)
from sumajax.experiment.records import MODES
from sumajax.keys import key_of
from sumajax.learning import make_learner
from sumajax.sources import stage_directories
from sumajax.transfer import untrained_parameters

CHOICE_SEED, CARD_SEED = 11, 13
"""Of the policy's own randomness, when a seed is chosen and for the figures on the card; that of a
run's own evaluations is another again."""
CHECK_EPISODES = 64
"""Held-out episodes whose steps the card lists one by one: what the tests play again."""
LICENCE = "MIT"
PAGE = Path(__file__).parents[1] / "docs" / "pretrained.md"
TABLE = "<!-- python -m experiments.pretrained writes the table -->"
END = "<!-- end of the table -->"
PROGRAMS = {
    "scale.py": ("python", "-m", "experiments.scale"),
    **{f"{name}_transfer.py": ("sumajax", "transfer", name) for name in DOMAINS},
}
"""What the card calls the programs of a clone; any other is `sumajax` itself."""
PRIVATE = ("--output", "--runs")
"""Options that say where a run was written, and nothing of what it was."""


def entries_of(
    runs: Sequence[Path], commit: str, arms: Sequence[str] = (), folder: Path = store.FOLDER
) -> list[str]:
    """Adds the stages of a plan to the store, or renews them, and returns their names.

    Args:
      runs: of that plan, each with seeds of its own.

    Raises:
      ValueError: for a run that is not finished, or an arm that it does not have.
    """
    for run in runs:
        if not (run / "summary.json").exists():
            raise ValueError(f"{run} is no finished run; its summary.json is not there.")
        known = stage_directories(run)
        for arm in arms:
            if arm not in known:
                raise ValueError(f"{run} has no arm {arm!r}; it has {', '.join(known)}.")
    added = []
    for arm in arms or stage_directories(runs[0]):
        agent, run, made = best_seed(runs, arm)
        config = json.loads((run / "config.json").read_text())
        steps = json.loads((run / "stages.json").read_text())[arm]["result"]["env_steps"]
        card = {
            **card_of(agent),
            "env_steps": steps,
            **made,
            "command": command_of(config["command"]),
            "commit": commit,
            "trained_with": config["versions"],
            "measured_with": versions(),
            "licence": LICENCE,
            "meta": meta_of(stage_directories(run)[arm], agent, made["seed"]),
        }
        name = name_of(agent.env, agent.policy.name)
        store.write(name, card, agent.params, folder)
        added.append(name)
    return added


def of_one_plan(runs: Sequence[Path]) -> list[list[Path]]:
    """The runs in groups that differ in their seeds alone."""
    groups: dict[str, list[Path]] = {}
    for run in runs:
        plan = json.loads((run / "config.json").read_text())["experiment"]
        groups.setdefault(json.dumps({**plan, "seeds": None}, sort_keys=True), []).append(run)
    return list(groups.values())


def best_seed(runs: Sequence[Path], arm: str) -> tuple[Agent, Path, dict[str, Any]]:
    """The policy of a stage that does best, as the store keeps it, its run, and what it was chosen
    among.
    """
    tried = [
        (seed, run, as_kept(load_agent(directory, seed=seed)))
        for run in runs
        for directory in [stage_directories(run)[arm]]
        for seed in checkpoint.read_meta(directory).get("seeds", [0])
    ]
    steps = [steps_elsewhere(agent) for _, _, agent in tried]
    seed, run, agent = tried[int(np.argmin(steps))]
    return (
        agent,
        run,
        {
            "seed": seed,
            "seeds_tried": [seed for seed, _, _ in tried],
            "chosen_by": {
                "fewest": "steps taken, mean of sampled and greedy",
                "starts": f"{EPISODES}, none of which is among those of the figures",
                "key": CHOICE_SEED,
                "by_seed": steps,
            },
        },
    )


def as_kept(agent: Agent) -> Agent:
    """The agent that comes back from the store."""
    return agent.replace(params=store.as_kept(agent.params))  # type: ignore[attr-defined]


def steps_elsewhere(agent: Agent) -> float:
    """Mean steps taken, sampled and greedy, on starts beyond the card's."""
    results = [played(agent, mode, CHOICE_SEED, 2 * EPISODES) for mode in MODES]
    return float(np.mean([result.steps_taken[EPISODES:] for result in results]))


def played(agent: Agent, mode: str, seed: int, episodes: int) -> Evaluation:
    """Held-out episodes."""
    key, greedy = key_of(seed), mode == "greedy"
    found: Evaluation = evaluate(
        agent.env, agent.policy, agent.params, key, episodes=episodes, greedy=greedy
    )
    return found


def card_of(agent: Agent) -> dict[str, Any]:
    """What a policy is of and what it reaches."""
    task = unwrapped(agent.env)
    bound = shortest_path_steps(agent.env)
    return {
        "name": name_of(agent.env, agent.policy.name),
        "task": f"{type(task).__name__}, {grid_label(task.shape)}, {team_label(task)} "
        f"{domain_of(task).members}, at most {task.max_steps} steps",
        "team": f"{team_label(task)} {domain_of(task).members}",
        "seen_at": grid_label(agent.env.state_shape[-2:]),
        "policy": agent.policy.name,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(agent.params)),
        "held_out": {
            "episodes": EPISODES,
            "key": CARD_SEED,
            **{mode: means(played(agent, mode, CARD_SEED, EPISODES)) for mode in MODES},
            "shortest_path_steps": None if bound is None else float(np.mean(bound)),
        },
        "check": {
            "episodes": CHECK_EPISODES,
            "key": CARD_SEED,
            **{mode: steps_of_each(agent, mode) for mode in MODES},
        },
    }


def means(result: Evaluation) -> dict[str, float]:
    return {
        "steps_taken": float(np.mean(result.steps_taken)),
        "success": float(np.mean(result.success)),
        "return": float(np.mean(result.episode_return)),
    }


def steps_of_each(agent: Agent, mode: str) -> list[int]:
    """Steps taken in each of the first held-out episodes."""
    return np.asarray(played(agent, mode, CARD_SEED, CHECK_EPISODES).steps_taken).tolist()


def name_of(env: Any, policy: str) -> str:
    """As pp-10x10-ic3net, or pp-5x5-at-10x10-ic3net where the task is seen upsampled."""
    task = unwrapped(env)
    (domain,) = [name for name, known in DOMAINS.items() if known is domain_of(task)]
    own, seen = grid_label(task.shape), grid_label(env.state_shape[-2:])
    return "-".join([domain, own, *([] if own == seen else ["at", seen]), policy])


def command_of(arguments: list[str]) -> str:
    """The command of a run, without the places on the machine that it ran on."""
    kept, skipped = [], False
    for argument in arguments[1:]:
        skipped = skipped and not argument.startswith("--")
        if argument.partition("=")[0] in PRIVATE:
            skipped = True
        elif not skipped:
            kept.append(argument)
    program = PROGRAMS.get(Path(arguments[0]).name, ("sumajax",))
    return shlex.join([*program, *kept])


def meta_of(directory: Path, agent: Agent, seed: int) -> dict[str, Any]:
    """What a checkpoint of the seed alone would say, and which parameters nothing trained."""
    meta = checkpoint.read_meta(directory)
    learner = make_learner(agent.env, agent.policy)
    trained = load_agent(directory, seed=seed).params
    stacked = jax.tree.map(lambda leaf: leaf[None], trained)
    untrained = untrained_parameters(directory, learner, stacked, (seed,))
    meta.pop("stops", None)
    return {**meta, "seeds": [seed], "untrained": untrained}


def table() -> str:
    """The store's policies for docs/pretrained.md, a row each."""
    columns = "name", "team", "sampled (success)", "greedy (success)", "shortest", "seed"
    rows = [columns, ("---",) * len(columns), *map(_row, store.names())]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _row(name: str) -> tuple[str, ...]:
    card = store.card(name)
    figures = [
        f"{card['held_out'][mode]['steps_taken']:.2f} ({card['held_out'][mode]['success']:.3f})"
        for mode in MODES
    ]
    bound = card["held_out"]["shortest_path_steps"]
    seed = f"{card['seed']} of {', '.join(map(str, card['seeds_tried']))}"
    shortest = "-" if bound is None else f"{bound:.2f}"
    return f"`{name}`", card["team"], *figures, shortest, seed


def write_table(page: Path = PAGE) -> None:
    """Renews the table of the page."""
    before, _, rest = page.read_text().partition(TABLE)
    _, _, after = rest.partition(END)
    page.write_text(f"{before}{TABLE}\n\n{table()}\n{END}{after}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="directories of finished runs")
    parser.add_argument("--commit", required=True, help="of the package that trained them")
    parser.add_argument("--arms", nargs="*", default=[], help="stages; all if not given")
    chosen = parser.parse_args()
    for runs in of_one_plan(chosen.runs):
        for name in entries_of(runs, chosen.commit, chosen.arms):
            print(name, json.dumps(store.card(name)["held_out"]))
    write_table()
    total = sum(file.stat().st_size for file in store.FOLDER.iterdir())
    print(f"the store has {len(store.names())} policies, {total} bytes")


if __name__ == "__main__":
    main()
