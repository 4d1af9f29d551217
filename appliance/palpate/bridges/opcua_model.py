"""The nodes of the OPC UA server: variables, methods and their values, with the names and numbers
of OPC 40100-1 (Machine Vision) as far as a box has them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from asyncua import ua

from palpate.bridges.source import BoxView
from palpate.client.answers import Answer
from palpate.core import wall_clock
from palpate.core.status import Status

KINDS = ua.VariantType
ERROR, INITIALIZED, READY, EXECUTING = 3, 5, 6, 7
STATES = {ERROR: "Error", INITIALIZED: "Initialized", READY: "Ready", EXECUTING: "SingleExecution"}
"""States of the machine by their numbers in OPC 40100-1."""
COMPLETED, ABORTED, FAILED = 1, 3, 4
"""States of a result in OPC 40100-1."""
OBJECTS = "VisionStateMachine", "RecipeManagement", "LastResult"
"""What holds the variables and methods."""
STATE: Mapping[str, ua.VariantType] = {
    "VisionStateMachine.CurrentState": KINDS.LocalizedText,
    "VisionStateMachine.CurrentState.Number": KINDS.UInt32,
    "VisionStateMachine.Skin": KINDS.String,
    "VisionStateMachine.LostFrames": KINDS.UInt32,
    "VisionStateMachine.Answered": KINDS.UInt32,
    "RecipeManagement.InternalRecipeId": KINDS.String,
}
RESULT: Mapping[str, ua.VariantType] = {
    "LastResult.JobId": KINDS.UInt32,
    "LastResult.ResultState": KINDS.Int32,
    "LastResult.Status": KINDS.String,
    "LastResult.Material": KINDS.String,
    "LastResult.Label": KINDS.String,
    "LastResult.LabelCode": KINDS.UInt16,
    "LastResult.Probability": KINDS.Float,
    "LastResult.Margin": KINDS.Float,
    "LastResult.Reason": KINDS.String,
    "LastResult.InternalRecipeId": KINDS.String,
    "LastResult.StartTime": KINDS.DateTime,
    "LastResult.EndTime": KINDS.DateTime,
    "LastResult.CreationTime": KINDS.DateTime,
    "LastResult.ResultId": KINDS.String,
}
"""Variables of the last result, and fields of its event; ResultId is written last, so whoever reads
the others after its change has the values of a single result."""
REPLY = "VisionStateMachine.LastReply"
VARIABLES = {**STATE, REPLY: KINDS.String, **RESULT}
"""All variables by their paths."""
SLIDE = {"SpeedMmS": 10_000.0, "ForceN": 1000.0}
"""Arguments of Start with their largest values; 0: not known."""
METHODS: Mapping[str, tuple[str, Mapping[str, float]]] = {
    "Start": ("START", SLIDE),
    "Stop": ("STOP", {}),
    "Reset": ("ABORT", {}),
    "NewObject": ("NEW", {}),
    "Tare": ("TARE", {}),
}
"""Methods with the box's commands and their arguments."""
NUMBERS = {
    *(KINDS.Float, KINDS.Double, KINDS.SByte, KINDS.Byte, KINDS.Int16, KINDS.UInt16),
    *(KINDS.Int32, KINDS.UInt32, KINDS.Int64, KINDS.UInt64),
}
"""Types of a number that controllers send; the library checks none."""
CODES = ua.StatusCodes


def argument(name: str, kind: int, rank: int = -1) -> ua.Argument:
    """The declaration of an argument. rank: 1 for a list."""
    return ua.Argument(Name=name, DataType=ua.NodeId(kind), ValueRank=rank)


def numbers(
    given: Sequence[ua.Variant], tops: Mapping[str, float]
) -> list[float] | ua.CallMethodResult:
    """The numbers of a method's arguments, or its refusal."""
    if len(given) != len(tops):
        few = len(given) < len(tops)
        code = CODES.BadArgumentsMissing if few else CODES.BadTooManyArguments
        return ua.CallMethodResult(StatusCode=ua.StatusCode(code))
    codes = []
    for one, top in zip(given, tops.values(), strict=True):
        kind = one.VariantType in NUMBERS and not one.is_array
        fits = kind and math.isfinite(one.Value) and 0 <= one.Value <= top
        codes.append(0 if fits else CODES.BadOutOfRange if kind else CODES.BadTypeMismatch)
    if any(codes):
        each = [ua.StatusCode(code) for code in codes]
        refused = ua.StatusCode(CODES.BadInvalidArgument)
        return ua.CallMethodResult(StatusCode=refused, InputArgumentResults=each)
    return [float(one.Value) for one in given]


def state(view: BoxView) -> dict[str, Any]:
    one = view.state
    ready = bool(one and one.ready)
    moving = bool(one and one.sweeping)
    lost = bool(one and one.skin != "streaming")
    number = ERROR if lost else EXECUTING if moving else READY if ready else INITIALIZED
    values = (
        *(ua.LocalizedText(STATES[number]), number, one.skin if one else ""),
        *(one.lost_frames if one else 0, one.answered if one else 0, view.bundle),
    )
    return dict(zip(STATE, values, strict=True))


def result(answer: Answer, view: BoxView, at_s: float, start_s: float | None) -> dict[str, Any]:
    """The values of RESULT. at_s: when it was heard. start_s: of the sweep, if that was heard."""
    at = wall_clock.utc(at_s)
    done = FAILED if answer.faulty else COMPLETED
    values = (
        answer.sweep,
        ABORTED if answer.status is Status.ABORTED else done,
        str(answer.status),
        answer.label if answer.known else "",
        answer.label,
        view.code(answer.label) if answer.known else 0,
        answer.probability,
        answer.margin,
        "" if answer.known else answer.what_to_do,
        answer.bundle,
        None if start_s is None else wall_clock.utc(start_s),
        wall_clock.utc(at_s - answer.latency_ms / 1000),
        at,
        f"{at:%Y%m%dT%H%M%S.%fZ}-{answer.sweep}",
    )
    return dict(zip(RESULT, values, strict=True))
