"""ros2 launch palpate.launch.py port:=/dev/ttyUSB0 : the box as a node, started again if it
ends."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration


def generate_launch_description():
    """One process: the bridge with the parameters beside this file."""
    parameters = str(Path(__file__).with_name("palpate.yaml"))
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "port", description="the box's serial line, or socket://HOST:PORT"
            ),
            ExecuteProcess(
                cmd=[
                    "python3",
                    "-m",
                    "palpate.bridges",
                    "ros",
                    "--ros-args",
                    "--params-file",
                    parameters,
                    "-p",
                    ["port:=", LaunchConfiguration("port")],
                ],
                output="screen",
                respawn=True,
                respawn_delay=2.0,
            ),
        ]
    )
