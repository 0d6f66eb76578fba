"""The command `sumajax`, also `python -m sumajax`; needs the extra `experiments`."""

import sys

USAGE = """usage: sumajax transfer {domains} [options]
       sumajax evaluate RUN|NAME [options]
       sumajax pretrained
       sumajax marl-eval RUN... [options]

  transfer   train on a small grid, carry the policy over to a large one, compare with scratch
  evaluate   play trained policies on held-out starts, on other grids and with other teams
  pretrained list the trained policies that come with the package, by NAME
  marl-eval  write the results of runs in the JSON form that marl-eval reads

Every command has --help."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command that the arguments name; exit status 2 where they name none."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        from sumajax.cli import evaluate, marl_eval, pretrained, transfer
    except ModuleNotFoundError as missing:
        print(
            f"error: {missing.name} is not installed; pip install 'sumajax[experiments]'.",
            file=sys.stderr,
        )
        raise SystemExit(2) from None
    usage = USAGE.format(domains="|".join(transfer.OPTIONS))
    match arguments:
        case ["transfer", domain, *options] if domain in transfer.OPTIONS:
            transfer.main(domain, options)
        case ["evaluate", *options]:
            evaluate.main(options)
        case ["pretrained"]:
            pretrained.main()
        case ["marl-eval", *options]:
            marl_eval.main(options)
        case ["--help" | "-h", *_]:
            print(usage)
        case _:
            print(usage, file=sys.stderr)
            raise SystemExit(2)
