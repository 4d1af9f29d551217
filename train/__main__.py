"""`python -m train`: the command `palpate-train`."""

import sys

from appliance.core.interrupts import during_imports


def main() -> int:
    """Run one command; its exit code."""
    with during_imports("palpate-train"):
        from train.cli.main import main as command  # here: imports take seconds
    return command()


if __name__ == "__main__":
    sys.exit(main())
