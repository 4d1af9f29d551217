"""`python -m train`: the command `palpate-train`."""

import sys

from train.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
