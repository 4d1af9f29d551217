"""`python -m appliance`: the command `palpate`."""

import sys
from collections.abc import Sequence

from appliance.core.interrupts import during_imports


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; its exit code."""
    with during_imports("palpate"):
        from appliance.cli.main import main as command  # here: imports take a part of a second
    return command(argv)


if __name__ == "__main__":
    sys.exit(main())
