"""Install the package for ROS 2: `colcon build --packages-select torchelev_ros`."""

from pathlib import Path

from setuptools import setup

NAME = "torchelev_ros"
FOLDERS = ("launch", "config", "rviz", "foxglove")


def files_of(folder: str) -> list[str]:
    """Return the files of a folder beside this file, as setuptools names them."""
    return sorted(f"{folder}/{path.name}" for path in Path(folder).iterdir() if path.is_file())


setup(
    name=NAME,
    version="0.1.0",
    description="Launch file, settings and layouts for the elevation mapping node of torchelev.",
    license="MIT",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *((f"share/{NAME}/{folder}", files_of(folder)) for folder in FOLDERS),
    ],
    install_requires=["setuptools"],  # torchelev is installed apart, with or without PyTorch
    zip_safe=True,
    entry_points={"console_scripts": [f"elevation_mapping = {NAME}:main"]},
)
