"""The error tree of the box. Nothing comes in; each class is one kind of trouble and what a caller may do about it.

Messages are lower case, name the value that was wrong and say what to try. Exit codes are those of sysexits.h.
"""

from os import EX_CONFIG, EX_DATAERR, EX_UNAVAILABLE


class ApplianceError(Exception):
    """Anything that the box can name by itself; the command line prints it as one line and exits with `exit_code`."""

    exit_code = 1


class ConfigError(ApplianceError):
    """A configuration file, key or value that cannot be used."""

    exit_code = EX_CONFIG


class BundleError(ApplianceError):
    """A model bundle that is incomplete, altered, or does not do what its manifest says."""

    exit_code = EX_CONFIG


class SensorError(ApplianceError):
    """The skin cannot be read. `state` names the trouble as the state sentence does (PROTOCOL.md, sensor states)."""

    exit_code = EX_UNAVAILABLE
    state = "error"


class SensorAbsent(SensorError):
    """No skin with the configured ids is on the bus."""

    state = "absent"


class SensorBusy(SensorError):
    """Another program holds the skin's interface (errno 16)."""

    state = "busy"


class SensorDenied(SensorError):
    """The device node may not be opened by this user (errno 13)."""

    state = "denied"


class SensorMismatch(SensorError):
    """The skin speaks another protocol version, or its format is not the bundle's."""

    state = "mismatch"


class SensorLost(SensorError):
    """The skin went away or failed while it was being read (errno 19, 5, 32, 71, 75)."""

    state = "lost"


class SensorSilent(SensorError):
    """The skin is there but sends nothing."""

    state = "silent"


class LineError(ApplianceError):
    """A GPIO line that cannot be found or requested, or an unusable libgpiod binding."""

    exit_code = EX_UNAVAILABLE


class PortError(ApplianceError):
    """The serial port cannot be opened."""

    exit_code = EX_UNAVAILABLE


class FormatError(ApplianceError):
    """An array, file or sentence that does not have the form it should have."""

    exit_code = EX_DATAERR
