"""The error tree of the box: each class is one kind of error, with the exit code of the command
line.

Messages are lower case, name the wrong value and the remedy. Exit codes are from sysexits.h.
"""

import errno

# `os` has them on Unix only, but the client also runs elsewhere
EX_DATAERR, EX_UNAVAILABLE, EX_SOFTWARE, EX_TEMPFAIL, EX_CONFIG = 65, 69, 70, 75, 78
INTERRUPTED = 130
"""Exit code of a program that Ctrl-C has ended, as in a shell."""

PASSING = frozenset(
    getattr(errno, name)
    for name in (
        *("EIO", "ENOMEM", "ENOSPC", "EDQUOT", "EMFILE", "ENFILE", "EAGAIN", "EINTR", "EBUSY"),
        *("ESTALE", "ETIMEDOUT", "ENOBUFS", "ENETDOWN", "EADDRINUSE", "EADDRNOTAVAIL"),
    )
)
"""Numbers of errors of the system that may be gone at the next attempt."""


class ApplianceError(Exception):
    """Base of all expected errors: one line for a person, and the command's `exit_code`."""

    exit_code = 1


class ConfigError(ApplianceError):
    """A configuration file, key or value cannot be used."""

    exit_code = EX_CONFIG


class BundleError(ApplianceError):
    """A model bundle is incomplete, altered, or fails its golden sweeps."""

    exit_code = EX_CONFIG


class BundleDenied(BundleError):
    """This user may not read the deployed bundle."""


class ModelError(BundleError):
    """The model cannot be run on an input, or not with the memory that is left. The next start may
    succeed, so the service is started again."""

    exit_code = EX_SOFTWARE


class TemporaryError(ConfigError):
    """As ConfigError, but the cause may be gone at the next start without a person."""

    exit_code = EX_TEMPFAIL


class SensorError(ApplianceError):
    """The skin cannot be read. `state`: of the sensor in the STA sentence (PROTOCOL.md)."""

    exit_code = EX_UNAVAILABLE
    state = "error"


class SensorAbsent(SensorError):
    """No skin with the configured ids is on the bus."""

    state = "absent"


class SensorBusy(SensorError):
    """Another program holds the skin's interface (errno 16)."""

    state = "busy"


class SensorDenied(SensorError):
    """This user may not open the device node (errno 13)."""

    state = "denied"


class SensorMismatch(SensorError):
    """The skin speaks another protocol version, or its format is not the bundle's."""

    state = "mismatch"


class SensorLost(SensorError):
    """The skin was unplugged or failed while it was being read (errno 19, 5, 32, 71, 75)."""

    state = "lost"


class SensorOverflow(SensorLost):
    """One transfer was larger than the read (errno 75) and is lost; the link itself goes on."""


class SensorSilent(SensorError):
    """The skin is connected but sends nothing."""

    state = "silent"


class LineError(ApplianceError):
    """A GPIO line cannot be found or requested, or the libgpiod binding cannot be used."""

    exit_code = EX_UNAVAILABLE


class PortError(ApplianceError):
    """The serial port cannot be opened."""

    exit_code = EX_UNAVAILABLE


class AddressError(ConfigError):
    """An address of this machine cannot be listened on: it is not there yet, or in use."""

    exit_code = EX_UNAVAILABLE


class FeedError(ApplianceError):
    """The feed of the running box cannot be read, or is silent."""

    exit_code = EX_UNAVAILABLE


class LinkLost(PortError):
    """The line to the box is not open, or was lost during a wait."""


class NoAnswer(ApplianceError):
    """The box did not answer in time."""

    exit_code = EX_UNAVAILABLE


class CommandRefused(ApplianceError):
    """The box answered a command with an error."""


class FormatError(ApplianceError):
    """An array, file or sentence is invalid."""

    exit_code = EX_DATAERR


def passes(e: BaseException) -> bool:
    """Whether an error of the system may be gone at the next attempt, without a person."""
    return isinstance(e, OSError) and e.errno in PASSING
