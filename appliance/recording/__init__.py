"""From frames and edges to sweeps, and from sweeps to files: recordings, black box, captures."""
