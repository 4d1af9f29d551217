"""The folder of a running box, and the names in it, for the box and for programs beside it."""

RUNTIME = "/run/palpate"
"""Default of store.runtime."""
STATUS, FEED = "status.json", "feed.sock"
"""The file of `palpate status`, and the socket of the feed."""
FEED_SCHEMA = 1
"""Version of the feed's lines (PROTOCOL.md, part 4), for writer and readers."""
