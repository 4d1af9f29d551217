"""From frames and edges to sweeps, and sweeps to files."""
