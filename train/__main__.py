"""`python -m train`: the command `palpate-train`."""

import sys


def main() -> int:
    """Run one command; its exit code."""
    try:
        from train.cli import main as command  # here: imports take seconds, in which Ctrl-C may come

        return command.main()
    except KeyboardInterrupt:
        print("palpate-train: interrupted before anything was done", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
