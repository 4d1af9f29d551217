"""Methods under protocols and corruptions, with intervals."""
