"""`python -m sumajax`."""

from sumajax.cli import main

if __name__ == "__main__":
    main()
