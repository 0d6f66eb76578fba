"""`sumajax pretrained`: the trained policies of the package."""

from sumajax import reporting, store


def main() -> None:
    """Prints what there is: name, task, and steps taken and success on held-out starts."""
    reporting.print_table([_row(name) for name in store.names()], title="trained policies")


def _row(name: str) -> dict[str, str]:
    card = store.card(name)
    sampled, greedy = (
        f"{card['held_out'][mode]['steps_taken']:.2f} {card['held_out'][mode]['success']:6.1%}"
        for mode in ("sampled", "greedy")
    )
    return {"name": name, "task": card["task"], "sampled": sampled, "greedy": greedy}
