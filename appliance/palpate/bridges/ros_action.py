"""The action ~/sweep of the ROS 2 node: each goal is a sweep by command. Imported only if
palpate_msgs is installed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from palpate_msgs.action import Sweep
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from palpate.bridges.source import Source
from palpate.bridges.sweep import CommandedSweep
from palpate.client.answers import Answer
from palpate.core.errors import ApplianceError

LOG_S = 5.0
"""Least time between two log lines about rejected goals."""
END_S = 10.0
"""Longest wait for a sweep that was interrupted, as it may be waiting for the box."""


class SweepAction:
    """Serves one goal at a time and rejects others meanwhile. box: gives the box for commands, or
    raises ApplianceError."""

    def __init__(self, node: Node, box: Callable[[], Source]) -> None:
        self._box, self._log = box, node.get_logger()
        self._busy = threading.Lock()
        self._ending = threading.Event()
        ActionServer(
            node,
            Sweep,
            "~/sweep",
            self._execute,
            goal_callback=self._admit,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def interrupt(self) -> None:
        """Abort the current sweep, at the box too, and wait until it has ended."""
        self._ending.set()
        if self._busy.acquire(timeout=END_S):
            self._busy.release()
        self._ending.clear()

    def _admit(self, goal: Any) -> GoalResponse:
        if self._busy.acquire(blocking=False):
            return GoalResponse.ACCEPT
        self._log.warning(
            "~/sweep: a goal was rejected, another one is under way", throttle_duration_sec=LOG_S
        )
        return GoalResponse.REJECT

    def _execute(self, goal: Any) -> Any:
        try:
            answer, result = self._swept(goal)
            if goal.is_cancel_requested:
                goal.canceled()
            elif answer and not answer.faulty:
                goal.succeed()
            else:
                goal.abort()
            return result
        finally:
            self._busy.release()

    def _swept(self, goal: Any) -> tuple[Answer | None, Any]:
        """The answer, if one came, and the message for it."""

        def say(phase: str, answer: Answer | None) -> None:
            said = Sweep.Feedback(phase=phase)
            if answer:
                said.status, said.label = str(answer.status), answer.label
                said.probability = answer.probability
            goal.publish_feedback(said)

        try:
            box = self._box()
            canceled = lambda: goal.is_cancel_requested or self._ending.is_set()  # noqa: E731
            answer = CommandedSweep(box.client(), canceled=canceled, say=say).run(goal.request)
        except ApplianceError as e:
            return None, Sweep.Result(message=str(e))
        names = (
            *("sweep", "label", "probability", "margin", "fused", "lost"),
            *("latency_ms", "share", "bundle"),
        )
        return answer, Sweep.Result(
            status=str(answer.status),
            code=box.view().code(answer.label),
            message=answer.what_to_do,
            **{name: getattr(answer, name) for name in names},
        )
