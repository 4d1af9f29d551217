"""Runs shell lines from a virtio port: {"run", "timeout_s"} to {"rc", "out"}; 124: time up."""

import base64
import json
import os
import subprocess

PORT = "/dev/virtio-ports/palpate.agent"


def answer(request: dict) -> dict:
    """Run the shell line; `stdin` is its standard input in base64."""
    given = base64.b64decode(request.get("stdin", ""))
    try:
        done = subprocess.run(
            ["/bin/sh", "-c", request["run"]],
            input=given,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=request["timeout_s"],
            check=False,
        )
    except subprocess.TimeoutExpired as e:
        return {"rc": 124, "out": base64.b64encode(e.stdout or b"").decode()}
    return {"rc": done.returncode, "out": base64.b64encode(done.stdout).decode()}


def main() -> None:
    """Answer for ever. Nobody at the other end reads as nothing: wait for the next."""
    with open(PORT, "r+b", buffering=0) as port:
        rest = b""
        while True:
            *lines, rest = (rest + os.read(port.fileno(), 65536)).split(b"\n")
            for line in lines:
                told = json.dumps(answer(json.loads(line))).encode() + b"\n"
                while told:  # the port takes 32 KB at once
                    told = told[os.write(port.fileno(), told) :]


if __name__ == "__main__":
    main()
