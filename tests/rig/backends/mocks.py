"""umockdev for backends: handlers in one thread answer open, read and ioctl of this process."""

import ctypes
import os
import shutil
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.rig.backends import BackendMissing

DEBIAN = "/usr/lib/python3/dist-packages"
PACKAGES = "umockdev gir1.2-umockdev-1.0 python3-gi"
ANSWER_S = 10
NOBODY = 65534


def lacking() -> str:
    """Packages that umockdev needs and that are not installed; "" if nothing is missing."""
    if not shutil.which("umockdev-wrapper"):
        return f"no umockdev here; apt-get install {PACKAGES}"
    try:
        introspection()
    except (ImportError, ValueError) as e:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        return (
            f"Python {version} cannot load umockdev ({e}); "
            f"use Debian's Python, apt-get install {PACKAGES}"
        )
    return ""


def introspection() -> tuple[Any, Any]:
    """The modules (UMockdev, GLib). Raises ImportError or ValueError if they are not installed."""
    if DEBIAN not in sys.path:
        # PyGObject has no wheel. At the end of the path Debian's packages do not shadow the
        # environment's.
        sys.path.append(DEBIAN)
    import gi

    gi.require_version("UMockdev", "1.0")
    from gi.repository import GLib, UMockdev

    return UMockdev, GLib


class MockedDevices:
    """A testbed and the thread that runs all handlers of its devices."""

    def __init__(self) -> None:
        if missing := lacking():
            raise BackendMissing(missing)
        if "libumockdev-preload" not in os.environ.get("LD_PRELOAD", ""):
            raise BackendMissing(
                "umockdev is not below this process; start it with umockdev-wrapper"
            )
        umockdev, self._glib = introspection()
        self._base = umockdev.IoctlBase
        self.testbed = umockdev.Testbed.new()
        self._root = Path(self.testbed.get_root_dir())
        self._root.chmod(0o755)  # the nodes' own modes decide who may open them
        self._handlers: list[Any] = []  # umockdev does not keep a reference to them
        self._context = self._glib.MainContext.new()
        self._loop = self._glib.MainLoop.new(self._context, False)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        self._context.push_thread_default()
        self._loop.run()

    def do(self, action: Callable[[], None]) -> None:
        """Run `action` in the thread and wait for it."""
        done, failed = threading.Event(), list[BaseException]()

        def once(*_: object) -> bool:
            try:
                action()
            except BaseException as e:
                failed.append(e)
            done.set()
            return False

        self._context.invoke_full(self._glib.PRIORITY_DEFAULT, once)
        assert done.wait(ANSWER_S), "the mock's thread does not answer"
        if failed:
            raise failed[0]

    def node(self, name: str) -> Path:
        """Path of the device node /dev/NAME in the testbed."""
        return self._root / "dev" / name

    def take_away(self, name: str, on: bool) -> None:
        """Hide /dev/NAME, or show it again, without a uevent (each look-up keeps a socket open)."""
        node, away = self.node(name), self.node(f"{name}.away")
        (node if on else away).rename(away if on else node)

    def close_to_all(self, name: str, on: bool) -> None:
        """Forbid everybody to open /dev/NAME, root included: the opening thread is not root."""
        be_to_files = ctypes.CDLL(None).setfsuid
        be_to_files(os.geteuid())
        if (node := self.node(name)).exists():
            node.chmod(0 if on else 0o644)
            # umockdev itself opens it, too, and must not be refused.
            (self._root / "ioctl").chmod(0o755)
            (self._root / "ioctl" / "dev" / name).chmod(0o777)
        if on:
            be_to_files(os.geteuid() or NOBODY)

    def attach(self, name: str, answer: Callable[[int, Any, int], None]) -> None:
        """Answer its ioctls with answer(number, argument, open file); OSError becomes the errno."""

        class Handler(self._base):  # type: ignore[misc,name-defined]
            """umockdev's interface for handlers of ioctls."""

            def do_handle_ioctl(self, client: Any) -> bool:
                try:
                    answer(client.get_request() & 0xFFFF, client.get_arg(), hash(client))
                    client.complete(0, 0)
                except OSError as e:
                    client.complete(-1, e.errno)
                except Exception:
                    traceback.print_exc()
                    client.complete(-1, 5)
                return True

        handler = Handler()
        self._handlers.append(handler)
        self.do(lambda: self.testbed.attach_ioctl(f"/dev/{name}", handler))

    def close(self) -> None:
        self._loop.quit()
        self._thread.join(ANSWER_S)
