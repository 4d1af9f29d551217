"""What other programs import to talk with the box: over its feed, over its serial line. numpy is
not needed."""
