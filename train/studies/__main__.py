"""`python -m train.studies`: experiments and their pages."""

import sys

from train.studies.command import main

if __name__ == "__main__":
    sys.exit(main())
