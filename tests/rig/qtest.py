"""QEMU's qtest socket: commands, answers, and changes of intercepted outputs."""

import queue
import socket
import threading
from collections.abc import Callable

ANSWER_S = 60
"""QEMU answers at once, but on a very busy machine it may have to wait for the processor."""


class Qtest:
    """One guest's socket. changed: called with number and level of an output."""

    def __init__(self, connection: socket.socket) -> None:
        self.changed: Callable[[int, bool], None] = lambda number, level: None
        self._socket, self._asking = connection, threading.Lock()
        self._answers: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=self._listen, daemon=True).start()

    def ask(self, *lines: str) -> list[str]:
        """Send all commands in one write; the text after OK in the answer to each.

        Raises OSError if QEMU has ended or does not answer, RuntimeError if it refuses.
        """
        with self._asking:
            self._socket.sendall("".join(f"{line}\n" for line in lines).encode())
            answers = [self._answer() for _ in lines]
        for line, answer in zip(lines, answers, strict=True):
            if not answer.startswith("OK"):
                raise RuntimeError(f"qtest: {line}: {answer}")
        return [answer.removeprefix("OK").strip() for answer in answers]

    def close(self) -> None:
        """Let go."""
        self._socket.close()

    def _answer(self) -> str:
        try:
            answer = self._answers.get(timeout=ANSWER_S)
        except queue.Empty as e:
            raise TimeoutError(f"qemu did not answer within {ANSWER_S} s") from e
        if not answer:
            self._answers.put("")  # wakes a caller that waits for an answer
            raise ConnectionError("qemu has gone")
        return answer

    def _listen(self) -> None:
        try:
            for line in self._socket.makefile():
                word, *rest = line.split()
                if word == "IRQ":
                    self.changed(int(rest[1]), rest[0] == "raise")
                else:
                    self._answers.put(line.strip())
        except (OSError, ValueError):
            pass  # the socket was closed
        self._answers.put("")
