"""`python -m palpate`: the command `palpate`."""

import sys

from palpate.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
