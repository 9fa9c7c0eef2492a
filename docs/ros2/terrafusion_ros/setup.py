"""The package `terrafusion_ros` for colcon."""

from setuptools import setup

NAME = "terrafusion_ros"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/terrafusion.launch.py"]),
        (f"share/{NAME}/config", ["config/terrafusion.yaml"]),
    ],
    install_requires=["setuptools", "terrafusion"],
    entry_points={"console_scripts": ["terrafusion_node = terrafusion_ros.node:main"]},
)
