"""Classify with `palpate.client` and print the label; `slide` moves the robot (python.md)."""

from palpate.client.box import Palpate
from palpate.core.errors import ApplianceError


def classify(box, slide, tries=3):
    """The label of the object under the finger, None: set it aside.

    slide: moves the finger; returns when it stands. Raises RuntimeError if the sweep, the skin or
    the wiring was at fault; ApplianceError if the box is not there.
    """
    box.new_object()
    for _ in range(tries):
        box.wait_ready(timeout_s=10)
        box.start()  # leave this and `stop` out if START and STOP are GPIO lines
        slide()
        box.stop()
        answer = box.result(timeout_s=2)
        if answer.known:
            return answer.label
        if answer.faulty:
            raise RuntimeError(f"{answer.status}: {answer.what_to_do}")
        if not answer.unsure:  # undecided, unknown
            return None
    return None  # still unsure


def main(port, slide):
    """Classify once at the box on `port`, and print the label or the reason."""
    with Palpate(port) as box:  # "/dev/ttyUSB0", "socket://192.168.0.10:1503"
        try:
            label = classify(box, slide)
            print(label if label else "set it aside")
        except (ApplianceError, RuntimeError) as e:
            print(f"no answer: {e}")  # tell a person
