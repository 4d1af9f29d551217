"""The settings of the readout board. Change them for the skin, copy this file to the Pico, and
switch it on again."""

ROWS = 4  # along the direction of sliding, 1 to 16
COLS = 4  # 1 to 16
RATE_HZ = 750  # frames a second; README.md has the rates that a Pico can reach
DTYPE = "uint8"  # "uint8": the upper 8 bits of the converter; "uint16": all 12, scaled to 16
FIFO_S = 1  # seconds of frames that are kept while the host does not read; at least 0.25
BOARD = "palpate-pico"  # the reported name, at most 16 ASCII characters

ROW_PINS = (2, 3, 4, 5)  # GPIO numbers of S0 to S3 of the multiplexer of the rows
COL_PINS = (6, 7, 8, 9)  # the same for the columns
ADC_PIN = 26  # GPIO 26, 27 or 28: the common pin of the columns' multiplexer
SETTLE_US = 5  # wait between switching to a taxel and reading it; README.md, "Budget"
TRIGGER_PIN = None  # GPIO of the robot's trigger line, if it is wired to the Pico as well
# connect to GND at power-on to get the prompt of MicroPython instead of the firmware
SERVICE_PIN = 22
# frames are taken even while MicroPython collects garbage; needs MicroPython 1.26 or later
HARD_TIMER = True
