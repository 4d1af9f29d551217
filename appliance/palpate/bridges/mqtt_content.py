"""The contents of the topics at an MQTT broker, and Home Assistant's discovery of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from palpate import __version__
from palpate.bridges.source import COMMANDS, BoxView
from palpate.client.answers import Answer

QUIET = ("finger", "fingers", "time_s", "source", "missed", "share")
"""Fields of an answer that a verdict leaves out, or has in another form."""
PERCENT = {"unit_of_measurement": "%", "state_class": "measurement"}
ASIDE = {"entity_category": "diagnostic"}
"""Fields of a fact about the box: Home Assistant shows it on the device's page alone."""
ENTITIES: tuple[tuple[str, str, str, Mapping[str, str]], ...] = (
    ("verdict", "verdict", "value_json.material or value_json.status", {}),
    ("probability", "verdict", "(100 * value_json.probability) | round(1)", PERCENT),
    ("status", "verdict", "value_json.status", ASIDE),
    ("reason", "verdict", "(value_json.reason | string)[:255]", {}),
    ("ready", "state", "'ON' if value_json.ready else 'OFF'", {"platform": "binary_sensor"}),
    ("skin", "state", "value_json.skin", ASIDE),
    ("bundle", "state", "value_json.bundle", ASIDE),
    ("sweeps", "state", "value_json.answered", {"state_class": "total_increasing"}),
)
"""What Home Assistant shows: its name, the topic, the expression for its value (a state has at most
255 characters), and other fields."""


def discovery(name: str, *, writes: bool) -> dict[str, Any]:
    """Home Assistant's discovery of the whole device in one message. name: of the box. writes: with
    a button for each command."""
    base, box = f"palpate/{name}", f"palpate_{name}"
    parts: dict[str, dict[str, Any]] = {}
    for key, topic, value, more in ENTITIES:
        parts[key] = {"platform": "sensor", "unique_id": f"{box}_{key}", "name": key.capitalize()}
        parts[key] |= {"state_topic": f"{base}/{topic}", "value_template": f"{{{{ {value} }}}}"}
        parts[key] |= more
    parts["verdict"]["json_attributes_topic"] = f"{base}/verdict"
    for command in COMMANDS if writes else ():
        button = {"platform": "button", "unique_id": f"{box}_{command.lower()}"}
        button |= {"name": command.capitalize(), "command_topic": f"{base}/command"}
        parts[command.lower()] = button | {"payload_press": command}
    about = {"name": f"Palpate {name}", "manufacturer": "Palpate", "sw_version": __version__}
    return {
        "device": {"identifiers": [box], **about},
        "origin": {"name": "palpate", "sw_version": __version__},
        "availability_topic": f"{base}/status",
        "qos": 1,
        "components": parts,
    }


def state(view: BoxView, dropped: int) -> dict[str, Any]:
    """The content of the topic state. dropped: verdicts that the broker will not get."""
    fields: dict[str, Any] = {"ready": False, "skin": "", "bundle": view.bundle, "answered": 0}
    if one := view.state:
        fields |= {"ready": one.ready, "skin": one.skin, "sweeping": one.sweeping}
        fields |= {"bundle": one.bundle, "answered": one.answered, "degraded": one.degraded}
        fields |= {"lost_frames": one.lost_frames, "source": one.source}
    return fields | {"missed": view.missed, "dropped": dropped}


def verdict(answer: Answer) -> dict[str, Any]:
    """The content of the topic verdict, without `late`. `material` is the label if it can be
    used, else ""."""
    fields = {name: value for name, value in asdict(answer).items() if name not in QUIET}
    fields |= {"material": answer.label if answer.known else "", "early": answer.early}
    fields |= {"reason": "" if answer.known else answer.what_to_do}
    fingers = {one.finger: {"status": one.status, "label": one.label} for one in answer.fingers}
    return fields | ({"fingers": fingers} if fingers else {})
