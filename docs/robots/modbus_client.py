"""The block of FB_Palpate.st in Python, with pymodbus (docs/robots/modbus.md)."""

import time

ANSWERS, STATUS, LABEL_CODE = 3, 4, 5  # input registers
START, STOP, NEW = 0, 1, 2  # coils
OK, UNSURE, UNDECIDED, UNKNOWN, STALE = 1, 2, 3, 4, 99


def pulse(plc, coil):
    for level in (False, True, False):
        if plc.write_coil(coil, level).isError():
            raise RuntimeError(f"the box refuses coil {coil}; see the bridge's log")


def words(plc):
    reply = plc.read_input_registers(0, count=40)
    if reply.isError():
        raise RuntimeError(f"cannot read: {reply}")
    if reply.registers[STATUS] == STALE:
        raise RuntimeError("the box is not heard")
    return reply.registers


def classify(plc, slide, tries=3, timeout_s=2.0):
    """The code of the label, or 0: set the object aside. plc: a connected ModbusTcpClient of
    pymodbus. slide: moves the finger. Raises RuntimeError at a fault or after the time limit."""
    pulse(plc, NEW)
    for _ in range(tries):
        before = words(plc)[ANSWERS]
        pulse(plc, START)
        slide()
        pulse(plc, STOP)
        deadline = time.monotonic() + timeout_s
        while (now := words(plc))[ANSWERS] == before:
            if time.monotonic() > deadline:
                raise RuntimeError(f"no answer within {timeout_s} s")
            time.sleep(0.01)
        if now[STATUS] == OK:
            return now[LABEL_CODE]
        if now[STATUS] in (UNDECIDED, UNKNOWN):
            return 0
        if now[STATUS] != UNSURE:
            raise RuntimeError(f"status {now[STATUS]}: the sweep or the skin was at fault")
    return 0
