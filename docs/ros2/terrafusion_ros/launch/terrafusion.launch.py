"""Starts the terrafusion node: ros2 launch terrafusion_ros terrafusion.launch.py vehicle:=husky."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """One node with the parameters of config/terrafusion.yaml."""
    config = Path(get_package_share_directory("terrafusion_ros")) / "config" / "terrafusion.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", default_value=str(config)),
            DeclareLaunchArgument("vehicle", default_value="husky"),
            DeclareLaunchArgument("use_sim_time", default_value="false"),
            Node(
                package="terrafusion_ros",
                executable="terrafusion_node",
                name="terrafusion",
                output="screen",
                parameters=[
                    LaunchConfiguration("params_file"),
                    {
                        "vehicle": LaunchConfiguration("vehicle"),
                        "use_sim_time": LaunchConfiguration("use_sim_time"),
                    },
                ],
            ),
        ]
    )
