"""From a sweep to a verdict: network, novelty, early exit, enrolment."""
