"""Pages and pictures from result files."""
