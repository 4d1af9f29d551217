"""`python -m palpate.bridges`: the bridges alone, on a computer without numpy and onnxruntime."""

import sys

from palpate.bridges.command import main

if __name__ == "__main__":
    sys.exit(main())
