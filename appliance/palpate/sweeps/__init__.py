"""Cuts sweeps from frames, and writes them to files: recordings, black box, captures."""
