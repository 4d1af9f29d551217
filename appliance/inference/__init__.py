"""From a sweep to a verdict: network, novelty detection, early exit; enrolment of new materials."""
