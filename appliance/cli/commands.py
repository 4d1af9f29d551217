"""What needs no device: replay, settings, status, the store. In: arguments. Out: lines on standard output, exit codes."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from appliance.cli.device_commands import model, settings
from appliance.core import config
from appliance.core.clock import SystemClock
from appliance.runtime import assembly


def run_replay(args: argparse.Namespace) -> int:
    """`palpate replay`: the sentences of a capture, a kept sweep or a folder of them; 1 where a verdict is another."""
    from appliance.runtime.replay import replay

    how = settings(args)
    return replay(args.file, how, model(how), lambda text: print(text, end="", flush=True))


def run_config(args: argparse.Namespace) -> int:
    """`palpate config`: each value with its source."""
    print(config.describe(settings(args)))
    return 0


def run_status(args: argparse.Namespace) -> int:
    """`palpate status`: how the service is; 69 where it waits for the skin, 1 where it does not run."""
    from appliance.service import status

    now_ns = SystemClock().now_ns()
    told = status.read(Path(settings(args).store.status), now_ns)
    print(json.dumps(told, indent=1) if args.json else "\n".join(status.lines(told, now_ns)))
    return status.exit_code(told)


def run_bundles(args: argparse.Namespace) -> int:
    """`palpate bundles`: which bundle runs, and what it goes back to."""
    from appliance.cli import bundle_list
    from appliance.deployment import shadow

    how = settings(args)
    store, folder = assembly.store(how), Path(how.store.folder) / "shadow"
    told, beside = bundle_list.entries(store), shadow.read(folder)
    lines = bundle_list.lines(told)
    if beside and store.state.candidate.startswith(beside.candidate):
        lines += beside.lines(folder)
    print(json.dumps([asdict(e) for e in told], indent=1) if args.json else "\n".join(lines))
    return 0


def run_install(args: argparse.Namespace) -> int:
    """`palpate install`: a signed bundle comes into the store."""
    store = assembly.store(settings(args))
    sha = store.install(args.folder, args.shadow)
    committed = "it is committed already" if store.state.of(sha).committed else f"it runs on trial {NEXT}"
    print(f"bundle {sha[:8]} is installed; {'it is the candidate' if args.shadow else committed}")
    return 0


def run_verify(args: argparse.Namespace) -> int:
    """`palpate verify`: whether a bundle would be taken, but for its counter."""
    held = assembly.store(settings(args)).examine(args.folder)
    m = held.bundle.manifest
    print(f"bundle {held.bundle.id}: {m.name} {m.version}, counter {m.counter}, signed by {held.signer}; all is well")
    return 0


def run_commit(args: argparse.Namespace) -> int:
    """`palpate commit`: the trial is over."""
    print("committed" if assembly.store(settings(args)).commit() else "nothing is on trial")
    return 0


def run_rollback(args: argparse.Namespace) -> int:
    """`palpate rollback`: back to the bundle before."""
    sha = assembly.store(settings(args)).rollback()
    print(f"{f'bundle {sha[:8]}' if sha else 'the packaged bundle'} runs {NEXT}")
    return 0


def run_promote(args: argparse.Namespace) -> int:
    """`palpate promote`: the candidate becomes the current bundle."""
    print(f"bundle {assembly.store(settings(args)).promote()[:8]} runs on trial {NEXT}")
    return 0


NEXT = "from the next start on: systemctl restart palpate"
RUNS = {
    "replay": run_replay, "config": run_config, "status": run_status, "bundles": run_bundles, "install": run_install,
    "verify": run_verify, "commit": run_commit, "rollback": run_rollback, "promote": run_promote,
}  # fmt: skip
