"""`python -m palpate_train`: the command `palpate-train`."""

import sys

from palpate.core.interrupts import during_imports


def main() -> int:
    """Run one command; its exit code."""
    with during_imports("palpate-train"):
        from palpate_train.cli.main import main as command  # here: imports take seconds
    return command()


if __name__ == "__main__":
    sys.exit(main())
