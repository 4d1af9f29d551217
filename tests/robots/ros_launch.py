"""Reads launch files without the package `launch`, which has neither a wheel nor a Debian package.

The four names accept the arguments of ROS 2's (github.com/ros2/launch, launch/actions and
launch/substitutions) that the project uses. A launch file that uses more fails here.
"""

import runpy
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock


@dataclass(frozen=True)
class LaunchConfiguration:
    """The value of an argument."""

    name: str


@dataclass(frozen=True)
class DeclareLaunchArgument:
    """An argument. Without a default it is required."""

    name: str
    default_value: str | None = field(default=None, kw_only=True)
    description: str = field(default="", kw_only=True)


@dataclass(frozen=True, kw_only=True)
class ExecuteProcess:
    """A process. cmd: texts, arguments, or lists of both, which are joined."""

    cmd: list[Any]
    output: str = "log"
    respawn: bool = False
    respawn_delay: float | None = None


def LaunchDescription(entities: list[Any]) -> list[Any]:
    """The entities of the launch."""
    return entities


def processes(path: Path, **arguments: str) -> list[tuple[ExecuteProcess, list[str]]]:
    """The processes of a launch file, each as its command with these arguments."""
    modules = {
        name: ModuleType(name) for name in ("launch", "launch.actions", "launch.substitutions")
    }
    vars(modules["launch"])["LaunchDescription"] = LaunchDescription
    vars(modules["launch.actions"]).update(
        DeclareLaunchArgument=DeclareLaunchArgument, ExecuteProcess=ExecuteProcess
    )
    vars(modules["launch.substitutions"])["LaunchConfiguration"] = LaunchConfiguration
    with mock.patch.dict(sys.modules, modules):
        described = runpy.run_path(str(path))["generate_launch_description"]()
    declared = {
        one.name: one.default_value for one in described if isinstance(one, DeclareLaunchArgument)
    }
    values = declared | arguments
    assert values.keys() == declared.keys(), "the file does not declare all given arguments"

    def text(part: Any) -> str:
        if isinstance(part, LaunchConfiguration):
            assert values[part.name] is not None, f"{part.name} has to be given"
            return values[part.name]
        return part if isinstance(part, str) else "".join(map(text, part))

    return [
        (one, [text(part) for part in one.cmd])
        for one in described
        if isinstance(one, ExecuteProcess)
    ]
