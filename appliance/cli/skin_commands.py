"""The commands `palpate skin ...`: the skin by itself, without a bundle.

In: arguments, and a way to the devices, which `main` chooses. Out: lines on standard output, exit codes.
"""

from __future__ import annotations

import argparse
from contextlib import closing

from appliance.cli.commands import OpenDevices, load_settings
from appliance.io import skins


def run_check(args: argparse.Namespace, open_devices: OpenDevices) -> int:
    """`palpate skin check`: each part of PROTOCOL.md, one line each; 1 where any fails."""
    from appliance.tools import skin_check

    devices = open_devices(None)
    settings = devices.wire(load_settings(args))
    failed, port = 0, settings.sensor.link == "serial"
    with closing(skins.open_board(settings, devices)) as link:
        for found in skin_check.check(link, devices.clock, args.seconds, port=port):
            print(f"{found.verdict:<7}  {found.part:<9} {found.detail}", flush=True)
            failed += found.verdict == "FAIL"
    return 1 if failed else 0


WITH_DEVICES = {"skin check": run_check}
