"""`python -m palpate_studies`: experiments and their pages."""

import sys

from palpate_studies.command import main

if __name__ == "__main__":
    sys.exit(main())
