"""Options that the commands of `palpate-train` and of the studies share."""
